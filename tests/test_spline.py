"""The fast solver against the exact one, and the noise it is given."""

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.gp import exact, spline
from terrainloop.gp.grid import Grid
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.process import ElevationProcess
from terrainloop.gradient_map import GradientMap

FIELDS = ("elevation", "gradient_x", "gradient_y", "variance", "gradient_variance")


def draw(count, side, parameters, seed=0):
    """Points of a surface drawn from the prior, by random Fourier features."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side, (count, 2))
    frequency = rng.standard_normal((2, 500)) / parameters.length_scale
    phase = rng.uniform(0, 2 * np.pi, 500)
    smooth = np.sqrt(2 * parameters.variance / 500) * np.cos(xy @ frequency + phase).sum(axis=1)
    return xy, smooth + parameters.noise * rng.standard_normal(count)


def grid(side, pixels):
    return Grid((0.0, 0.0), side / (pixels - 1), (pixels, pixels))


def errors(fast, reference, variance):
    """Gradient RMSE as a share; errors of the standard deviations: median and 99th percentile."""
    known = reference.variance < 0.1 * variance
    assert known.mean() > 0.3
    off = np.hypot(fast.gradient_x - reference.gradient_x, fast.gradient_y - reference.gradient_y)[known]
    whole = np.hypot(reference.gradient_x, reference.gradient_y)[known]
    gradient = np.sqrt(np.mean(off**2) / np.mean(whole**2))
    shares = [
        np.abs(np.sqrt(getattr(fast, name) / getattr(reference, name)) - 1)[known]
        for name in ("variance", "gradient_variance")
    ]
    return gradient, *[(np.median(share), np.percentile(share, 99)) for share in shares]


CASES = {
    "paper": (1800, 6.0, Hyperparameters(0.316, 0.04, 0.02)),
    "little noise": (1800, 6.0, Hyperparameters(0.316, 0.04, 0.005)),
    "dense": (2500, 2.0, Hyperparameters(0.316, 0.04, 0.01)),
    "a subdomain or less": (300, 3.0, Hyperparameters(1.5, 0.3, 0.05)),
    "long": (300, 3.0, Hyperparameters(6.0, 0.3, 0.05)),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_equals_the_exact_process(case):
    count, side, parameters = case
    xy, z = draw(count, side, parameters)
    noise = np.full(count, parameters.noise)
    fast, reference = (
        solver.predict_grid(xy, z, noise, parameters, grid(side, 50)) for solver in (spline, exact)
    )
    gradient, std, gradient_std = errors(fast, reference, parameters.variance)
    assert gradient < 1e-3
    assert std[0] < 5e-3
    assert std[1] < 2.5e-2
    assert gradient_std[0] < 1e-2
    assert gradient_std[1] < 4e-2
    off = np.abs(fast.elevation - reference.elevation).max()
    assert off < 5e-3 * np.sqrt(parameters.variance)


def test_noise_of_each_point_equals_the_exact_process():
    parameters = Hyperparameters(0.4, 0.04, 0.02)
    xy, z = draw(800, 3.0, parameters)
    ratio = np.where(xy[:, 0] > 1.5, 8.0, 0.5)
    fast, reference = (
        solver.predict_grid(xy, z, parameters.noise * ratio, parameters, grid(3.0, 40))
        for solver in (spline, exact)
    )
    gradient, std, _ = errors(fast, reference, parameters.variance)
    assert gradient < 1e-3
    assert std[0] < 5e-3
    halves = np.split(fast.variance, 2, axis=1)
    assert np.median(halves[1]) > 5 * np.median(halves[0])


def test_threads_do_not_change_a_byte():
    parameters = Hyperparameters(0.2, 0.04, 0.02)
    xy, z = draw(20_000, 6.0, parameters)
    noise = np.full(len(xy), 0.02)
    one, *others = (
        spline.predict_grid(xy, z, noise, parameters, grid(6.0, 80), workers=workers) for workers in (1, 2, 3)
    )
    for other in others:
        for name in FIELDS:
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    ratios = [spline.noise_ratio(xy, z, 0.2, workers=workers) for workers in (1, 3)]
    assert ratios[0].tobytes() == ratios[1].tobytes()


def test_a_grid_may_lie_anywhere():
    """A finer grid of another origin has the same field, and far off the points the prior remains."""
    parameters = Hyperparameters(0.4, 0.04, 0.02)
    xy, z = draw(1000, 4.0, parameters)
    noise = np.full(len(xy), 0.02)
    wide = spline.predict_grid(xy, z, noise, parameters, Grid((-8.0, -8.0), 0.1, (200, 200)))
    part = spline.predict_grid(xy, z, noise, parameters, Grid((1.0, 2.0), 0.05, (21, 31)))
    for name in FIELDS[:3]:
        coarse, fine = getattr(wide, name)[100:111, 90:106], getattr(part, name)[::2, ::2]
        np.testing.assert_allclose(coarse, fine, rtol=0, atol=2e-3 * np.abs(coarse).max(), err_msg=name)
    np.testing.assert_allclose(wide.variance[100:111, 90:106], part.variance[::2, ::2], rtol=0.05)
    assert wide.elevation[0, 0] == 0.0
    assert wide.variance[0, 0] == pytest.approx(parameters.variance)
    assert wide.gradient_variance[0, 0] == pytest.approx(parameters.variance / 0.4**2)


def test_a_hole_is_not_known():
    parameters = Hyperparameters(0.3, 0.04, 0.01)
    xy, z = draw(6000, 6.0, parameters)
    outside = np.hypot(*(xy - 3.0).T) > 1.2
    field = spline.predict_grid(
        xy[outside], z[outside], np.full(outside.sum(), 0.01), parameters, Grid((3.0, 3.0), 0.1, (2, 2))
    )
    np.testing.assert_allclose(field.variance, parameters.variance, rtol=0.02)


def test_places_equal_the_grid():
    parameters = Hyperparameters(0.3, 0.04, 0.02)
    xy, z = draw(3000, 5.0, parameters)
    noise = np.full(len(xy), 0.02)
    regular = grid(5.0, 23)
    on_grid = spline.predict_grid(xy, z, noise, parameters, regular)
    rows, columns = np.indices(regular.shape)
    order = np.random.default_rng(0).permutation(rows.size)
    places = regular.resolution * np.stack([columns.ravel(), rows.ravel()], axis=-1)[order]
    alone = spline.predict_at(xy, z, noise, parameters, places, workers=2)
    for name in FIELDS:
        expected = getattr(on_grid, name).ravel()[order]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(getattr(alone, name), expected, rtol=1e-4, atol=1e-5 * scale, err_msg=name)


def test_what_cannot_be_solved_is_an_error():
    xy = np.repeat(np.random.default_rng(0).uniform(0, 1, (200, 2)), 2, axis=0)
    z = np.random.default_rng(1).standard_normal(400)
    with pytest.raises(TerrainLoopError, match="raise the noise"):
        spline.predict_grid(
            xy, z, np.full(400, 1e-9), Hyperparameters(0.5, 1.0, 1e-9), Grid((0, 0), 0.1, (10, 10))
        )


def ground(count=20_000, side=6.0, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side, (count, 2))
    height = 0.1 * np.sin(2 * xy[:, 0]) * np.cos(1.5 * xy[:, 1])
    return xy, height, rng


def test_noise_ratio_follows_the_noise():
    xy, height, rng = ground()
    deviation = np.where(xy[:, 0] > 3.0, 0.03, 0.01)
    ratio = spline.noise_ratio(xy, height + deviation * rng.standard_normal(len(xy)), 0.5)
    near, far = xy[:, 0] < 2.0, xy[:, 0] > 4.0
    assert np.median(ratio[far]) / np.median(ratio[near]) == pytest.approx(3.0, rel=0.1)


def test_noise_ratio_is_constant_where_points_are_too_sparse():
    xy = 0.5 * np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    height = np.random.default_rng(0).standard_normal(len(xy))
    np.testing.assert_array_equal(spline.noise_ratio(xy, height, 0.6), 1.0)


def test_points_of_one_patch_count_as_one():
    """Ten times the points, with the errors of their neighbours, say no more of the ground."""
    xy, height, rng = ground(3000)
    many = np.repeat(xy, 10, axis=0) + rng.uniform(0, 1e-3, (30_000, 2))
    parameters = Hyperparameters(0.5, 0.01, 0.02)
    variances = []
    for places, z in ((xy, height), (many, np.repeat(height, 10))):
        noise = parameters.noise * spline.noise_ratio(places, z, parameters.length_scale)
        made = spline.predict_grid(places, z, noise, parameters, Grid((1.0, 1.0), 0.2, (20, 20)))
        variances.append(made.variance)
    assert np.median(variances[1] / variances[0]) == pytest.approx(1.0, abs=0.1)


def flying(xy, height, rng, count=60):
    """The cloud with a few points high above the ground, and which these are."""
    chosen = rng.choice(len(xy), count, replace=False)
    lifted = height + 0.01 * rng.standard_normal(len(xy))
    lifted[chosen] += rng.uniform(0.3, 0.8, count)
    return np.c_[xy, lifted], chosen


def test_flying_pixels_raise_no_spikes():
    xy, height, rng = ground()
    points, chosen = flying(xy, height, rng)
    options = {"length_scale": 0.4, "variance": 0.01, "noise": 0.01, "resolution": 0.05}
    spikes = {}
    for local_noise in (True, False):
        process = ElevationProcess.from_points(
            points,
            *[options[name] for name in ("length_scale", "variance", "noise")],
            remove_plane=False,
            local_noise=local_noise,
        )
        spikes[local_noise] = np.abs(process.predict_at(xy[chosen]).elevation - height[chosen]).max()
    assert spikes[True] < 0.015
    assert spikes[False] > 0.03


def test_growing_noise_bends_gradients_less_than_constant_noise():
    """As stereo's noise grows with range: local noise brings the gradients closer to the true ones."""
    xy, height, rng = ground(30_000)
    points = np.c_[xy, height + (0.005 + 0.01 * xy[:, 0] ** 2 / 6) * rng.standard_normal(len(xy))]
    rmse = {}
    for local_noise in (True, False):
        made = GradientMap.from_points(
            points, 0.4, 0.01, 0.02, 0.05, remove_plane=False, local_noise=local_noise
        )
        rows, columns = np.indices(made.mask.shape)
        x, y = made.origin[0] + 0.05 * columns, made.origin[1] + 0.05 * rows
        slope_x = 0.2 * np.cos(2 * x) * np.cos(1.5 * y)
        slope_y = -0.15 * np.sin(2 * x) * np.sin(1.5 * y)
        rmse[local_noise] = np.sqrt(
            np.mean((made.gradient_x - slope_x) ** 2 + (made.gradient_y - slope_y) ** 2)
        )
    assert rmse[True] < 0.9 * rmse[False]


