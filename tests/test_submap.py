import logging
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clouds_util import UTM, ground
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.submap import MIN_POINTS, Submap


def test_good_points_are_kept_as_they_are():
    points = ground()
    submap = Submap(points, name="a", session="s", stamp=2.5)
    assert np.array_equal(submap.points, points)
    assert (submap.name, submap.session, submap.stamp, len(submap)) == ("a", "s", 2.5, 400)
    assert submap.intensity is None
    assert submap.repairs == ()


def test_the_caller_may_reuse_the_array():
    points = ground()
    submap = Submap(points)
    points[:] = 0
    assert np.array_equal(submap.points, ground())


def test_bad_and_repeated_rows_are_dropped_in_order(caplog):
    clean = ground()
    points = np.insert(clean, [3, 50, 50], [[np.nan, 0, 0], [0, -np.inf, 0], [0, 0, 1e300]], axis=0)
    points = np.concatenate([points, points[20:30], points[20:25]])
    intensity = np.arange(len(points))
    with caplog.at_level(logging.WARNING, logger="terrainloop.submap"):
        submap = Submap(points, name="mended", intensity=intensity)
    assert np.array_equal(submap.points, clean)
    assert np.array_equal(points[submap.intensity.astype(int)], clean)
    assert [repair.split(":")[0] for repair in submap.repairs] == [
        "dropped 3 of 418 points",
        "dropped 15 of 418 points",
    ]
    assert [record.getMessage() for record in caplog.records] == [f"mended: {r}" for r in submap.repairs]


def test_repeats_are_those_a_dictionary_finds():
    rng = np.random.default_rng(1)
    points = rng.integers(0, 8, (3000, 3)) * [1.0, 1.0, 0.1]
    assert np.array_equal(Submap(points).points, list(dict.fromkeys(map(tuple, points.tolist()))))


def _wall(pitch):
    """Ground as a camera pitched down by so many degrees sees it: z forward, y down."""
    return Rotation.from_euler("x", -90 + pitch, degrees=True).apply(ground() - [5, 0, 1.5])


BROKEN = {
    "columns": (np.zeros((500, 2)), "shape (500, 2)"),
    "transposed": (ground().T, "transpose"),
    "flat array": (ground().ravel(), "(1200,)"),
    "path": (Path("cloud.ply"), "read_cloud"),
    "name of a file": ("cloud.ply", "read_cloud"),
    "nothing": (None, "object"),
    "set": ({1.0, 2.0}, "object"),
    "booleans": (np.ones((500, 3), bool), "bool"),
    "dates": (np.zeros((500, 3), "datetime64[s]"), "datetime64"),
    "records": (np.zeros(500, "f8,f8,f8"), "(500,)"),
    "words": ([["a", "b", "c"]] * 500, "<U1"),
    "ragged": ([[0.0, 1.0, 2.0], [1.0]], "object"),
    "complex": (ground() + 0j, "complex128"),
    "none": (np.zeros((0, 3)), f"at least {MIN_POINTS}"),
    "few": (ground()[: MIN_POINTS - 1], f"at least {MIN_POINTS}"),
    "few left": (np.where(np.arange(400)[:, None] < MIN_POINTS - 1, ground(), np.nan), "301 of 400"),
    "one point over and over": (np.ones((500, 3)), "exact repeat"),
    "column": (ground() * [0, 0, 1] + UTM, "point as seen from above"),
    "line": (ground()[:, :1] * [1.0, 2.0, 0.1], "line as seen from above"),
    "UTM in single precision": ((ground() + UTM).astype(np.float32), "double"),
    "half precision": (ground(size=100).astype(np.float16), "float16"),
    "millimetres": (ground() * 1000, "divide by 1000"),
    "millimetres of a dense rover cloud": (ground(count=200_000, size=5.0) * 1000, "divide by 1000"),
    "camera frame": (_wall(0), "z is up"),
    "camera frame, pitched": (_wall(18), "z is up"),
    "tower": (ground()[:, [2, 1, 0]] * [5, 0.2, 10], "tower"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_clouds_that_make_no_map_are_refused_with_the_cause(case):
    points, cause = BROKEN[case]
    with pytest.raises(TerrainLoopError, match=cause.replace("(", r"\(").replace(")", r"\)")):
        Submap(points)


def _strays():
    points = ground(count=5000)
    points[:20] = np.random.default_rng(2).normal(0, 1e5, (20, 3))
    return points


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(ground(3000, 40.0), id="airborne disc, 2 points a square metre"),
        pytest.param(ground(2500, 500.0), id="LiDAR submap, a point in 100 square metres"),
        pytest.param(ground(390_000, 2500.0), id="terrain model of 2.5 km, a post every 4 m"),
        pytest.param(_strays(), id="stray points"),
        pytest.param(ground().astype(np.float32), id="single precision"),
        pytest.param(np.round(100 * ground()).astype(int), id="integers"),
        pytest.param(ground() * [1, 0.1, 1], id="swath of 10 x 1 m"),
        *(
            pytest.param(
                Rotation.from_euler("zx", [azimuth, 45], degrees=True).apply(ground()),
                id=f"slope of 45 degrees towards {azimuth}",
            )
            for azimuth in (0, 70, 140)
        ),
    ],
)
def test_unusual_but_sound_clouds_pass(points):
    assert len(Submap(points)) == len(points)


