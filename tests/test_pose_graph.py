"""The pose graph agrees with an independent least squares, and wrong loops do it no harm."""

import sys
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import exp_se3, inverse, log_se3, se3, tangent_covariance, translation
from terrainloop.loop import LoopCandidate
from terrainloop.pose_graph import ANCHOR, GRAVITY_DEG, PoseGraph, step_covariances
from terrainloop.record import SubmapRecord

COVARIANCE = np.diag([0.03, 0.03, 0.02, 0.005, 0.005, 0.01]) ** 2
COVARIANCE[0, 5] = COVARIANCE[5, 0] = 1e-4


def laps(count, per_lap=12, radius=20.0):
    """True poses of a drive in circles, upright, over gentle hills."""
    angle = 2 * np.pi * np.arange(count) / per_lap
    return np.array(
        [se3(radius * np.cos(a), radius * np.sin(a), 0.3 * np.sin(3 * a), 0, 0, a + 1.6) for a in angle]
    )


def driven(truth, rng):
    """Poses by odometry whose steps err as its stated model says, but for the gravity it feels."""
    steps, poses = step_covariances(truth), [truth[0]]
    for k in range(1, len(truth)):
        error = rng.normal(0, np.sqrt(np.diag(steps[k]))) * [0, 0, 1, 1, 1, 1]
        poses.append(poses[-1] @ inverse(truth[k - 1]) @ truth[k] @ exp_se3(error))
    return np.array(poses)


def loop_of(truth, source, target, rng, *, origins=None, wrong=False):
    """A loop that errs as its covariance says, or a wrong one."""
    origin = np.zeros((len(truth), 3)) if origins is None else origins
    T = inverse(truth[target] @ translation(origin[target])) @ truth[source] @ translation(origin[source])
    T = T @ exp_se3(rng.multivariate_normal(np.zeros(6), tangent_covariance(T, COVARIANCE)))
    if wrong:
        T = se3(*rng.uniform(-5, 5, 2), 0, 0, 0, rng.uniform(-3, 3))
    found = LoopCandidate.without_transform(f"{source}", f"{target}", "found")
    return replace(
        found,
        T_target_source=translation(origin[target]) @ T @ translation(-origin[source]),
        covariance=COVARIANCE,
        accepted=True,
        source_origin=origin[source],
        target_origin=origin[target],
    )


def graph_of(truth, odometry, loops, sessions=None, middle=(0.0, 0.0)):
    sessions = [""] * len(truth) if sessions is None else sessions
    corners = np.array([[-4.0, -4.0], [4.0, -4.0], [0.0, 4.0]]) + middle
    records = [
        SubmapRecord(f"{k}", float(k), 1000, "ok", corners, session=session, odometry=pose)
        for k, (session, pose) in enumerate(zip(sessions, odometry, strict=True))
    ]
    return PoseGraph.of(records, loops)


