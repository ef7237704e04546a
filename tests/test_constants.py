"""docs/calibration.md names every constant that results rest on, and the code holds what it says there."""

import ast
import re
from contextlib import suppress
from dataclasses import astuple, is_dataclass
from importlib import import_module
from pathlib import Path

import pytest

import terrainloop
from terrainloop.config import Calibration

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "calibration.md"
PACKAGE = Path(terrainloop.__file__).parent
DETECTION = tuple(f"detection/{name}" for name in ("mission", "detector", "flat_field", "sensor_pattern"))
# Where any number changes results. Limits on input, formats and drawings are not of that kind.
PYTHON = (
    "features",
    "field",
    "gradient_map",
    "loop",
    "matching",
    "gp",
    *DETECTION,
    "pose_graph",
    "evaluation",
)
CORE = ("cpp/src", "cpp/include")


def tables():
    """Cells of each table of the page that holds numbers, without their heads."""
    found, rows = [], []
    for line in [*PAGE.read_text(encoding="utf-8").splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            found.append([[cell.strip("`") for cell in row] for row in rows[2:]])
            rows = []
    return found


_, CALIBRATION, MODULES, CONSTEXPR, UNNAMED = tables()


def literal(text):
    """The numbers of a literal of Python or C++; an error for anything else."""
    if text.startswith("{") and ":" not in text:
        text = "(" + text.strip("{}") + ",)"
    return ast.literal_eval(re.sub(r"(?<=[\d.])f\b", "", text).replace("'", ""))


def plain(value):
    return astuple(value) if is_dataclass(value) else value


def test_every_field_of_the_calibration_is_in_the_table_as_it_is():
    values = {row[0]: literal(row[1]) for row in CALIBRATION}
    assert values == Calibration().model_dump()
    assert len(values) == len(CALIBRATION)


@pytest.mark.parametrize(("name", "value"), [row[:2] for row in MODULES])
def test_constants_of_modules_are_what_the_page_says(name, value):
    module, _, constant = name.rpartition(".")
    assert plain(getattr(import_module(f"terrainloop.{module}"), constant)) == literal(value)


def modules():
    for part in PYTHON:
        path = PACKAGE / part
        yield from sorted(path.glob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def is_numeric(value):
    if isinstance(value, dict | tuple | list):
        return all(map(is_numeric, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int | float)


def named_numbers(path):
    """Constants of a module that are literal numbers, or tuples or dictionaries of them."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name) and target.id.isupper() and not target.id.startswith("_"):
            with suppress(ValueError):  # made of other constants
                if is_numeric(ast.literal_eval(node.value)):
                    yield target.id


def test_no_constant_of_a_module_is_missing():
    written = {row[0] for row in MODULES}
    for path in modules():
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        missing = {f"{module}.{name}" for name in named_numbers(path)} - written
        assert not missing, f"enter {missing} in {PAGE.name}"


needs_core = pytest.mark.skipif(not (ROOT / "cpp").is_dir(), reason="without the sources of the core")
DEFINED = re.compile(r"\bconstexpr\s+[\w:]+\s+(k\w+)(?:\[\])?\s*=\s*([^;]+);")


def constants_of_core():
    """Literal constants of the core: "path name" and value."""
    for path in sorted(p for part in CORE for p in (ROOT / part).rglob("*.?pp")):
        for name, value in DEFINED.findall(path.read_text(encoding="utf-8")):
            with suppress(ValueError, SyntaxError):  # made of other constants
                yield f"{path.relative_to(ROOT).as_posix()} {name}", literal(value)


@needs_core
def test_constants_of_the_core_are_in_the_table_as_they_are():
    pi = 3.14159265358979323846
    code = {name: value for name, value in constants_of_core() if value != pi}
    page = {row[0]: literal(row[1]) for row in CONSTEXPR}
    assert code == page


@pytest.mark.parametrize(("file", "text"), [row[:2] for row in UNNAMED])
def test_numbers_without_a_name_stand_in_the_code(file, text):
    path = ROOT / file
    if not path.exists() and file.startswith("cpp/"):
        pytest.skip("without the sources of the core")
    assert text in path.read_text(encoding="utf-8")


def test_changes_would_be_noticed():
    """The readers above see what they are meant to see."""
    assert literal("0.999f") == 0.999
    assert literal("{4, 7}") == (4, 7)
    assert literal("5e-4") == 5e-4
    assert literal('{"noise": 1e3}') == {"noise": 1000.0}
    assert len(list(constants_of_core())) > 30 or not (ROOT / "cpp").is_dir()
    assert {"NODES", "TILE", "MAX_POINTS"} <= set(named_numbers(PACKAGE / "gp" / "exact.py"))
