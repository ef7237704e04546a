"""The hyperparameters of wide clouds are those of submap-sized pieces of the same ground."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from terrainloop.gp.hyperparameters import fit_hyperparameters
from terrainloop.gp.training import PATCH_SIDE, detrend

STEP = 0.4  # metres between the nodes that the ground is interpolated from


def draw(side, length_scale, seed):
    """A draw from the prior of unit variance, (nodes, nodes): smoothed white noise."""
    nodes = int(side / STEP) + 1
    white = np.random.default_rng(seed).standard_normal((nodes, nodes))
    ground = gaussian_filter(white, length_scale / np.sqrt(2) / STEP, mode="wrap")
    return ground / ground.std()


def cloud_of(ground, side, density, noise=0.01, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side, (int(density * side**2), 2))
    height = map_coordinates(ground, xy.T[::-1] / STEP, order=3, mode="nearest")
    return np.c_[xy, height + noise * rng.standard_normal(len(xy))]


@pytest.mark.parametrize(("side", "length_scale"), [(30, 1.5), (100, 1.5), (200, 1.5), (200, 12.0)])
def test_length_scale_is_found_whatever_the_extent(side, length_scale):
    cloud = cloud_of(0.2 * draw(side, length_scale, seed=side), side, density=2.0)
    fitted = fit_hyperparameters([cloud], workers=2)
    assert fitted.length_scale == pytest.approx(length_scale, rel=0.15)
    assert fitted.noise == pytest.approx(0.01, rel=0.15)


@pytest.fixture(scope="module")
def rough():
    """Ground with shape at all scales, as real ground has, which a thin draw shows only the coarsest of."""
    scales = (1.0, 3.0, 9.0, 27.0)
    ground = sum(0.05 * scale * draw(180, scale, seed=k) for k, scale in enumerate(scales))
    return cloud_of(ground, 180, density=4.0)


def test_wide_cloud_is_fitted_as_its_pieces_are(rough):
    whole = fit_hyperparameters([rough], workers=2)
    pieces = []
    for corner in [(10, 10), (120, 20), (70, 130), (130, 120)]:
        inside = (np.abs(rough[:, :2] - corner - 20) < 20).all(axis=1)
        pieces.append(fit_hyperparameters([rough[inside]], workers=2).length_scale)
    assert whole.length_scale == pytest.approx(np.median(pieces), rel=0.2)


def test_one_wide_cloud_among_small_ones(rough):
    small = rough[(rough[:, :2] < 40).all(axis=1)]
    both, alone = (fit_hyperparameters(clouds, workers=2) for clouds in ([small, rough], [small]))
    assert both.length_scale == pytest.approx(alone.length_scale, rel=0.3)


def test_ordinary_submaps_are_one_patch(rough):
    for side in (10, 40, 44):
        data = detrend(rough[(rough[:, :2] < side).all(axis=1)])
        assert data.patches(PATCH_SIDE, remove_plane=True) == [data]


def test_patches_cover_the_ground_each_without_its_plane(rough):
    tilted = rough + [[0, 0, 0.3]] * rough[:, :1]
    patches = detrend(tilted).patches(PATCH_SIDE, remove_plane=True)
    assert len(patches) == 16
    assert sum(len(patch.xy) for patch in patches) == pytest.approx(len(rough), rel=0.001)
    for patch in patches:
        assert np.ptp(patch.xy, axis=0) == pytest.approx(45, abs=1)
        design = np.c_[patch.xy, np.ones(len(patch.xy))]
        np.testing.assert_allclose(np.linalg.lstsq(design, patch.elevation)[0], 0, atol=1e-9)
        again = patch.elevation + patch.centre[2] + (patch.xy) @ patch.slope
        nearest = np.abs(tilted[:, :2] - (patch.xy[0] + patch.centre[:2])).sum(axis=1).argmin()
        assert again[0] == pytest.approx(tilted[nearest, 2], abs=1e-9)


def test_the_exact_fit_of_a_wide_cloud_takes_one_patch(rough):
    thin = rough[::40]
    fitted = fit_hyperparameters([thin], exact=True, max_points=300, workers=2)
    patch = detrend(thin).patches(PATCH_SIDE, remove_plane=True)[0]
    assert fitted.variance < 4 * patch.elevation.var()
