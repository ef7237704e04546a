"""YAML 1.2 for settings files: short, flat and strict."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from terrainloop.errors import TerrainLoopError

_LARGEST = 1 << 16  # bytes; twenty times the settings with their comments
_DEEPEST = 8  # levels of nesting
_LONGEST_QUOTE = 200  # characters of a parser's message


def read_yaml(path: Path | str) -> Any:
    """Content of a YAML file: mappings, lists, text, numbers, booleans and null.

    Numbers and booleans are those of the core schema of YAML 1.2: ``1e-3`` is a number, ``010`` is ten,
    ``yes`` and ``2020-01-01`` are text. References and repeated keys are refused.

    Raises
    ------
    TerrainLoopError
        If the file cannot be read as that, or is larger than any file of settings.
    """
    try:
        path = Path(path)
        if path.exists() and not path.is_file():
            raise ValueError("not a regular file")  # a pipe would block
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"{path.stat().st_size} bytes, more than {_LARGEST}")
        return yaml.load(path.read_text(encoding="utf-8-sig"), _Loader)
    except (OSError, TypeError, ValueError, OverflowError, yaml.YAMLError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise TerrainLoopError(
            expected=f"YAML settings in {path}",
            found=" ".join(reason.split())[:_LONGEST_QUOTE],
            mend="start from the output of 'terrainloop config'",
        ) from error


class _Loader(yaml.SafeLoader):
    """Knows only the core schema of YAML 1.2, and bounds the size of its result."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse references, by which a few lines can expand to gigabytes, and endless nesting."""
        if self.check_event(yaml.AliasEvent):
            raise ValueError("a reference (*), which settings do not need")
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(f"more than {_DEEPEST} levels of nesting")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse repeated keys: the last one would silently win."""
        counts = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        key, times = max(counts.items(), key=lambda item: item[1], default=("", 0))
        if times > 1:
            raise ValueError(f"the key {key[:60]!r} {times} times from line {node.start_mark.line + 1} on")
        return super().construct_mapping(node, deep)

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        """An integer in decimal digits, whatever zeros are in front."""
        return int(self.construct_scalar(node))


_Loader.yaml_implicit_resolvers = {}  # without those of YAML 1.1, which the base class has
_INTEGER, _FLOAT = r"[-+]?[0-9]+", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
for _tag, _pattern, _first in (
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", "true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", _INTEGER, list("-+0123456789")),
    ("float", rf"{_FLOAT}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)
