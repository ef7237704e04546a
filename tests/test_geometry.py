"""Transforms against SciPy's rotations, matrix algebra and the textbook SVD fit."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import (
    adjoint_se3,
    exp_se3,
    fit_se2,
    inverse,
    log_se3,
    parameters_of,
    se2,
    se3,
    tangent_covariance,
    transform,
    yaw_of,
)

UTM = np.array([431234.125, 3761234.5])


def random_parameters(count, seed=0):
    rng = np.random.default_rng(seed)
    limits = np.array([100.0, 100.0, 10.0, np.pi, 0.49 * np.pi, np.pi])
    return rng.uniform(-1, 1, (count, 6)) * limits


def matrix(parameters):
    """se3 by SciPy: intrinsic z, y, x."""
    x, y, z, roll, pitch, yaw = parameters
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[:3, 3] = x, y, z
    return T


def kabsch(source, target):
    """Umeyama (1991) without scale: SVD of the cross-covariance, with the guard against reflections."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    R = U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt
    T = np.eye(3)
    T[:2, :2], T[:2, 2] = R, target_mean - R @ source_mean
    return T


@pytest.mark.parametrize("parameters", random_parameters(8))
def test_se3_is_yaw_pitch_roll_of_scipy(parameters):
    np.testing.assert_allclose(se3(*parameters), matrix(parameters), rtol=0, atol=1e-13)


@pytest.mark.parametrize("parameters", random_parameters(8, seed=1))
def test_parameters_are_scipys_euler_angles(parameters):
    T = matrix(parameters)
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
    np.testing.assert_allclose(parameters_of(T), [*T[:3, 3], roll, pitch, yaw], rtol=0, atol=1e-12)
    np.testing.assert_allclose(parameters_of(T), parameters, rtol=0, atol=1e-12)


@pytest.mark.parametrize("yaw", [-3.0, -0.5, 0.0, 1.2, np.pi])
def test_se2_is_the_planar_part_of_se3(yaw):
    T = se2(3.0, -4.0, yaw)
    expected = matrix([3.0, -4.0, 0.0, 0.0, 0.0, yaw])[np.ix_([0, 1, 3], [0, 1, 3])]
    np.testing.assert_allclose(T, expected, rtol=0, atol=1e-15)
    assert yaw_of(T) == pytest.approx(yaw)


@pytest.mark.parametrize("parameters", random_parameters(4, seed=2))
def test_yaw_ignores_tilt(parameters):
    assert yaw_of(matrix(parameters)) == pytest.approx(parameters[5])


@pytest.mark.parametrize("T", [se2(5.0, -7.0, 2.5), se3(5.0, -7.0, 1.0, 0.3, -0.4, 2.5)], ids=["2d", "3d"])
def test_inverse_is_the_matrix_inverse(T):
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), rtol=0, atol=1e-14)


@pytest.mark.parametrize("T", [se2(5.0, -7.0, 2.5), se3(5.0, -7.0, 1.0, 0.3, -0.4, 2.5)], ids=["2d", "3d"])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_transform_is_the_homogeneous_product(T, shape):
    points = np.random.default_rng(0).normal(size=(*shape, len(T) - 1))
    homogeneous = np.concatenate([points, np.ones((*shape, 1))], axis=-1)
    expected = np.einsum("ij,...j->...i", T, homogeneous)[..., :-1]
    np.testing.assert_allclose(transform(T, points), expected, rtol=0, atol=1e-14)


def test_transforms_compose_from_right_to_left():
    T_a_b, T_b_c = se3(*random_parameters(1, 3)[0]), se3(*random_parameters(1, 4)[0])
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        transform(T_a_b @ T_b_c, point), transform(T_a_b, transform(T_b_c, point)), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("yaw", [-3.1, -1.0, 0.0, 0.4, np.pi / 2, np.pi])
@pytest.mark.parametrize("count", [2, 3, 50])
def test_fit_recovers_an_exact_transform(yaw, count):
    T = se2(12.0, -3.0, yaw)
    source = np.random.default_rng(count).normal(size=(count, 2))
    np.testing.assert_allclose(fit_se2(source, transform(T, source)), T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_fit_of_noisy_points_equals_the_svd(seed):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(20, 2)) * [5.0, 2.0]
    target = transform(se2(*rng.normal(size=2), rng.uniform(-3, 3)), source) + rng.normal(0, 1.0, (20, 2))
    np.testing.assert_allclose(fit_se2(source, target), kabsch(source, target), rtol=0, atol=1e-12)


def test_fit_is_the_least_squares_optimum():
    rng = np.random.default_rng(9)
    source, target = rng.normal(size=(2, 12, 2))
    T = fit_se2(source, target)

    def cost(x, y, yaw):
        return ((transform(se2(x, y, yaw), source) - target) ** 2).sum()

    best = np.array([*T[:2, 2], yaw_of(T)])
    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(*best) < cost(*(best + step))


