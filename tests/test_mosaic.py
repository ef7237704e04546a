"""The mosaic of a drive is the ground, where it was seen."""

import numpy as np
import pytest
from conftest import map_of

from terrainloop.geometry import inverse, se2, se3, transform
from terrainloop.slam.mosaic import mosaic

tifffile = pytest.importorskip("tifffile")


def hills(xy):
    """Heights (N,) and slopes (N, 2) of the world."""
    x, y = xy.T
    height = 0.3 * np.sin(0.9 * x) * np.cos(0.7 * y) + 50.0
    slopes = 0.3 * np.c_[0.9 * np.cos(0.9 * x) * np.cos(0.7 * y), -0.7 * np.sin(0.9 * x) * np.sin(0.7 * y)]
    return height, slopes


def seen_from(x, y, yaw):
    """A map of the hills in a frame at a height of 50 m."""
    T = se2(x, y, yaw)

    def ground(xy):
        height, slopes = hills(xy)
        return height - 50.0, slopes

    return map_of(ground, T)


POSES = [(0.0, 0.0, 0.0), (2.5, 1.0, 1.2), (5.0, -0.5, -2.0)]


@pytest.fixture(scope="module")
def made():
    poses = np.array([se3(x, y, 50.0, 0, 0, yaw) for x, y, yaw in POSES])
    return mosaic([seen_from(*pose) for pose in POSES], poses)


def positions(made):
    rows, columns = np.nonzero(made.mask)
    return np.array(made.origin) + made.resolution * np.c_[columns, rows]


def test_heights_and_slopes_are_those_of_the_world(made):
    height, slopes = hills(positions(made))
    error = np.abs(made.elevation[made.mask] - height)
    assert np.median(error) < 0.002
    assert error.max() < 0.02  # at the edge of a map
    assert np.abs(made.gradient_x[made.mask] - slopes[:, 0]).max() < 0.02
    assert np.abs(made.gradient_y[made.mask] - slopes[:, 1]).max() < 0.02


def test_it_covers_what_the_maps_cover_and_no_more(made):
    inside = np.zeros(made.mask.sum(), dtype=bool)
    for x, y, yaw in POSES:
        local = transform(inverse(se2(x, y, yaw)), positions(made))
        inside |= (np.abs(local - [-0.04, -0.14]) < [2.1, 2.5]).all(axis=1)
    assert inside.all()
    assert made.mask.sum() * made.resolution**2 == pytest.approx(45.0, rel=0.1)
    assert np.isnan(made.variance[~made.mask]).all()


def test_where_maps_overlap_they_are_averaged_by_their_variance():
    one, two = (map_of(lambda xy, z=z: (np.full(len(xy), z), np.zeros(xy.shape))) for z in (0.0, 0.3))
    object.__setattr__(two, "variance", 2 * two.variance)
    made = mosaic([one, two], np.tile(np.eye(4), (2, 1, 1)))
    assert np.nanmedian(made.elevation) == pytest.approx(0.1, abs=1e-6)
    assert np.nanmedian(made.variance) == pytest.approx(2 / 3 * 1e-4, rel=1e-4)


def test_a_tilted_pose_tilts_the_ground():
    flat = map_of(lambda xy: (np.zeros(len(xy)), np.zeros(xy.shape)))
    made = mosaic([flat], se3(0, 0, 0, 0, -0.02, 0)[None])
    assert np.nanmedian(made.gradient_x) == pytest.approx(0.02, rel=0.01)
    x = positions(made)[:, 0]
    np.testing.assert_allclose(made.elevation[made.mask], 0.02 * x, atol=1e-3)


def test_a_large_mosaic_is_made_coarser(monkeypatch):
    monkeypatch.setattr("terrainloop.slam.mosaic.MAX_PIXELS", 2000)
    made = mosaic([seen_from(*POSES[0])], se3(0, 0, 50.0, 0, 0, 0)[None])
    assert made.elevation.size < 2300
    height, _ = hills(positions(made))
    assert np.abs(made.elevation[made.mask] - height).max() < 0.03


def test_far_from_the_origin_no_digit_is_lost(made):
    far = np.array([5e5, 4.2e6, 1200.0])
    poses = np.array([se3(x + far[0], y + far[1], 50.0 + far[2], 0, 0, yaw) for x, y, yaw in POSES])
    moved = mosaic([seen_from(*pose) for pose in POSES], poses)
    assert moved.elevation.shape == made.elevation.shape
    both = moved.mask & made.mask
    assert np.abs(moved.elevation[both] - far[2] - made.elevation[both]).max() < 0.01


def test_it_is_written_as_geotiff(made, tmp_path):
    made.write(tmp_path / "map.tif")
    bands = tifffile.imread(tmp_path / "map.tif")
    assert sorted(bands.shape)[0] == 4
    assert np.isnan(bands).any()