def test_large_coordinates_stay_in_their_frame_and_are_noted():
    points = ground() + UTM
    submap = Submap(points)
    assert np.array_equal(submap.points, points)
    assert ["local origin" in repair for repair in submap.repairs] == [True]


@pytest.mark.parametrize("name", ["", "  ", "a/b", "a\\b", "a,b", "a\nb", "a\x00", "a\udc80"])
def test_names_that_break_files_are_refused(name):
    with pytest.raises(TerrainLoopError, match="rename"):
        Submap(ground(), name=name)


@pytest.mark.parametrize("intensity", [np.zeros(399), np.zeros((400, 2)), ["bright"] * 400])
def test_an_intensity_that_does_not_fit_is_refused(intensity):
    with pytest.raises(TerrainLoopError, match="intensity"):
        Submap(ground(), intensity=intensity)


def test_repairs_outlive_replace_and_pickle():
    submap = Submap(np.concatenate([ground() + UTM, ground()[:5] + UTM]))
    later = replace(submap, stamp=3.0)
    copy = pickle.loads(pickle.dumps(submap))
    assert len(submap.repairs) == 2
    assert later.repairs == copy.repairs == submap.repairs
    assert np.array_equal(copy.points, submap.points)


def test_arrays_are_read_only_and_the_callers_stay_as_they_are():
    points, intensity = ground(), np.arange(400.0)
    submap = Submap(points, intensity=intensity)
    for each in (submap, pickle.loads(pickle.dumps(submap)), replace(submap, name="b")):
        for array in (each.points, each.intensity):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0.0
    points[0] = intensity[0] = 7.0


def test_masked_points_are_not_taken():
    points = np.ma.masked_array(ground().astype(np.float32), np.arange(1200).reshape(400, 3) < 30)
    assert np.array_equal(Submap(points).points, ground().astype(np.float32)[10:])


@pytest.mark.parametrize("change", [{"name": None}, {"name": 7}, {"session": 3}, {"session": None}])
def test_labels_are_text(change):
    with pytest.raises(TerrainLoopError, match="rename"):
        Submap(ground(), **change)


@pytest.mark.parametrize("stamp", [np.nan, np.inf, "12", None, [1.0], 1j])
def test_a_stamp_is_a_finite_number(stamp):
    with pytest.raises(TerrainLoopError, match="stamp"):
        Submap(ground(), stamp=stamp)


def test_a_submap_describes_itself_in_a_line():
    assert repr(Submap(ground() * [1, 0.5, 1], name="a7")).startswith("Submap('a7', 400 points, 9.9")
    assert len(repr(Submap(ground()))) < 80
