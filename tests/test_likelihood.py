"""Hyperparameters from every point: the likelihood of blocks, and the fit by it."""

from dataclasses import replace

import numpy as np
import pytest

from terrainloop import _core
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.hyperparameters import (
    FitOptions,
    fit_blocks,
    fit_hyperparameters,
    fit_noise,
    maximise_likelihood,
    negative_log_likelihood,
)
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.training import TrainingData, detrend

TRUTH = Hyperparameters(length_scale=0.25, variance=0.04, noise=0.02)


def draw(count, extent, truth=TRUTH, seed=0, relative_noise=None):
    """A surface drawn from the prior, by its Fourier series over a period far beyond its extent."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-extent / 2, extent / 2, (count, 2))
    wave = 2 * np.pi / (extent + 8 * truth.length_scale) * np.arange(100)
    power = np.where(wave > 0, 2, 1) * np.exp(-((wave * truth.length_scale) ** 2) / 2)
    root = np.sqrt(np.tile(power / power.sum(), 2))
    along_x, along_y = (
        root * np.hstack([np.cos(t[:, None] * wave), np.sin(t[:, None] * wave)]) for t in xy.T
    )
    smooth = np.einsum("ij,ij->i", along_y @ rng.standard_normal((200, 200)), along_x)
    share = np.ones(count) if relative_noise is None else relative_noise
    elevation = np.sqrt(truth.variance) * smooth + truth.noise * share * rng.standard_normal(count)
    return TrainingData(xy, elevation, np.zeros(3), np.zeros(2), share)


def blocks_of(surface, about=TRUTH, side=2.0, work=1e12):
    data = [(surface.xy, surface.elevation, surface.relative_noise)]
    numbers = {"length_scale": about.length_scale, "variance": about.variance, "noise": about.noise}
    return _core.gp_block_likelihood(data, **numbers, side=side, work=work)


@pytest.fixture(scope="module")
def surface():
    return draw(400, 2.0, relative_noise=np.random.default_rng(1).uniform(0.5, 2.0, 400))


@pytest.mark.parametrize("factors", [(1, 1, 1), (1.2, 0.7, 1.1), (2.5, 3, 2), (12, 1, 1)])
def test_one_block_has_the_dense_likelihood(surface, factors):
    numbers = np.array([0.25, 0.04, 0.02]) * factors
    likelihood, blocks, _, points = blocks_of(surface)
    assert (blocks, points) == (1, 400)
    value, gradient = likelihood(*numbers)
    data = (surface.xy, surface.elevation, surface.relative_noise)
    expected, expected_gradient = negative_log_likelihood(np.log(numbers), *data)
    assert value == pytest.approx(expected, rel=1e-3, abs=1e-3 * points)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=0.01, atol=1.0)


@pytest.mark.parametrize("factors", [(1, 1, 1), (1.2, 0.7, 1.1), (2.5, 3, 2)])
def test_gradient_equals_finite_differences(surface, factors):
    likelihood, blocks, _, _ = blocks_of(surface, side=0.9)
    at = np.log(np.array([0.25, 0.04, 0.02]) * factors)
    steps = 1e-5 * np.eye(3)
    differences = [(likelihood(*np.exp(at + s))[0] - likelihood(*np.exp(at - s))[0]) / 2e-5 for s in steps]
    assert blocks == 9
    np.testing.assert_allclose(likelihood(*np.exp(at))[1], differences, rtol=1e-5, atol=1e-3)


def test_blocks_are_independent(surface):
    whole, blocks, _, _ = blocks_of(surface, side=1.01)
    corners = (surface.xy > (surface.xy.min(axis=0) + surface.xy.max(axis=0)) / 2) @ [1, 2]
    data = (surface.xy, surface.elevation, surface.relative_noise)
    parts = [
        negative_log_likelihood(np.log([0.25, 0.04, 0.02]), *(each[corners == corner] for each in data))
        for corner in range(4)
    ]
    assert blocks == 4
    assert whole(0.25, 0.04, 0.02)[0] == pytest.approx(sum(part[0] for part in parts), rel=1e-3)


def test_a_part_of_the_blocks_is_spread_over_the_ground():
    surface = draw(4000, 10.0)
    _, blocks, rank, points = blocks_of(surface, side=1.0)
    assert blocks == 100
    _, some, _, fewer = blocks_of(surface, side=1.0, work=25 * rank**3)
    assert (points, some) == (4000, 25)
    assert fewer == pytest.approx(1000, rel=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_fit_recovers_what_a_dense_cloud_was_drawn_from(seed):
    surface = draw(15_000, 6.0, seed=seed)
    fitted = fit_blocks([surface], surface.start(None, None, None), workers=2)
    assert fitted.length_scale == pytest.approx(TRUTH.length_scale, rel=0.04)
    assert fitted.noise == pytest.approx(TRUTH.noise, rel=0.02)
    assert fitted.variance == pytest.approx(TRUTH.variance, rel=0.3)


def test_fit_is_near_the_dense_one_where_the_terrain_is_no_draw_from_the_prior():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-2.5, 2.5, (1000, 2))
    rocks = rng.uniform(-2.5, 2.5, (40, 2))
    distances = np.linalg.norm(xy[:, None] - rocks, axis=2)
    elevation = 0.3 * np.sin(xy[:, 0]) + 0.15 * np.exp(-((distances / 0.25) ** 2)).sum(axis=1)
    elevation += 0.03 * rng.standard_normal(1000)
    surface = detrend(np.c_[xy, elevation])
    start = surface.start(None, None, None)
    dense = maximise_likelihood([surface], start, workers=2)
    fitted = fit_blocks([surface], start, workers=2)
    assert fitted.length_scale == pytest.approx(dense.length_scale, rel=0.1)
    assert fitted.noise == pytest.approx(dense.noise, rel=0.05)


def test_fit_does_not_depend_on_workers():
    surfaces = [draw(3000, 4.0, seed=seed) for seed in range(2)]
    start = surfaces[0].start(None, None, None)
    assert fit_blocks(surfaces, start, workers=1) == fit_blocks(surfaces, start, workers=3)


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_fit_hardly_depends_on_its_start(factor):
    surface = draw(5000, 4.0)
    start = surface.start(None, None, None)
    other = Hyperparameters(factor * start.length_scale, 3 * start.variance, start.noise / 3)
    fitted = [fit_blocks([surface], begin, workers=2).length_scale for begin in (start, other)]
    assert fitted[0] == pytest.approx(fitted[1], rel=0.05)


def test_relative_noise_weighs_the_points():
    share = np.where(np.arange(3000) % 2 == 0, 0.5, 4.0)
    surface = draw(3000, 3.0, relative_noise=share)
    fitted = fit_blocks([surface], surface.start(None, None, None), workers=2)
    assert fitted.noise == pytest.approx(TRUTH.noise, rel=0.05)
    assert fitted.length_scale == pytest.approx(TRUTH.length_scale, rel=0.1)


@pytest.mark.parametrize("fixed", [["noise"], ["length_scale"], ["variance", "length_scale"]])
def test_fixed_hyperparameters_stay(surface, fixed):
    start = Hyperparameters(0.4, 0.1, 0.05)
    fitted = fit_blocks([surface], start, fixed=fixed)
    for name in ("length_scale", "variance", "noise"):
        assert (getattr(fitted, name) == pytest.approx(getattr(start, name), rel=1e-9)) == (name in fixed)


@pytest.mark.parametrize("noise", [0.002, 0.02, 0.2])
def test_the_noise_of_a_cloud_is_found_whatever_that_of_the_database(noise):
    cloud = draw(3000, 3.0, replace(TRUTH, noise=noise))
    fitted = fit_noise(cloud, TRUTH, FitOptions())
    assert fitted.noise == pytest.approx(noise, rel=0.1)
    assert replace(fitted, noise=TRUTH.noise) == TRUTH


def test_the_noise_of_a_few_drawn_points_is_that_of_all():
    cloud = draw(6000, 4.0)
    few, many = (fit_noise(cloud, TRUTH, FitOptions(count)).noise for count in (2000, None))
    assert few == pytest.approx(many, rel=0.15)


def test_ground_without_any_scatter_keeps_a_noise_that_can_be_solved():
    rng = np.random.default_rng(0)
    flat = detrend(np.c_[rng.uniform(0, 5, (2000, 2)), np.zeros(2000)])
    assert fit_noise(flat, TRUTH, FitOptions()).noise == pytest.approx(1e-4 * TRUTH.variance**0.5, rel=0.1)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_flat_ground_is_fitted(noise):
    rng = np.random.default_rng(0)
    cloud = np.c_[rng.uniform(0, 5, (2000, 2)), noise * rng.standard_normal(2000)]
    fitted = fit_hyperparameters([cloud])
    assert np.isfinite([fitted.length_scale, fitted.variance, fitted.noise]).all()
    if noise:
        assert fitted.noise == pytest.approx(noise, rel=0.1)


def test_few_points_and_one_block_are_fitted():
    truth = Hyperparameters(3.0, 0.04, 0.01)
    surface = draw(100, 5.0, truth)
    fitted = fit_blocks([surface], Hyperparameters(0.5, 0.01, 0.05))
    assert 1.0 < fitted.length_scale < 5.0
    assert fitted.noise == pytest.approx(truth.noise, rel=0.3)


def test_a_stray_point_does_no_harm():
    surface = draw(3000, 3.0)
    xy, elevation = np.r_[surface.xy, [[1e6, 2e6]]], np.r_[surface.elevation, 0.0]
    stray = TrainingData(xy, elevation, np.zeros(3), np.zeros(2), np.ones(3001))
    fitted = fit_blocks([stray], surface.start(None, None, None), workers=2)
    assert fitted.length_scale == pytest.approx(TRUTH.length_scale, rel=0.1)


def test_numbers_that_make_no_model_are_refused(surface):
    with pytest.raises(ValueError, match="positive"):
        blocks_of(surface, side=-1.0)
    with pytest.raises(ValueError, match="noise must be positive"):
        blocks_of(TrainingData(surface.xy, surface.elevation, np.zeros(3), np.zeros(2), np.zeros(400)))


def test_where_drawn_points_show_only_noise_more_are_drawn():
    """On 20 x 20 m 300 points lie five length scales apart."""
    wide = draw(30_000, 20.0)
    cloud = np.c_[wide.xy, wide.elevation]
    fitted = fit_hyperparameters([cloud], max_points=300, remove_plane=False)
    assert fitted.length_scale == pytest.approx(TRUTH.length_scale, rel=0.15)
    assert fitted.noise == pytest.approx(TRUTH.noise, rel=0.15)


def test_too_many_points_for_the_dense_fit_are_refused():
    with pytest.raises(TerrainLoopError, match="max_points"):
        maximise_likelihood([draw(30_000, 20.0)], TRUTH)
