"""Clouds of which a map could be made but should not: reported; sound ones: not."""

import numpy as np
import pytest
from clouds_util import DATA, ground
from scipy.spatial.transform import Rotation

from terrainloop.gradient_map import GradientMap
from terrainloop.io import load_mission, read_cloud
from terrainloop.submap import Submap


def _rough(count=6000, seed=0):
    return ground(count, seed=seed)


def _above(height, count=6000):
    return np.add(ground(count, seed=1), [0, 0, height])


def _tilted(degrees, axis="x"):
    even = _rough() * [1, 1, 0.05]
    return Rotation.from_euler(axis, degrees, degrees=True).apply(even)


def _ball(count=3000):
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return 5 * directions / np.linalg.norm(directions, axis=1)[:, None]


def _room():
    rng = np.random.default_rng(0)
    points, face = rng.uniform(0, [8, 6, 3], (9000, 3)), rng.integers(0, 6, 9000)
    for k in range(6):
        points[face == k, k // 2] = (8, 6, 3)[k // 2] * (k % 2)
    return points + rng.normal(0, 0.01, points.shape)


DOUBTFUL = {
    "mine gallery": (np.vstack([_rough(), _above(3.0)]), "two layers"),
    "sparse roof": (np.vstack([_rough(), _above(2.0, 1500)]), "two layers"),
    "roof over half": (np.vstack([_rough(), _above(3.0) * [0.5, 1, 1]]), "two layers"),
    "room": (_room(), "two layers"),
    "ball": (_ball(), "two layers"),
    "random": (np.random.default_rng(0).uniform(0, 7, (400, 3)), "fill a volume"),
    "many random": (np.random.default_rng(1).normal(0, 2, (50_000, 3)), "fill a volume"),
    "tilted": (_tilted(25), "tilted by 25 deg"),
    "tilted about y": (_tilted(-30, "y"), "tilted by 30 deg"),
    "steep": (Rotation.from_euler("x", 50, degrees=True).apply(_rough()), "is z up"),
    "centimetres": (_rough() * 100, "centimetres"),
    "kilometres": (_rough() / 1000, "kilometres"),
}


@pytest.mark.parametrize("case", DOUBTFUL)
def test_doubtful_clouds_are_reported_in_a_line(case, caplog):
    points, said = DOUBTFUL[case]
    submap = Submap(points, name="s")
    (words,) = submap.warnings
    assert said in words
    assert "\n" not in words
    assert [record.getMessage() for record in caplog.records] == [f"s: {words}"]


@pytest.mark.parametrize(
    "points",
    [
        pytest.param(_rough(), id="rough"),
        pytest.param(_rough(100), id="fewest"),
        pytest.param(_rough() * [1, 1, 0], id="flat"),
        pytest.param(_rough() * [1, 1, 4], id="hilly"),
        pytest.param(_tilted(12), id="even slope"),
        pytest.param(Rotation.from_euler("y", 32, degrees=True).apply(_rough()), id="rough slope"),
        pytest.param(np.add(_rough(), [4e5, 4e6, 1500.0]), id="UTM"),
        pytest.param(ground(5000, 480.0), id="LiDAR of long range"),
        pytest.param(np.vstack([_rough(), _above(2.0, 300)]), id="flying points"),
        pytest.param(np.repeat(_rough(500), 40, axis=0) + np.linspace(0, 1e-4, 20_000)[:, None], id="clumps"),
    ],
)
def test_sound_clouds_are_not_reported(points):
    assert Submap(points).warnings == ()


def test_maps_that_observe_little_say_so():
    rng = np.random.default_rng(0)
    scatter = rng.uniform(0, [6, 6, 2], (400, 3))
    (words,) = GradientMap.from_points(scatter).warnings
    assert "of the map is observed: heights scatter by" in words
    apart = ground(150, 30.0)
    (words,) = GradientMap.from_points(apart, length_scale=0.3, variance=0.1, noise=0.01).warnings
    assert "too few" in words
    assert GradientMap.from_points(_rough()).warnings == ()


def _real_clouds():
    yield from sorted((DATA / "stereo_clouds").glob("*.ply"))
    for mission in ("fortbragg_r20", "offroad_scans", "pozo_r20"):
        yield from load_mission(DATA / "missions" / mission).files[::10]


@pytest.mark.skipif(not DATA.is_dir(), reason="real data absent")
def test_no_real_cloud_is_reported():
    assert [file.name for file in _real_clouds() if read_cloud(file).warnings] == []
