"""Stray points far from the ground cost neither the map nor the mission."""

import numpy as np
import pytest

from terrainloop.gradient_map import GradientMap
from terrainloop.isolated import isolated_points


def ground(count=1500, side=8.0, slope=0.0, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-side / 2, side / 2, (count, 2))
    height = 0.1 * np.sin(2 * xy[:, 0]) * np.cos(1.5 * xy[:, 1]) + 0.01 * rng.standard_normal(count)
    return np.c_[xy, height + slope * xy[:, 0]]


rng = np.random.default_rng(7)
STRAYS = {
    "one in x": [[1300.0, 1.0, 0.2]],
    "one in -y": [[0.5, -900.0, 0.0]],
    "on the plane of a slope": [[800.0, 3.0, 320.0]],
    "many, all around": np.c_[rng.uniform(-1, 1, (20, 2)) * 4000, rng.normal(0, 0.3, 20)],
    "a cluster": np.c_[250 + rng.uniform(0, 2, (50, 2)), np.zeros(50)],
    "clusters on both sides": np.c_[rng.choice([-400, 500], 40), rng.uniform(-2, 2, 40), np.zeros(40)],
    "at the origin of UTM": [[-4e5, -4e6, 0.0]],
}


@pytest.mark.parametrize("strays", STRAYS.values(), ids=STRAYS)
def test_strays_are_dropped_and_the_ground_is_mapped(strays, caplog):
    cloud = ground(slope=0.4)
    given = {"length_scale": 0.8, "variance": 0.01, "noise": 0.01}
    clean = GradientMap.from_points(cloud, **given)
    made = GradientMap.from_points(np.insert(cloud, 100, strays, axis=0), **given)
    assert f"dropped {len(strays)} of" in caplog.text
    assert made.origin == pytest.approx(clean.origin, abs=1e-9)
    np.testing.assert_allclose(made.elevation, clean.elevation, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(made.mask, clean.mask)


def test_the_noise_of_strays_is_dropped_with_them():
    cloud = np.r_[[[900.0, 0.0, 0.0]], ground()]
    noise = np.r_[5.0, np.linspace(0.01, 0.02, len(cloud) - 1)]
    one, other = (
        GradientMap.from_points(points, 0.8, 0.01, each)
        for points, each in ((cloud, noise), (cloud[1:], noise[1:]))
    )
    assert one.variance.tobytes() == other.variance.tobytes()


def spinning(seed=0):
    """Rings whose density falls with the square of the range, to 80 m: real ground throughout."""
    rng = np.random.default_rng(seed)
    radius = 3 * (80 / 3) ** rng.uniform(0, 1, 4000) ** 2
    angle = rng.uniform(0, 2 * np.pi, 4000)
    return np.c_[radius * np.cos(angle), radius * np.sin(angle)]


@pytest.mark.parametrize(
    "xy",
    [
        ground()[:, :2],
        spinning(),
        np.r_[ground()[:, :2], [[16.0, 0.0]]],
        np.r_[ground()[:, :2], ground(300)[:, :2] + [60, 0]],
        np.random.default_rng(0).uniform(0, 1, (500, 2)) * [300, 3],
        np.tile([[1.0, 2.0]], (200, 1)),
    ],
    ids=["square", "spinning", "a point nearby", "a second piece of ground", "corridor", "one place"],
)
def test_real_ground_is_kept(xy):
    assert not isolated_points(xy).any()
