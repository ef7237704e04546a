"""Raw messages of bags of all three kinds, and their decoding, by rosbags.

Types are decoded as the standard defines them, not as the bag does: a bag whose definitions are missing, of
another dialect or damaged can be read all the same, and those of other types are never parsed.
"""

import heapq
import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self, cast

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from terrainloop.errors import TerrainLoopError
from terrainloop.io.bags.files import find_files
from terrainloop.io.bags.salvage import SalvagedMcap, can_salvage

logger = logging.getLogger(__name__)

TF = "tf2_msgs/msg/TFMessage"
_ALIASES = {"tf/msg/tfMessage": TF}  # of ROS 1 before tf2, with the same fields
_WINDOW = 10**9  # nanoseconds before the end in which the last message is looked for first

_MENDS = (
    ("index looks damaged", "repair it with 'rosbag reindex'"),
    ("not indexed", "repair it with 'rosbag reindex'"),
    ("malformed", "repair it with 'sqlite3 BAG.db3 .recover', or copy it again"),
    ("not a database", "copy it again"),
    ("missing tables", "give the file of a ROS 2 bag"),
    ("end magic", "install mcap (pip install mcap) to read what is there, or run 'mcap recover'"),
    ("Profile", "record a ROS 2 bag; if its messages are in CDR, pip install mcap reads them"),
    ("decompress", "copy it again: a compressed part is damaged"),
    ("seems to be empty", "record it again"),
    ("not supported", "convert it with 'ros2 bag convert' or 'rosbag decompress'"),
)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; one name may occur with several types."""

    name: str
    type: str
    count: int


class _Reader(Protocol):
    """What rosbags' two readers have in common."""

    @property
    def connections(self) -> Sequence[Any]: ...
    @property
    def end_time(self) -> int: ...
    def messages(self, connections: Any, start: int | None = None) -> Iterator[tuple[Any, int, bytes]]: ...


_Source = _Reader | SalvagedMcap


class Bag:
    """A bag opened for reading, to be used in a ``with`` statement.

    Attributes
    ----------
    remarks : list of str
        What was done to read it.

    Raises
    ------
    TerrainLoopError
        If it is damaged.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.path = str(paths[0])
        self._files, self.remarks = find_files(paths)
        self._stack = ExitStack()
        self._sources: list[_Source] = []
        self._connections: dict[Topic, list[tuple[_Source, Any]]] = {}
        self._ros1 = self._files[0].suffix.lower() == ".bag"
        self._store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        if TF not in self._store.fielddefs:
            tf = get_typestore(Stores.ROS2_HUMBLE).fielddefs[TF]
            self._store.register({TF: tf})

    def __enter__(self) -> Self:
        try:
            self._sources = [self._opened(file) for file in self._files]
        except BaseException:
            self._stack.close()
            raise
        found: dict[tuple[str, str], list[tuple[_Source, Any]]] = defaultdict(list)
        for source in self._sources:
            for connection in source.connections:
                found[connection.topic, type_name(connection.msgtype)].append((source, connection))
        self._connections = {
            Topic(name, kind, sum(connection.msgcount for _, connection in parts)): parts
            for (name, kind), parts in sorted(found.items())
        }
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def kind(self) -> str:
        """What the bag is, in words."""
        if self._ros1:
            return "ROS 1 bag"
        names = {
            file.suffix.lower()
            for each in self._files
            for file in (each.iterdir() if each.is_dir() else [each])
        }
        storage = "MCAP" if any(name == ".mcap" for name in names) else "sqlite3"
        compressed = ", compressed" if any(each.is_dir() for each in self._files) else ""
        return f"ROS 2 bag ({storage}{compressed})"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, by name."""
        return tuple(self._connections)

    def has_header(self, topic: Topic) -> bool:
        """Whether messages of the topic can be decoded and carry a header."""
        fields = self._store.fielddefs.get(topic.type, ([], []))[1]
        return bool(fields) and fields[0][0] == "header"

    def messages(
        self, topics: Sequence[Topic], start: int | None = None
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Topic, bag time in nanoseconds and raw message, in the order of bag time."""
        wanted: dict[int, tuple[_Source, dict[int, Topic], list[Any]]] = {}
        for topic in topics:
            for source, connection in self._connections[topic]:
                _, names, connections = wanted.setdefault(id(source), (source, {}, []))
                names[connection.id] = topic
                connections.append(connection)

        def read(source: _Source, names: dict[int, Topic], connections: list[Any]) -> Iterator[Any]:
            for connection, time, raw in source.messages(connections, start=start):
                yield names[connection.id], time, raw

        with _errors_of(self.path):
            yield from heapq.merge(*(read(*each) for each in wanted.values()), key=lambda item: item[1])

    def last(self, topic: Topic) -> bytes | None:
        """The last message of a topic by bag time."""
        for source, connection in reversed(self._connections[topic]):
            if isinstance(source, SalvagedMcap):  # which has no index to look it up
                return source.last[connection.id]
        with _errors_of(self.path):
            end = max(source.end_time for source in self._sources if not isinstance(source, SalvagedMcap))
        window = _WINDOW
        while True:
            start = end - window if window < end else None
            found = None
            for _, _, found in self.messages([topic], start):  # noqa: B007  the last one remains
                pass
            if found is not None or start is None:
                return found
            window *= 30

    def decode(self, topic: Topic, raw: bytes) -> Any:
        """A message, or None where it is damaged."""
        read = self._store.deserialize_ros1 if self._ros1 else self._store.deserialize_cdr
        try:
            return read(raw, topic.type)
        except Exception as error:  # what rosbags raises on damaged messages is not documented
            logger.debug("%s: a message of %s is damaged: %s", self.path, topic.name, error)
            return None

    def _opened(self, file: Path) -> _Source:
        try:
            with _errors_of(str(file)):
                reader: Any = Reader1(file) if self._ros1 else Reader2(file)
                return cast(_Reader, self._stack.enter_context(reader))
        except TerrainLoopError as error:
            if file.suffix.lower() != ".mcap" or not can_salvage():
                raise
            salvaged = SalvagedMcap(file)
            with _errors_of(str(file)):
                salvaged.open()
            if not salvaged.connections:
                raise TerrainLoopError(
                    expected=error.expected,
                    found=f"{error.found}, and no message of ROS 2 (CDR) before that",
                    mend="copy it again, or record a ROS 2 bag",
                ) from error
            self.remarks.append(
                f"{file.name} is salvaged as far as it goes ({error.found.rpartition(': ')[2]})"
            )
            return salvaged


def type_name(msgtype: str) -> str:
    """The name of a message type as ROS 2 writes it, package/msg/Name."""
    package, _, name = msgtype.partition("/")
    full = msgtype if "/" in name or not name else f"{package}/msg/{name}"
    return _ALIASES.get(full, full)


@contextmanager
def _errors_of(path: str) -> Iterator[None]:
    """Turn whatever rosbags raises on a damaged bag into a TerrainLoopError."""
    try:
        yield
    except (TerrainLoopError, GeneratorExit):
        raise
    except Exception as error:
        reason = str(error).strip().partition("\n")[0].rstrip(".") or type(error).__name__
        mend = next(
            (mend for part, mend in _MENDS if part.lower() in reason.lower()), "copy it again, or repair it"
        )
        raise TerrainLoopError(
            expected="a whole bag of ROS 1 or ROS 2", found=f"{path}: {reason}", mend=mend
        ) from error