def test_fit_of_a_batch_is_one_fit_each():
    source, target = np.random.default_rng(0).normal(size=(2, 3, 4, 7, 2))
    T = fit_se2(source, target)
    assert T.shape == (3, 4, 3, 3)
    for index in np.ndindex(3, 4):
        np.testing.assert_allclose(T[index], kabsch(source[index], target[index]), rtol=0, atol=1e-12)


def test_fit_of_an_empty_batch_is_empty():
    assert fit_se2(np.empty((0, 2, 2)), np.empty((0, 2, 2))).shape == (0, 3, 3)


def test_mirrored_points_give_a_rotation_not_a_reflection():
    source = np.random.default_rng(3).normal(size=(15, 2)) * [4.0, 1.0]
    target = source * [1.0, -1.0]
    T = fit_se2(source, target)
    assert np.linalg.det(T[:2, :2]) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(T, kabsch(source, target), rtol=0, atol=1e-12)


def test_shifted_points_give_no_rotation():
    source = np.random.default_rng(4).normal(size=(5, 2))
    np.testing.assert_allclose(
        fit_se2(source, source + np.array([2.0, -9.0])), se2(2.0, -9.0, 0.0), rtol=0, atol=1e-14
    )


def test_points_in_one_spot_leave_the_rotation_at_zero():
    np.testing.assert_allclose(fit_se2(np.ones((3, 2)), np.full((3, 2), 4.0)), se2(3.0, 3.0, 0.0), atol=1e-15)


def test_fit_keeps_its_digits_far_from_the_origin():
    source = np.random.default_rng(5).uniform(-5, 5, (30, 2))
    T = se2(3.0, 4.0, 1.0)
    target = transform(T, source)
    far = fit_se2(source + UTM, target + UTM)
    assert yaw_of(far) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(transform(far, source + UTM) - UTM, target, rtol=0, atol=1e-7)


# --- the Lie group SE(3)


def hat(tangent):
    w, v = tangent[:3], tangent[3:]
    T = np.zeros((4, 4))
    T[:3, 3] = v
    T[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    return T


TANGENTS = [
    *np.random.default_rng(3).uniform(-1.5, 1.5, (6, 6)),  # rotations shorter than pi
    np.zeros(6),
    1e-7 * np.arange(6.0),
    [0, 0, 0, 1, 2, 3],
]


@pytest.mark.parametrize("tangent", TANGENTS)
def test_exp_is_the_matrix_exponential(tangent):
    tangent = np.asarray(tangent, dtype=float)
    np.testing.assert_allclose(exp_se3(tangent), expm(hat(tangent)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("tangent", TANGENTS)
def test_log_is_the_inverse_of_exp(tangent):
    np.testing.assert_allclose(log_se3(exp_se3(tangent)), tangent, rtol=0, atol=1e-12)


def test_adjoint_carries_a_perturbation_across():
    rng = np.random.default_rng(4)
    for parameters in random_parameters(5, seed=3):
        T, tangent = matrix(parameters), 0.3 * rng.normal(size=6)
        left = exp_se3(adjoint_se3(T) @ tangent) @ T
        np.testing.assert_allclose(T @ exp_se3(tangent), left, rtol=0, atol=1e-10)


def steep_covariance(seed):
    root = np.random.default_rng(seed).normal(size=(6, 6)) * [0.1, 0.2, 0.05, 0.01, 0.02, 0.03]
    return root.T @ root


@pytest.mark.parametrize("parameters", random_parameters(5, seed=5))
def test_tangent_covariance_by_finite_differences(parameters):
    """The tangent of T^-1 T(p + dp), rotation first, by central differences in each parameter."""
    T, step = se3(*parameters), 1e-6
    jacobian = np.array(
        [
            (log_se3(inverse(T) @ se3(*(parameters + d))) - log_se3(inverse(T) @ se3(*(parameters - d))))
            / (2 * step)
            for d in step * np.eye(6)
        ]
    ).T
    covariance = steep_covariance(0)
    expected = jacobian @ covariance @ jacobian.T
    found = tangent_covariance(T, covariance)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    first = [3, 4, 5, 0, 1, 2]
    np.testing.assert_allclose(
        tangent_covariance(T, covariance, "g2o"), found[np.ix_(first, first)], rtol=1e-12
    )


def test_tangent_covariance_whitens_what_was_drawn():
    """Transforms drawn by their parameters: squared tangents, normalised, average to six."""
    parameters, covariance = np.array([3.0, -2.0, 0.5, 0.1, -0.2, 2.5]), 1e-2 * steep_covariance(1)
    T = se3(*parameters)
    draws = np.random.default_rng(0).multivariate_normal(parameters, covariance, 4000)
    tangents = np.array([log_se3(inverse(T) @ se3(*draw)) for draw in draws])
    information = np.linalg.inv(tangent_covariance(T, covariance))
    assert np.einsum("ni,ij,nj->n", tangents, information, tangents).mean() == pytest.approx(6, rel=0.05)


@pytest.mark.parametrize("order", ["G2O", "GTSAM", "g20", "", None, 0])
def test_another_order_of_the_tangent_is_refused(order):
    with pytest.raises(TerrainLoopError, match="'gtsam' or 'g2o'"):
        tangent_covariance(np.eye(4), np.eye(6), order)