def test_given_noise_of_each_point_is_used_as_it_is():
    xy, height, _ = ground(2000)
    noise = np.where(xy[:, 0] > 3.0, 0.05, 0.01)
    process = ElevationProcess.from_points(np.c_[xy, height], 0.5, 0.01, noise, remove_plane=False)
    np.testing.assert_allclose(process.noise, noise)
    assert process.parameters.noise == pytest.approx(np.median(noise))


@pytest.mark.parametrize("noise", [[0.01, 0.02], -0.01, 0.0, np.nan])
def test_impossible_noise_is_an_error(noise):
    xy, height, _ = ground(500)
    with pytest.raises(TerrainLoopError, match="positive"):
        GradientMap.from_points(np.c_[xy, height], 0.5, 0.01, noise)


def test_asked_for_grid(world):
    xy = np.random.default_rng(0).uniform(0, 3, (800, 2))
    made = GradientMap.from_points(
        np.c_[xy, world(2).height(xy)], 0.4, 0.01, 0.01, 0.1, origin=(1.0, 0.5), shape=(12, 20)
    )
    assert made.origin == (1.0, 0.5)
    assert made.elevation.shape == (12, 20)
    to_the_end = GradientMap.from_points(
        np.c_[xy, world(2).height(xy)], 0.4, 0.01, 0.01, 0.1, origin=(1.0, 0.5)
    )
    assert to_the_end.elevation.shape == (25, 20)
    np.testing.assert_allclose(to_the_end.elevation[:12], made.elevation, atol=1e-6)


def test_points_scattered_far_and_wide_are_refused_at_once():
    """Too many to be strays: no one can say where the ground is."""
    xy, height, rng = ground(5000)
    wide = np.vstack([np.c_[xy, height], np.c_[rng.uniform(-900, 900, (400, 2)), np.zeros(400)]])
    for given in [{"length_scale": 0.3, "resolution": 0.03}, {"length_scale": 30.0, "resolution": 0.03}]:
        with pytest.raises(TerrainLoopError, match="outlier"):
            GradientMap.from_points(wide, **given, remove_plane=False)


def test_too_many_points_for_the_exact_solver_are_refused():
    xy, height, _ = ground(30_000)
    with pytest.raises(TerrainLoopError, match="max_points"):
        GradientMap.from_points(np.c_[xy, height], 0.3, 0.01, 0.01, 0.1, solver="exact")


def test_places_must_be_places():
    xy, height, _ = ground(500)
    process = ElevationProcess.from_points(np.c_[xy, height], 0.5, 0.01, 0.01)
    with pytest.raises(TerrainLoopError, match="Q, 2"):
        process.predict_at([1.0, 2.0])
    for name in FIELDS:
        assert getattr(process.predict_at(np.empty((0, 2))), name).shape == (0,)
