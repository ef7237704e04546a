"""The exact GP against finite differences, scikit-learn and its own equations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import check_grad
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.exact import predict_at, predict_grid
from terrainloop.gp.grid import Grid
from terrainloop.gp.hyperparameters import fit_hyperparameters, maximise_likelihood, negative_log_likelihood
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.process import ElevationProcess
from terrainloop.gp.training import TrainingData

PARAMETERS = Hyperparameters(length_scale=0.3, variance=0.04, noise=0.02)


def draw_surface(seed=0, count=300, extent=3.0, parameters=PARAMETERS):
    """Points of a surface drawn from the prior itself."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, extent, (count, 2))
    distances = ((xy[:, None] - xy) ** 2).sum(-1)
    covariance = parameters.variance * np.exp(-distances / (2 * parameters.length_scale**2))
    smooth = np.linalg.cholesky(covariance + 1e-10 * np.eye(count)) @ rng.standard_normal(count)
    return xy, smooth + parameters.noise * rng.standard_normal(count)


def dense(xy, elevation, parameters, query):
    """Textbook posterior mean and variance at (M, 2) points, by scikit-learn."""
    kernel = ConstantKernel(parameters.variance) * RBF(parameters.length_scale)
    model = GaussianProcessRegressor(kernel, alpha=parameters.noise**2, optimizer=None)
    mean, std = model.fit(xy, elevation).predict(query, return_std=True)
    return mean, std**2


def constant(xy, parameters=PARAMETERS):
    return np.full(len(xy), parameters.noise)


@pytest.fixture(scope="module")
def surface():
    xy, elevation = draw_surface()
    return xy, elevation, constant(xy)


@pytest.mark.parametrize(
    "length_scale", [0.12, 0.3, 2.0], ids=["tiles do not see all points", "paper", "one tile"]
)
def test_mean_and_variance_equal_scikit_learn(surface, length_scale):
    xy, elevation, noise = surface
    parameters = Hyperparameters(length_scale, PARAMETERS.variance, PARAMETERS.noise)
    grid = Grid((-0.5, -0.2), 0.095, (37, 41))
    query = np.stack(np.meshgrid(grid.x, grid.y), axis=-1).reshape(-1, 2)
    mean, variance = dense(xy, elevation, parameters, query)
    on_grid = predict_grid(xy, elevation, noise, parameters, grid)
    assert on_grid.elevation.shape == (37, 41)
    for field in (on_grid, predict_at(xy, elevation, noise, parameters, query)):
        np.testing.assert_allclose(field.elevation.ravel(), mean, rtol=0, atol=1e-8 * np.abs(mean).max())
        np.testing.assert_allclose(field.variance.ravel(), variance, rtol=0, atol=1e-8 * parameters.variance)


def test_arbitrary_points_equal_the_grid(surface):
    xy, elevation, noise = surface
    noise = noise * np.where(xy[:, 0] > 1.5, 3.0, 0.5)
    grid = Grid((-0.3, 0.2), 0.11, (19, 33))
    places = np.stack(np.meshgrid(grid.x, grid.y), axis=-1).reshape(-1, 2)
    on_grid = predict_grid(xy, elevation, noise, PARAMETERS, grid)
    alone = predict_at(xy, elevation, noise, PARAMETERS, places, workers=2)
    for name, expected in vars(on_grid).items():
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            getattr(alone, name), expected.ravel(), rtol=0, atol=1e-8 * scale, err_msg=name
        )
    assert alone.variance.tobytes() == predict_at(xy, elevation, noise, PARAMETERS, places).variance.tobytes()


def test_gradients_equal_finite_differences_of_the_mean(surface):
    places = np.random.default_rng(3).uniform(0, 3, (200, 2))
    field = predict_at(*surface, PARAMETERS, places)
    step, weights, offsets = 2e-3, np.array([1, -8, 8, -1]) / 12, [-2, -1, 1, 2]
    for axis, gradient in enumerate((field.gradient_x, field.gradient_y)):
        direction = step * np.eye(2)[axis]
        difference = sum(
            w * predict_at(*surface, PARAMETERS, places + o * direction).elevation
            for w, o in zip(weights, offsets, strict=True)
        )
        np.testing.assert_allclose(
            difference / step, gradient, rtol=0, atol=1e-6 * np.abs(field.gradient_x).max()
        )


def test_gradient_variance_equals_the_dense_formula(surface):
    xy, elevation, noise = surface
    places = np.array([[0.4, 2.9], [1.7, 2.9], [0.4, 3.6], [1.7, 3.6]])
    field = predict_at(xy, elevation, noise, PARAMETERS, places)
    length_scale, variance = PARAMETERS.length_scale, PARAMETERS.variance
    distances = ((xy[:, None] - xy) ** 2).sum(-1)
    covariance = variance * np.exp(-distances / (2 * length_scale**2)) + np.diag(noise**2)
    for place, found in zip(places, field.gradient_variance, strict=True):
        offset = place - xy
        k = variance * np.exp(-(offset**2).sum(1) / (2 * length_scale**2))
        dk = -offset / length_scale**2 * k[:, None]
        each = variance / length_scale**2 - np.diag(dk.T @ np.linalg.solve(covariance, dk))
        assert found == pytest.approx(each.mean(), rel=1e-6)


