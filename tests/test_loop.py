"""A loop as a pose graph takes it: its local transform and its information."""

from dataclasses import replace

import numpy as np
import pytest

from terrainloop.geometry import exp_se3, inverse, log_se3, parameters_of, se3, transform
from terrainloop.loop import NO_EVIDENCE, LoopCandidate

ROOT = np.random.default_rng(0).normal(size=(6, 6)) * [0.1, 0.1, 0.05, 0.01, 0.01, 0.02]
LOOP = LoopCandidate(
    "b", "a", se3(4.0, -3.0, 0.5, 0.02, -0.03, 2.0), ROOT.T @ ROOT, 9, 1.0, 0.1, 0.5, 9.0, True, "made up"
)  # fmt: skip


def test_information_weighs_errors_as_the_covariance_of_the_parameters_does():
    """For small errors, in either order of the tangent vector."""
    rng = np.random.default_rng(1)
    parameters = parameters_of(LOOP.T_target_source)
    by_parameters = np.linalg.inv(LOOP.covariance)
    for draw in 1e-3 * rng.multivariate_normal(np.zeros(6), LOOP.covariance, 20):
        tangent = log_se3(inverse(LOOP.T_target_source) @ se3(*(parameters + draw)))
        expected = draw @ by_parameters @ draw
        assert tangent @ LOOP.information("gtsam") @ tangent == pytest.approx(expected, rel=1e-2)
        moved = np.roll(tangent, 3)
        assert moved @ LOOP.information("g2o") @ moved == pytest.approx(expected, rel=1e-2)


def test_the_default_order_is_that_of_gtsam():
    np.testing.assert_array_equal(LOOP.information(), LOOP.information("gtsam"))


def test_local_frames_are_moved_and_not_rotated():
    far = replace(LOOP, source_origin=np.array([5e5, 4e6, 10.0]), target_origin=np.array([5e5, 4e6, 0.0]))
    far = replace(
        far, T_target_source=se3(*far.target_origin, 0, 0, 0) @ LOOP.T_target_source
        @ inverse(se3(*far.source_origin, 0, 0, 0))
    )  # fmt: skip
    np.testing.assert_allclose(far.T_local, LOOP.T_target_source, rtol=0, atol=1e-8)
    np.testing.assert_allclose(far.information(), LOOP.information(), rtol=1e-6)
    point = np.add(far.source_origin, (1.0, 2.0, 3.0))
    there = transform(far.T_target_source, point) - far.target_origin
    np.testing.assert_allclose(transform(far.T_local, point - far.source_origin), there, rtol=0, atol=1e-6)


def test_a_pair_without_a_transform_has_no_information():
    none = LoopCandidate.without_transform("b", "a", "featureless")
    assert not none
    assert none.score == NO_EVIDENCE
    assert np.isnan(none.information()).all()
    assert np.isnan(none.T_local).all()


def test_the_perturbation_is_in_the_frame_of_the_source():
    """Noise along the source's x axis is weighed by that axis alone."""
    covariance = np.diag([1e-2, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6])
    turned = replace(LOOP, T_target_source=se3(0, 0, 0, 0, 0, np.pi / 2), covariance=covariance)
    information = turned.information("g2o")
    # x of the target is -y of the source, which is turned by a right angle.
    assert information[1, 1] == pytest.approx(1e2)
    assert information[0, 0] == pytest.approx(1e6)
    moved = turned.T_target_source @ exp_se3([0, 0, 0, 0, 0.1, 0])
    np.testing.assert_allclose(moved[:3, 3], [-0.1, 0, 0], atol=1e-12)