def mission(seed, count=36, good=20, wrong=0, origins=None):
    rng = np.random.default_rng(seed)
    truth = laps(count)
    odometry = driven(truth, rng)
    loops = []
    for k in range(good + wrong):
        source = int(rng.integers(12, count))
        target = source - 12 * int(rng.integers(1, source // 12 + 1))
        loops.append(loop_of(truth, source, target, rng, origins=origins, wrong=k < wrong))
    return truth, graph_of(truth, odometry, loops)


def rms(poses, truth):
    return np.sqrt(((poses[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean())


def residuals(tangents, graph, start):
    """All residuals, whitened: an implementation without GTSAM."""
    poses = [T @ exp_se3(xi) for T, xi in zip(start, tangents.reshape(-1, 6), strict=True)]

    def whitened(covariance, error):
        return np.linalg.solve(np.linalg.cholesky(covariance), error)

    rows = [log_se3(inverse(graph.odometry[0]) @ poses[0]) / ANCHOR]
    for pose, measured in zip(poses, graph.odometry, strict=True):
        # Angles between the vertical that odometry saw and that of the pose, both in the submap.
        rows.append(np.cross(pose[2, :3], measured[2, :3])[:2] / np.radians(GRAVITY_DEG))
    edges = [
        (k - 1, k, inverse(a) @ b, graph.steps[k]) for k, (a, b) in enumerate(pairwise(graph.odometry), 1)
    ]
    for loop in graph.loops:
        covariance = tangent_covariance(loop.T_target_source, loop.covariance)
        edges.append((int(loop.target), int(loop.source), loop.T_target_source, covariance))
    for target, source, T, covariance in edges:
        rows.append(whitened(covariance, log_se3(inverse(T) @ inverse(poses[target]) @ poses[source])))
    return np.concatenate(rows)


@pytest.fixture(scope="module")
def solved():
    truth, graph = mission(0, count=24, good=10)
    return truth, graph, graph.solve()


def test_it_is_the_least_squares_solution(solved):
    _, graph, solution = solved
    found = least_squares(residuals, np.zeros(6 * 24), args=(graph, graph.odometry), x_scale="jac")
    expected = [T @ exp_se3(xi) for T, xi in zip(graph.odometry, found.x.reshape(-1, 6), strict=True)]
    assert np.abs(solution.poses - expected).max() < 2e-3
    assert solution.kept.all()
    assert not solution.warnings


def test_covariance_of_a_relative_pose_is_that_of_the_normal_equations(solved):
    _, graph, solution = solved
    zero, step = np.zeros(6 * 24), 1e-6
    at_zero = residuals(zero, graph, solution.poses)
    jacobian = np.column_stack(
        [(residuals(step * e, graph, solution.poses) - at_zero) / step for e in np.eye(len(zero))]
    )
    joint = np.linalg.inv(jacobian.T @ jacobian)
    for target, source in ((3, 20), (20, 3)):
        T, covariance = solution.relative(target, source)
        poses = solution.poses
        np.testing.assert_allclose(T, inverse(poses[target]) @ poses[source], atol=1e-9)
        J = np.zeros((6, len(zero)))
        for k, e in enumerate(np.eye(6)):
            moved = inverse(poses[target] @ exp_se3(step * e)) @ poses[source]
            J[:, 6 * target + k] = log_se3(inverse(T) @ moved) / step
            J[k, 6 * source + k] = 1.0
        np.testing.assert_allclose(covariance, J @ joint @ J.T, atol=0.03 * np.abs(covariance).max())


@pytest.mark.parametrize("seed", range(3))
def test_loops_bring_the_drive_together(seed):
    truth, graph = mission(seed)
    solution = graph.solve()
    assert rms(solution.poses, truth) < 0.4 * rms(graph.odometry, truth)
    assert np.median(solution.squares) < 6.0  # degrees of freedom of each


@pytest.mark.parametrize("seed", range(3))
def test_wrong_loops_are_left_out(seed):
    truth, graph = mission(seed, good=40, wrong=4)
    solution = graph.solve()
    clean = replace(graph, loops=graph.loops[4:]).solve()
    assert not solution.kept[:4].any()
    assert solution.kept[4:].sum() >= 39  # one in a hundred right ones is beyond the gate
    assert rms(solution.poses, truth) < 1.2 * rms(clean.poses, truth)
    count = 44 - solution.kept.sum()
    assert solution.warnings[0].startswith(f"{count} of 44 loops disagree with odometry and the others")
    assert len(solution.left_out) == count
    assert all("disagrees with odometry" in loop.reason and not loop for loop in solution.left_out)
    assert [loop for loop, kept in zip(graph.loops, solution.kept, strict=True) if kept] == solution.loops


@pytest.mark.parametrize("seed", range(3))
def test_where_half_of_the_loops_are_wrong_the_result_is_not_worse_than_odometry(seed):
    truth, graph = mission(seed, good=15, wrong=15)
    assert rms(graph.solve().poses, truth) < rms(graph.odometry, truth)


def test_without_loops_the_poses_are_those_of_odometry():
    _, graph = mission(0, good=0)
    solution = graph.solve()
    np.testing.assert_array_equal(solution.poses, graph.odometry)
    assert solution.loop_ends.shape == (0, 2, 2)


def test_ends_of_loops_are_where_their_submaps_are(solved):
    _, graph, solution = solved
    loop = graph.loops[0]
    expected = [solution.poses[int(name), :2, 3] for name in (loop.target, loop.source)]
    np.testing.assert_array_equal(solution.loop_ends[0], expected)


def test_submaps_without_odometry_are_no_part_of_it():
    truth, graph = mission(0)
    records = [
        SubmapRecord(f"{k}", odometry=None if k == 5 else pose) for k, pose in enumerate(graph.odometry)
    ]
    partly = PoseGraph.of(records, graph.loops)
    assert len(partly.names) == len(truth) - 1
    assert not any("5" in (loop.source, loop.target) for loop in partly.loops)
    assert partly.solve().poses.shape == (len(truth) - 1, 4, 4)
    assert PoseGraph.of([SubmapRecord("a")], []).names == ()


def test_sessions_are_joined_by_loops_or_named():
    rng = np.random.default_rng(1)
    truth = laps(24)
    world = se3(100, -50, 3, 0, 0, 1.0)
    odometry = np.concatenate([driven(truth[:12], rng), world @ driven(truth[12:], rng)])
    sessions = 12 * ["a"] + 12 * ["b"]
    loops = [loop_of(truth, source, source - 12, rng) for source in range(12, 24, 3)]
    joined = graph_of(truth, odometry, loops, sessions).solve()
    assert rms(joined.poses, truth) < 2.0
    assert not joined.warnings
    apart = graph_of(truth, odometry, [loop_of(truth, 11, 0, rng)], sessions).solve()
    assert apart.warnings == ("nothing ties 12 of 24 submaps to the first ones: 12 to 23",)
    np.testing.assert_allclose(apart.poses[12:], odometry[12:], atol=1e-6)
    with pytest.raises(TerrainLoopError, match="which nothing joins"):
        apart.relative(0, 20)


def test_a_session_that_only_wrong_loops_join_stays_apart():
    rng = np.random.default_rng(2)
    truth = laps(36)
    odometry = driven(truth, rng)
    sessions = 24 * ["a"] + 12 * ["b"]
    good = [loop_of(truth, source, source - 12, rng) for source in range(12, 24, 2)]
    bad = [loop_of(truth, source, source - 24, rng, wrong=True) for source in (26, 30, 34)]
    solution = graph_of(truth, odometry, [*good, *bad], sessions).solve()
    assert solution.kept[:6].all()
    assert sum(solution.kept[6:]) <= 1


def test_frames_far_from_their_submaps_are_solved_about_local_origins(tmp_path):
    far = np.array([5e5, 4.2e6, 300.0])
    truth, near = mission(3)
    origins = np.tile(far, (len(truth), 1))
    to_near = translation(-far)
    odometry = near.odometry @ to_near
    loops = [
        replace(
            loop,
            T_target_source=inverse(to_near) @ loop.T_target_source @ to_near,
            source_origin=origins[0],
            target_origin=origins[0],
        )
        for loop in near.loops
    ]
    solution = graph_of(truth, odometry, loops, middle=far[:2]).solve()
    np.testing.assert_allclose(solution.poses @ translation(far), near.solve().poses, atol=1e-4)


def test_g2o_is_read_back_by_gtsam(tmp_path):
    _, graph = mission(0, good=20, wrong=2)
    solution = graph.solve()
    solution.write_g2o(tmp_path / "graph.g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert factors.size() == 35 + 20
    for k, pose in enumerate(solution.poses):
        np.testing.assert_allclose(values.atPose3(k).matrix(), pose, atol=1e-9)
    loop, factor = graph.loops[2], factors.at(35)
    assert list(factor.keys()) == [int(loop.target), int(loop.source)]
    np.testing.assert_allclose(factor.measured().matrix(), loop.T_target_source, atol=1e-9)
    expected = tangent_covariance(loop.T_target_source, loop.covariance, "gtsam")
    np.testing.assert_allclose(factor.noiseModel().covariance(), expected, atol=1e-12)
    step = factors.at(0)
    np.testing.assert_allclose(step.noiseModel().covariance(), graph.steps[1], atol=1e-12)


def test_what_gtsam_cannot_solve_is_our_error():
    _, graph = mission(0)
    for steps in (np.full_like(graph.steps, np.nan), -graph.steps):
        with pytest.raises(TerrainLoopError, match="a pose graph that can be solved"):
            replace(graph, steps=steps).solve()


def test_loops_without_a_covariance_are_no_part_of_it():
    truth, graph = mission(0)
    loops = [replace(loop, covariance=np.full((6, 6), np.nan)) for loop in graph.loops]
    assert graph_of(truth, graph.odometry, loops).loops == ()


def test_without_gtsam_there_is_one_clear_line(monkeypatch):
    _, graph = mission(0)
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(TerrainLoopError, match=r"pip install 'gtsam>=4\.3'"):
        graph.solve()