def test_far_from_all_points_the_prior_remains(surface):
    for field in (
        predict_grid(*surface, PARAMETERS, Grid((40.0, 40.0), 0.1, (1, 2))),
        predict_at(*surface, PARAMETERS, np.array([[40.0, 40.0], [40.1, 40.0]])),
    ):
        assert field.elevation == pytest.approx(0.0, abs=1e-12)
        assert field.variance == pytest.approx(PARAMETERS.variance)
        assert field.gradient_variance == pytest.approx(PARAMETERS.variance / PARAMETERS.length_scale**2)


def test_prediction_does_not_depend_on_workers(surface):
    grid = Grid((0.0, 0.0), 3 / 69, (70, 70))
    one, two = (predict_grid(*surface, PARAMETERS, grid, workers=workers) for workers in (1, 2))
    assert one.variance.tobytes() == two.variance.tobytes()
    assert one.gradient_x.tobytes() == two.gradient_x.tobytes()


def test_singular_covariance_is_an_error():
    xy = np.repeat(np.random.default_rng(0).uniform(0, 1, (30, 2)), 2, axis=0)
    with pytest.raises(TerrainLoopError, match="raise the noise"):
        predict_at(xy, np.zeros(60), np.full(60, 1e-12), Hyperparameters(0.5, 1.0, 1e-12), xy[:3])


def test_likelihood_equals_scikit_learn(surface):
    xy, elevation, _ = surface
    value, _ = negative_log_likelihood(np.log([0.25, 0.05, 0.03]), xy, elevation)
    kernel = ConstantKernel(0.05) * RBF(0.25) + WhiteKernel(0.03**2)
    model = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None).fit(xy, elevation)
    assert value == pytest.approx(-model.log_marginal_likelihood_value_, rel=1e-9)


def test_likelihood_gradient_equals_finite_differences(surface):
    xy, elevation, _ = surface
    start = np.log([0.25, 0.05, 0.03])
    gradient = negative_log_likelihood(start, xy, elevation)[1]
    error = check_grad(
        lambda p: negative_log_likelihood(p, xy, elevation)[0],
        lambda p: negative_log_likelihood(p, xy, elevation)[1],
        start,
    )
    assert error < 1e-5 * np.linalg.norm(gradient)


@pytest.mark.parametrize("exact", [False, True])
def test_fit_recovers_what_the_surface_was_drawn_from(exact):
    clouds = []
    for seed in range(3):
        xy, elevation = draw_surface(seed, count=500, extent=5.0)
        clouds.append(np.c_[xy, elevation])
    fitted = fit_hyperparameters(clouds, exact=exact, remove_plane=False, workers=2)
    assert fitted.length_scale == pytest.approx(PARAMETERS.length_scale, rel=0.1)
    assert fitted.noise == pytest.approx(PARAMETERS.noise, rel=0.1)
    assert fitted.variance == pytest.approx(PARAMETERS.variance, rel=0.4)


def test_fixed_hyperparameters_stay(surface):
    xy, elevation, _ = surface
    data = TrainingData(xy, elevation, np.zeros(3), np.zeros(2), np.ones(len(xy)))
    start = Hyperparameters(0.5, 0.1, 0.05)
    fitted = maximise_likelihood([data], start, fixed=["noise"])
    assert fitted.noise == pytest.approx(0.05, rel=1e-12)
    assert fitted.length_scale != pytest.approx(0.5, rel=0.05)


def test_no_cloud_is_an_error():
    with pytest.raises(TerrainLoopError, match="at least one cloud"):
        fit_hyperparameters([])


def test_the_exact_solver_predicts_at_points_by_the_dense_equations():
    """Where the spline's error is largest: few points, far more accurate than the relief is high."""
    parameters = Hyperparameters(0.5, 0.04, 1e-3)
    xy, elevation = draw_surface(4, count=150, extent=6.0, parameters=parameters)
    places = np.random.default_rng(5).uniform(0, 6, (50, 2))
    offset = np.array([20.0, -5.0, 100.0])
    cloud = np.c_[xy, elevation] + offset
    process = ElevationProcess.from_points(
        cloud, *vars(parameters).values(), solver="exact", remove_plane=False, local_noise=False
    )
    mean, variance = dense(xy, elevation - elevation.mean(), parameters, places)
    found = process.predict_at(places + offset[:2])
    np.testing.assert_allclose(found.elevation, mean + elevation.mean() + offset[2], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.variance, variance, rtol=0, atol=1e-7 * parameters.variance)
    by_spline = replace(process, solver="spline").predict_at(places + offset[:2])
    assert np.abs(by_spline.variance / variance - 1).max() > 1e-3
