"""What others script against: names, the snippet of the documentation, types, version."""

import re
import subprocess
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from conftest import RESOLUTION, STRICT

import terrainloop as tl

PROMISED = {"GradientMap", "LoopDetector", "Settings", "fit_hyperparameters", "load_mission", "register"}
PACKAGE = Path(tl.__file__).parent


def test_everything_promised_is_there():
    assert set(tl.__all__) >= PROMISED
    assert tl.__all__ == sorted(tl.__all__)
    assert len(set(tl.__all__)) == len(tl.__all__)


@pytest.mark.parametrize("name", tl.__all__)
def test_every_name_resolves_to_something_documented(name):
    value = getattr(tl, name)
    assert callable(value)
    assert value.__name__ == name
    assert value.__module__.startswith("terrainloop.")
    assert len(value.__doc__) > 20
    assert getattr(import_module(value.__module__), name) is value
    assert name in dir(tl)


def test_nothing_public_is_left_out():
    """What the type checker is told of the package is what it has."""
    source = (PACKAGE / "__init__.py").read_text()
    for_types = source.partition("if TYPE_CHECKING:")[2].partition("_HOME")[0]
    imported = {name for line in re.findall(r"import (.+)", for_types) for name in line.split(", ")}
    assert imported == set(tl.__all__)
    modules = {path.stem for path in PACKAGE.iterdir()}
    public = {name for name in vars(tl) if not name.startswith("_")} - modules
    assert public - {"TYPE_CHECKING"} <= set(tl.__all__)
    assert set(dir(tl)) == {*tl.__all__, "__version__"}


def test_star_import():
    names = {}
    exec("from terrainloop import *", names)  # what a user may type
    assert set(tl.__all__) <= set(names)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'LoopDetektor'"):
        _ = tl.LoopDetektor


def test_import_is_light():
    """The package loads its parts when they are asked for."""
    script = (
        "import sys, terrainloop\n"
        "print(sorted({'cv2', 'scipy', 'matplotlib', 'numpy', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_documented_snippet_runs(mission_folder):
    """DESIGN.md, section 3, on a mission so small that the settings must be too."""
    found = []
    submaps = tl.load_mission(mission_folder)
    detector = tl.LoopDetector(STRICT)
    for submap in submaps:
        for loop in detector.add(submap):
            found.append((loop.target, loop.source))
            assert loop.T_target_source.shape == (4, 4)
            assert loop.covariance.shape == (6, 6)
            assert isinstance(loop.score, float)
    assert ("000000", "000003") in found
    assert isinstance(detector, tl.LoopDetector)


def test_the_documented_functions_run(world):
    points = world(0).observe(np.eye(4), (0.0, 0.0), seed=0, count=300, side=3.0)
    params = tl.fit_hyperparameters([points, points[:200]])
    assert min(params.length_scale, params.variance, params.noise) > 0
    gmap = tl.GradientMap.from_points(
        points, length_scale=None, variance=None, noise=None, resolution=RESOLUTION
    )
    arrays = ("elevation", "gradient_x", "gradient_y", "magnitude", "variance", "gradient_variance", "mask")
    assert {getattr(gmap, name).shape for name in arrays} == {gmap.mask.shape}
    x, y = gmap.origin
    assert (x, y) == pytest.approx(points[:, :2].min(axis=0))
    assert gmap.resolution == RESOLUTION
    result = tl.register(gmap, gmap)
    assert isinstance(result, tl.LoopCandidate)
    assert isinstance(result.reason, str)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_the_documented_presets_make_a_detector(preset):
    assert tl.LoopDetector(tl.Settings.preset(preset)).settings == tl.Settings.preset(preset)


def test_types_are_shipped():
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "_core" / "__init__.pyi").is_file()


def test_version():
    try:
        assert tl.__version__ == version("terrainloop")
        assert re.fullmatch(r"\d+\.\d+\.\d+.*", tl.__version__)
    except PackageNotFoundError:
        assert tl.__version__ == "unknown"


@pytest.mark.parametrize("settings", ["paper", {"seed": 1}, tl.Settings, Path("settings.yaml")])
def test_what_are_no_settings_is_refused_by_all(settings, world, tmp_path):
    ground_map = world(0).map()
    for call in (
        lambda: tl.register(ground_map, ground_map, settings),
        lambda: tl.LoopDetector(settings),
        lambda: tl.detect_mission(tmp_path, settings),
    ):
        with pytest.raises(tl.TerrainLoopError, match=r"expected settings; .* pass Settings\(\)"):
            call()


@pytest.mark.parametrize("clouds", [None, 3, iter([]), [], ()])
def test_what_are_no_clouds_is_refused(clouds):
    with pytest.raises(tl.TerrainLoopError, match="at least one cloud"):
        tl.fit_hyperparameters(clouds)


@pytest.mark.parametrize("path", [None, 3, b"cloud.ply", ["cloud.ply"]])
def test_what_is_no_path_is_refused(path):
    for call, of in (
        (tl.read_cloud, "a cloud"),
        (tl.read_crs, "a cloud"),
        (lambda path: tl.write_cloud(path, np.zeros((3, 3))), "a cloud"),
        (tl.GradientMap.load, "a gradient map"),
        (tl.Run.read, "a run"),
    ):
        with pytest.raises(tl.TerrainLoopError, match=f"the path of {of}"):
            call(path)


def test_ragged_lists_and_endless_stamps_are_refused(tmp_path):
    ragged = [[1.0, 2.0, 3.0], [1.0]]
    points = np.random.default_rng(0).uniform(0, 10, (200, 3)) * [1, 1, 0.1]
    for call in (
        lambda: tl.write_cloud(tmp_path / "cloud.ply", ragged),
        lambda: tl.Submap(points, intensity=ragged),
        lambda: tl.Submap(points, stamp=10**400),
    ):
        with pytest.raises(tl.TerrainLoopError):
            call()


def test_a_detector_and_a_run_describe_themselves():
    assert repr(tl.LoopDetector()) == "LoopDetector(0 submaps, 0 loops)"
    run = tl.Run(settings=tl.Settings(), parameters=None, submaps=(), loops=(), rejections={"flat": 3})
    assert repr(run) == "Run(0 submaps, 3 pairs, 0 loops)"
