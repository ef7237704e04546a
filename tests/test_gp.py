"""The exact GP against finite differences, scikit-learn and its own equations."""

import numpy as np
import pytest
from scipy.optimize import check_grad
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.exact import predict_grid
from terrainloop.gp.hyperparameters import fit_hyperparameters, maximise_likelihood, negative_log_likelihood
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.surface import Surface

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


@pytest.fixture(scope="module")
def surface():
    return draw_surface()


@pytest.mark.parametrize(
    "length_scale", [0.12, 0.3, 2.0], ids=["tiles do not see all points", "paper", "one tile"]
)
def test_mean_and_variance_equal_scikit_learn(surface, length_scale):
    xy, elevation = surface
    parameters = Hyperparameters(length_scale, PARAMETERS.variance, PARAMETERS.noise)
    x, y = np.linspace(-0.5, 3.5, 41), np.linspace(-0.2, 3.2, 37)
    field = predict_grid(xy, elevation, parameters, x, y)
    query = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    mean, variance = dense(xy, elevation, parameters, query)
    assert field.elevation.shape == (37, 41)
    np.testing.assert_allclose(field.elevation.ravel(), mean, rtol=0, atol=1e-8 * np.abs(mean).max())
    np.testing.assert_allclose(field.variance.ravel(), variance, rtol=0, atol=1e-8 * parameters.variance)


def test_gradients_equal_finite_differences_of_the_mean(surface):
    x, y = np.linspace(0, 3, 16), np.linspace(0, 3, 13)
    field = predict_grid(*surface, PARAMETERS, x, y)
    step, weights, offsets = 2e-3, np.array([1, -8, 8, -1]) / 12, [-2, -1, 1, 2]
    by_x = sum(
        w * predict_grid(*surface, PARAMETERS, x + o * step, y).elevation
        for w, o in zip(weights, offsets, strict=True)
    )
    by_y = sum(
        w * predict_grid(*surface, PARAMETERS, x, y + o * step).elevation
        for w, o in zip(weights, offsets, strict=True)
    )
    scale = np.abs(field.gradient_x).max()
    np.testing.assert_allclose(by_x / step, field.gradient_x, rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(by_y / step, field.gradient_y, rtol=0, atol=1e-6 * scale)


def test_gradient_variance_equals_the_dense_formula(surface):
    xy, elevation = surface
    x, y = np.array([0.4, 1.7]), np.array([2.9, 3.6])
    field = predict_grid(xy, elevation, PARAMETERS, x, y)
    length_scale, variance, noise = PARAMETERS.length_scale, PARAMETERS.variance, PARAMETERS.noise
    distances = ((xy[:, None] - xy) ** 2).sum(-1)
    covariance = variance * np.exp(-distances / (2 * length_scale**2)) + noise**2 * np.eye(len(xy))
    for row, column in np.ndindex(2, 2):
        offset = np.array([x[column], y[row]]) - xy
        k = variance * np.exp(-(offset**2).sum(1) / (2 * length_scale**2))
        dk = -offset / length_scale**2 * k[:, None]
        each = variance / length_scale**2 - np.diag(dk.T @ np.linalg.solve(covariance, dk))
        assert field.gradient_variance[row, column] == pytest.approx(each.mean(), rel=1e-6)


def test_far_from_all_points_the_prior_remains(surface):
    field = predict_grid(*surface, PARAMETERS, np.array([40.0, 40.1]), np.array([40.0]))
    assert field.elevation == pytest.approx(0.0, abs=1e-12)
    assert field.variance == pytest.approx(PARAMETERS.variance)
    assert field.gradient_variance == pytest.approx(PARAMETERS.variance / PARAMETERS.length_scale**2)


def test_prediction_does_not_depend_on_workers(surface):
    x = np.linspace(0, 3, 70)
    one, two = (predict_grid(*surface, PARAMETERS, x, x, workers=workers) for workers in (1, 2))
    assert one.variance.tobytes() == two.variance.tobytes()
    assert one.gradient_x.tobytes() == two.gradient_x.tobytes()


def test_singular_covariance_is_an_error():
    xy = np.repeat(np.random.default_rng(0).uniform(0, 1, (30, 2)), 2, axis=0)
    with pytest.raises(TerrainLoopError, match="raise the noise"):
        predict_grid(xy, np.zeros(60), Hyperparameters(0.5, 1.0, 1e-12), xy[:3, 0], xy[:3, 1])


def test_likelihood_equals_scikit_learn(surface):
    xy, elevation = surface
    value, _ = negative_log_likelihood(np.log([0.25, 0.05, 0.03]), xy, elevation)
    kernel = ConstantKernel(0.05) * RBF(0.25) + WhiteKernel(0.03**2)
    model = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None).fit(xy, elevation)
    assert value == pytest.approx(-model.log_marginal_likelihood_value_, rel=1e-9)


def test_likelihood_gradient_equals_finite_differences(surface):
    xy, elevation = surface
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
    xy, elevation = surface
    data = Surface(xy, elevation, np.zeros(3), np.zeros(2), np.ones(len(xy)))
    start = Hyperparameters(0.5, 0.1, 0.05)
    fitted = maximise_likelihood([data], start, fixed=["noise"])
    assert fitted.noise == pytest.approx(0.05, rel=1e-12)
    assert fitted.length_scale != pytest.approx(0.5, rel=0.05)


def test_no_cloud_is_an_error():
    with pytest.raises(TerrainLoopError, match="at least one cloud"):
        fit_hyperparameters([])
