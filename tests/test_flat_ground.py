"""Ground that is flat to rounding, as a whole or in patches, has a map, and it is flat."""

import numpy as np
import pytest

from terrainloop.gradient_map import GradientMap


def places(seed, count=800, side=10.0):
    return np.random.default_rng(seed).uniform(0, side, (count, 2))


@pytest.mark.parametrize("height", [0.0, 0.1, 0.7, -3.3, 5.3, 47.11, 1500.2, -8848.86])
def test_flat_at_any_height(height):
    for seed in range(3):
        xy = places(seed)
        made = GradientMap.from_points(np.c_[xy, np.full(len(xy), height)])
        assert np.abs(made.magnitude).max() < 1e-9
        np.testing.assert_allclose(made.elevation, height, rtol=1e-6, atol=1e-12)
        assert made.mask.all()


@pytest.mark.parametrize("solver", ["spline", "exact"])
@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.3], [4e5, 4e6, 612.9]])
def test_exact_planes(shift, solver):
    for seed in range(3):
        xy = places(seed, 300)
        cloud = np.c_[xy, 0.31 * xy[:, 0] - 0.17 * xy[:, 1]] + shift
        made = GradientMap.from_points(cloud, solver=solver)
        np.testing.assert_allclose(made.gradient_x, 0.31, atol=1e-5)
        np.testing.assert_allclose(made.gradient_y, -0.17, atol=1e-5)


@pytest.mark.parametrize("given", [{"length_scale": 0.5}, {"variance": 0.01}, {"noise": 0.02}])
def test_flat_with_a_number_given(given):
    xy = places(1)
    made = GradientMap.from_points(np.c_[xy, np.full(len(xy), 2.3)], **given, resolution=0.2)
    assert np.abs(made.magnitude).max() < 1e-9


@pytest.mark.parametrize("step", [1e-3, 1e-2])
def test_quantised_elevations(step):
    """Most cells show no scatter at all, which must not make outliers of the others."""
    xy = places(2, 4000)
    height = 0.1 * np.sin(0.8 * xy[:, 0]) * np.cos(0.6 * xy[:, 1])
    made = GradientMap.from_points(np.c_[xy, np.round(height, -int(np.log10(step)))], resolution=0.25)
    rows, columns = np.indices(made.mask.shape)
    x, y = made.origin[0] + 0.25 * columns, made.origin[1] + 0.25 * rows
    slope = 0.08 * np.cos(0.8 * x) * np.cos(0.6 * y)
    assert made.mask.mean() > 0.9
    assert np.sqrt(np.mean((made.gradient_x - slope)[made.mask] ** 2)) < 0.01


@pytest.mark.parametrize(("share", "side", "count"), [(0.5, 10, 2500), (0.8, 10, 2500), (0.7, 12, 30_000)])
def test_a_lake_does_not_drown_its_shore(share, side, count):
    """Neither by its plane, nor by its scatter, which would make outliers of the shore."""
    xy = places(3, count, side)
    height = 0.2 * np.sin(2 * xy[:, 0]) * np.cos(2 * xy[:, 1])
    height += 0.01 * np.random.default_rng(4).standard_normal(len(xy))
    lake = xy[:, 0] < side * share
    made = GradientMap.from_points(np.c_[xy, np.where(lake, 2.5, 2.5 + height)], resolution=0.2)
    columns = int(side * share / 0.2)
    assert made.mask[:, columns + 3 :].mean() > 0.9
    assert np.ptp(made.elevation[:, columns + 3 :]) == pytest.approx(0.4, abs=0.1)
    assert made.elevation[5:-5, 5 : columns - 8] == pytest.approx(2.5, abs=0.02)
