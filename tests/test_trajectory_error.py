"""Trajectory errors: closed forms, SciPy and plain loops as references, and evo as a separate program."""

import json
import os
import shutil
import subprocess
from dataclasses import astuple, replace
from itertools import product
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from evaluation_util import POSES, RECORDS, right, write_run
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.run_trajectories import run_trajectory_errors
from terrainloop.evaluation.summary import evaluate_run
from terrainloop.evaluation.trajectory_alignment import alignment, associate
from terrainloop.evaluation.trajectory_error import Span, Statistics, span_pairs, trajectory_error
from terrainloop.geometry import exp_se3, inverse, log_se3, se3, translation
from terrainloop.io.trajectories import Trajectory, read_trajectory, write_tum

NUMBERS = ("rms", "mean", "median", "max")


def drive(count=120, seed=0):
    """A winding drive of a metre or so per pose, with tilted frames."""
    rng = np.random.default_rng(seed)
    poses, T = [], se3(3.0, -2.0, 1.0, 0.0, 0.0, 0.7)
    for _ in range(count):
        poses.append(T @ se3(0.0, 0.0, 0.0, *rng.normal(0, 0.05, 2), 0.0))
        T = T @ se3(rng.uniform(0.7, 1.3), 0.0, rng.normal(0, 0.05), 0.0, 0.0, rng.normal(0.03, 0.15))
    return Trajectory(10.0 + 0.5 * np.arange(count), np.array(poses))


def noisy(trajectory, seed=1):
    """The trajectory with an error of each pose, and drift."""
    rng = np.random.default_rng(seed)
    drift, poses = np.eye(4), []
    for pose in trajectory.poses:
        drift = drift @ exp_se3(rng.normal(0, [0.002] * 3 + [0.01] * 3))
        poses.append(drift @ pose @ exp_se3(rng.normal(0, [0.02] * 3 + [0.1] * 3)))
    return Trajectory(trajectory.stamps, np.array(poses))


def moved(trajectory, T):
    """The trajectory in another world."""
    return Trajectory(trajectory.stamps, T @ trajectory.poses)


def path_of(*positions):
    """A trajectory through positions, a second apart, in upright frames."""
    return Trajectory(np.arange(float(len(positions))), np.array([translation(p) for p in positions]))


TRUTH = drive()
ESTIMATE = moved(noisy(TRUTH), se3(40.0, -7.0, 3.0, 0.1, -0.2, 2.0))


# --- closed forms


@pytest.mark.parametrize("align", ["yaw", "se3", "first"])
def test_another_world_is_aligned_away(align):
    T = se3(100.0, -30.0, 5.0, 0.0, 0.0, 2.5)
    error = trajectory_error(moved(TRUTH, inverse(T)), TRUTH, align=align)
    np.testing.assert_allclose(error.T_truth_estimate, T, atol=1e-11)
    assert error.absolute.translation.max() < 1e-11
    assert error.absolute.rotation.max() < 1e-11
    assert error.relative.translation.max() < 1e-11


def test_a_tilted_world_is_not_aligned_away_by_yaw():
    T = se3(1.0, 2.0, 3.0, 0.2, 0.1, -1.0)
    estimate = moved(TRUTH, inverse(T))
    by_se3, by_yaw = (trajectory_error(estimate, TRUTH, align=align) for align in ("se3", "yaw"))
    np.testing.assert_allclose(by_se3.T_truth_estimate, T, atol=1e-11)
    assert by_se3.absolute.translation.max() < 1e-11
    tilt = Rotation.from_matrix(se3(0, 0, 0, 0.2, 0.1, 0)[:3, :3]).magnitude()
    assert by_yaw.absolute.rotation.min() > 0.9 * tilt
    np.testing.assert_array_equal(by_yaw.T_truth_estimate[2, :3], [0, 0, 1])


def test_a_constant_offset_is_the_error_without_alignment():
    error = trajectory_error(moved(TRUTH, translation([3.0, 4.0, 12.0])), TRUTH, align="none")
    np.testing.assert_array_equal(error.T_truth_estimate, np.eye(4))
    assert astuple(error.absolute.statistics[0]) == pytest.approx((13.0,) * 4)
    assert error.absolute.rotation.max() < 1e-11


def test_a_known_drift_of_yaw():
    """Straight steps of 1 m whose yaw is off by 1 deg more each: the chord of a circle."""
    truth = path_of(*((x, 0, 0) for x in range(31)))
    step = se3(1.0, 0, 0, 0, 0, np.radians(1.0))
    estimate = Trajectory(truth.stamps, np.array([np.linalg.matrix_power(step, k) for k in range(31)]))
    error = trajectory_error(estimate, truth, align="first", span=Span(5))
    np.testing.assert_allclose(np.degrees(error.absolute.rotation), np.arange(31), atol=1e-9)
    assert len(error.relative) == 26
    np.testing.assert_allclose(np.degrees(error.relative.rotation), 5.0, atol=1e-9)
    chord = np.exp(1j * np.radians(np.arange(5))).sum()
    np.testing.assert_allclose(error.relative.translation, abs(chord - 5), atol=1e-9)
    assert error.length == pytest.approx(30.0)


def test_statistics_in_closed_form():
    assert astuple(Statistics.of([3.0, 4.0, 0.0, 5.0])) == (50**0.5 / 2, 3.0, 3.5, 5.0)
    assert all(map(np.isnan, astuple(Statistics.of([]))))


def test_far_from_the_origin_nothing_is_lost():
    far = translation([4.5e5, 5.2e6, 300.0])
    near, utm = (trajectory_error(moved(ESTIMATE, T), moved(TRUTH, T), align="se3") for T in (np.eye(4), far))
    np.testing.assert_allclose(utm.absolute.translation, near.absolute.translation, atol=1e-7)
    np.testing.assert_allclose(utm.relative.translation, near.relative.translation, atol=1e-7)


# --- slow references


def reference_alignment(align):
    source, target = ESTIMATE.poses[:, :3, 3], TRUTH.poses[:, :3, 3]
    T = np.eye(4)
    if align == "se3":
        T[:3, :3] = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))[0].as_matrix()
    else:

        def residual(yaw):
            turned = Rotation.from_euler("z", yaw[0]).apply(source)
            return (turned - turned.mean(0) - target + target.mean(0)).ravel()

        found = [least_squares(residual, [start], xtol=1e-15, ftol=1e-15) for start in (-2.0, 0.0, 2.0)]
        T[:3, :3] = Rotation.from_euler("z", min(found, key=lambda fit: fit.cost).x[0]).as_matrix()
    T[:3, 3] = target.mean(0) - T[:3, :3] @ source.mean(0)
    return T


@pytest.mark.parametrize("align", ["yaw", "se3"])
def test_alignment_against_scipy(align):
    T = alignment(ESTIMATE.poses, TRUTH.poses, align)
    np.testing.assert_allclose(T, reference_alignment(align), atol=1e-6)


def pairs_by_loops(positions, span):
    """Every pair in plain loops."""
    pairs = []
    for i in range(len(positions)):
        lengths = {
            j: sum(np.linalg.norm(positions[k + 1] - positions[k]) for k in range(i, j))
            for j in range(i + 1, len(positions))
        }
        if span.unit == "poses":
            pairs += [(i, j) for j in lengths if j - i == span.length]
        elif lengths:
            j = min(lengths, key=lambda j: (round(abs(lengths[j] - span.length), 9), j))
            pairs += [(i, j)] if abs(lengths[j] - span.length) <= 0.1 * span.length else []
    return pairs


def test_relative_errors_against_plain_loops():
    for span in (Span(7.0), Span(1.0), Span(3, "poses")):
        error = trajectory_error(ESTIMATE, TRUTH, span=span)
        pairs = pairs_by_loops(ESTIMATE.poses[:, :3, 3], span)
        assert len(pairs) == len(error.relative) > 30
        P, Q = ESTIMATE.poses, TRUTH.poses
        expected = [inverse(inverse(Q[i]) @ Q[j]) @ inverse(P[i]) @ P[j] for i, j in pairs]
        np.testing.assert_allclose(
            error.relative.translation, [np.linalg.norm(E[:3, 3]) for E in expected], atol=1e-10
        )
        np.testing.assert_allclose(
            error.relative.rotation, [np.linalg.norm(log_se3(E)[:3]) for E in expected], atol=1e-10
        )


@pytest.mark.parametrize("seed", range(20))
def test_pairs_over_a_distance_against_plain_loops(seed):
    """On a path with stops, also at both ends, and steps whose lengths tie."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.choice([0.0, 0.0, 0.25, 0.5, 1.0], 40))[:, None] * [1.0, 0.0, 0.0]
    for length in (0.25, 1.0, 2.625, 100.0):
        first, second = span_pairs(positions, Span(length))
        assert list(zip(first, second, strict=True)) == pairs_by_loops(positions, Span(length))


@pytest.mark.parametrize("seed", range(20))
def test_association_is_one_to_one_and_nearest(seed):
    rng = np.random.default_rng(seed)
    a, b = (rng.uniform(0, 10, rng.integers(1, 60)) for _ in range(2))
    try:
        rows, others = associate(a, b, 0.1)
    except TerrainLoopError:
        assert min(abs(s - t) for s, t in product(a, b)) > 0.1
        return
    swapped = len(a) > len(b)
    short, long = (b, a) if swapped else (a, b)
    claims = {}
    for i, stamp in enumerate(short):
        j = int(np.argmin(np.abs(long - stamp)))
        if abs(long[j] - stamp) <= 0.1:
            claims.setdefault(j, []).append((abs(long[j] - stamp), i))
    expected = {(min(claim)[1], j) for j, claim in claims.items()}
    assert set(zip(*((others, rows) if swapped else (rows, others)), strict=True)) == expected
    assert (np.diff(a[rows]) >= 0).all()


def test_association_of_jittered_clocks_is_the_optimal_one():
    rng = np.random.default_rng(5)
    a = np.arange(30) / 10
    b = a[rng.permutation(30)] + rng.uniform(-0.009, 0.009, 30)
    rows, others = associate(a, b)
    best_rows, best_others = linear_sum_assignment(np.abs(a[:, None] - b))
    np.testing.assert_array_equal(rows, best_rows)
    np.testing.assert_array_equal(others, best_others)


@pytest.mark.parametrize(
    ("a", "b", "pairs"),
    [
        ([1.0], [0.5, 1.5], [(0, 0)]),  # equally near: the earlier
        ([1.0, 1.5], [1.25, 9.0], [(0, 0)]),  # equally near to one: the earlier
        ([0.9, 1.01], [1.0, 5.0], [(1, 0)]),  # both claim it: the nearer
        ([2.0, 1.0], [1.0, 2.0, 3.0], [(1, 0), (0, 1)]),  # in the order of time
        ([1.0, 1.0], [1.0, 1.0], [(0, 0)]),  # repeated stamps are one
        ([3.0], [3.0], [(0, 0)]),
    ],
)
def test_association_in_single_cases(a, b, pairs):
    rows, others = associate(a, b, 0.5)
    assert list(zip(rows.tolist(), others.tolist(), strict=True)) == pairs


def test_only_associated_poses_count():
    truth = Trajectory(TRUTH.stamps[::2] + 0.004, TRUTH.poses[::2])
    error = trajectory_error(ESTIMATE, truth)
    same = trajectory_error(Trajectory(ESTIMATE.stamps[::2], ESTIMATE.poses[::2]), truth)
    np.testing.assert_array_equal(error.stamps, ESTIMATE.stamps[::2])
    assert error.as_dict() == same.as_dict()


# --- what cannot be evaluated


def test_a_mirrored_path_is_not_reflected():
    mirrored = Trajectory(TRUTH.stamps, TRUTH.poses.copy())
    mirrored.poses[:, :3, 3] *= [1.0, -1.0, 1.0]
    for align in ("yaw", "se3"):
        error = trajectory_error(mirrored, TRUTH, align=align)
        assert np.linalg.det(error.T_truth_estimate[:3, :3]) == pytest.approx(1.0)
        assert error.absolute.translation.max() > 0.5


def broken(change):
    poses = ESTIMATE.poses.copy()
    change(poses[7])
    return Trajectory(ESTIMATE.stamps, poses)


def mirror(pose):
    pose[:3, 1] *= -1


def stretch(pose):
    pose[:3, :3] *= 1.1


def far_away(pose):
    pose[0, 3] = 1e200


def project(pose):
    pose[3, 0] = 1.0


@pytest.mark.parametrize("change", [mirror, stretch, far_away, project])
def test_poses_that_are_not_rigid_are_refused(change):
    with pytest.raises(TerrainLoopError, match="the trajectory; found another matrix at pose 8"):
        trajectory_error(broken(change), TRUTH)
    with pytest.raises(TerrainLoopError, match="the ground truth; found another matrix at pose 8"):
        trajectory_error(TRUTH, broken(change))


def test_numbers_that_are_none_are_refused():
    with pytest.raises(TerrainLoopError, match="NaN"):
        broken(lambda pose: pose.fill(np.nan))


@pytest.mark.parametrize("count", [0, 5])
def test_stamps_of_other_clocks_are_refused(count):
    other = Trajectory(1e9 + TRUTH.stamps[:count], TRUTH.poses[:count])
    for pair in ((other, TRUTH), (TRUTH, other)):
        with pytest.raises(TerrainLoopError, match=r"within 0\.01 s.*one clock"):
            trajectory_error(*pair)


LINE = path_of((0, 0, 0), (1, 2, 0), (2, 4, 0), (4, 8, 0))
VERTICAL = path_of((0, 0, 0), (0, 0, 1), (0, 0, 3))
CIRCLE = path_of(*((np.cos(a), np.sin(a), 0) for a in np.arange(6) * np.pi / 3))
BACKWARDS = path_of(*((np.cos(a), -np.sin(a), 0) for a in np.arange(6) * np.pi / 3))


@pytest.mark.parametrize(
    ("align", "estimate", "truth"),
    [
        ("se3", LINE, LINE),
        ("se3", path_of((0, 0, 0), (1, 0, 0)), path_of((0, 0, 0), (1, 0, 0))),
        ("se3", VERTICAL, TRUTH),
        ("yaw", VERTICAL, VERTICAL),
        ("yaw", LINE, path_of(*[(1, 2, 3)] * 4)),  # the truth stands still
        ("yaw", path_of((5, 5, 5)), path_of((6, 6, 6))),
        ("yaw", CIRCLE, BACKWARDS),  # the other way round: every yaw fits equally badly
    ],
)
def test_an_undetermined_alignment_is_refused(align, estimate, truth):
    truth = Trajectory(np.arange(float(len(truth))), truth.poses)
    with pytest.raises(TerrainLoopError, match="leave the rotation undetermined"):
        trajectory_error(estimate, truth, align=align)
    assert trajectory_error(estimate, truth, align="first").absolute.translation[0] < 1e-11


def test_two_poses_determine_yaw():
    error = trajectory_error(path_of((0, 0, 0), (1, 0, 0)), path_of((5, 5, 1), (5, 7, 1)))
    np.testing.assert_allclose(error.absolute.translation, [0.5, 0.5])
    assert len(error.relative) == 0
    assert np.isnan(error.as_dict()["rpe_m"]["rms"])
    assert str(error).endswith("; RPE over 10 m undefined (pairs: 0)")


@pytest.mark.parametrize(
    "span",
    [
        (0, "m"),
        (-1, "m"),
        (np.nan, "m"),
        (np.inf, "m"),
        (1.5, "poses"),
        (0, "poses"),
        (np.inf, "poses"),
        (1, "s"),
    ],
)
def test_impossible_spans_are_refused(span):
    with pytest.raises(TerrainLoopError, match="a positive distance"):
        Span(*span)


@pytest.mark.parametrize("tolerance", [-0.1, np.nan, np.inf])
def test_impossible_tolerances_are_refused(tolerance):
    with pytest.raises(TerrainLoopError, match="a tolerance"):
        trajectory_error(ESTIMATE, TRUTH, stamp_tolerance=tolerance)


def test_another_alignment_is_refused():
    with pytest.raises(TerrainLoopError, match="found 'sim3'"):
        trajectory_error(ESTIMATE, TRUTH, align="sim3")


def test_an_error_describes_itself():
    error = trajectory_error(
        path_of((0, 0, 0), (1, 0, 0), (2, 0, 0)),
        path_of((0, 3, 0), (1, 3, 0), (2, 3, 0)),
        align="none",
        span=Span(1, "poses"),
    )
    ate, rpe = str(error).split("; ")
    assert ate == "ATE 3 m and 0 deg rms (poses: 3, alignment: none)"
    assert rpe == "RPE over 1 pose 0 m and 0 deg rms (pairs: 2)"
    told = error.as_dict()
    assert told["ate_m"] == dict.fromkeys(NUMBERS, 3.0)
    assert (told["poses"], told["length_m"], told["rpe_pairs"]) == (3, 2.0, 2)
    assert (told["rpe_delta"], told["rpe_delta_unit"]) == (1, "poses")


# --- a run, and the command


SUBMAPS = [replace(record, stamp=100.0 + number) for number, record in enumerate(RECORDS)]
USABLE = [number for number, record in enumerate(SUBMAPS) if record.status == "ok"]
DRIFTED = np.array([pose @ translation([0.0, 0.0, 0.1 * k]) for k, pose in enumerate(POSES)])


@pytest.fixture
def run(tmp_path):
    """A run whose corrected poses are true, with odometry beside its truth; the third cloud is broken."""
    folder = tmp_path / "out"
    truth = write_run(folder, [right("d", "a"), right("e", "a")], SUBMAPS)
    truth.rename(tmp_path / "truth.tum")
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(5.0), DRIFTED))
    write_tum(folder / "poses.tum", Trajectory(100.0 + np.array(USABLE), POSES[USABLE]))
    return folder


def errors_of(run, **options):
    truth = run.parent / "truth.tum"
    return run_trajectory_errors(run, truth, evaluate_run(run, truth), **options)


def test_trajectories_of_a_run(run):
    errors = errors_of(run, align="none")
    assert list(errors) == ["odometry.tum", "poses.tum"]
    np.testing.assert_allclose(errors["odometry.tum"].absolute.translation, [0.0, 0.1, 0.3, 0.4])
    assert errors["poses.tum"].absolute.translation.max() < 1e-12
    assert {str(error.span) for error in errors.values()} == {"1 pose"}
    write_tum(run / "odometry.tum", Trajectory(np.arange(5.0), POSES))  # comes first
    assert errors_of(run, align="none")["odometry.tum"].absolute.translation.max() < 1e-12


def test_a_trajectory_of_all_scans_is_compared_at_the_stamps_of_the_truth(run):
    stamps = np.arange(0.0, 4.5, 0.25)
    poses = np.array([POSES[int(stamp)] @ translation([0, stamp % 1, 0]) for stamp in stamps])
    write_tum(run / "trajectory.tum", Trajectory(stamps, poses))
    error = errors_of(run)["trajectory.tum"]
    np.testing.assert_array_equal(error.stamps, np.arange(5.0))
    assert error.absolute.translation.max() < 1e-12
    assert str(error.span) == "10 m"


@pytest.mark.parametrize(
    ("name", "trajectory", "named"),
    [
        ("odometry.tum", Trajectory(np.arange(4.0), POSES[:4]), "5 poses, one for each cloud"),
        ("poses.tum", Trajectory(np.arange(4.0), POSES[USABLE]), "stamps"),
        ("trajectory.tum", Trajectory(np.full(1, 2.0), POSES[:1]), "undetermined"),
    ],
)
def test_a_trajectory_that_does_not_fit_the_run_is_logged(run, caplog, name, trajectory, named):
    expected = set(errors_of(run)) - {name}
    write_tum(run / name, trajectory)
    assert set(errors_of(run)) == expected
    assert named in caplog.text
    assert str(run / name) in caplog.text


def invoke(cli, *arguments):
    code, out, err = cli("evaluate", *arguments)
    return code, out if code == 0 else err


def test_the_command_on_a_run(cli, run):
    arguments = [run, "--truth", run.parent / "truth.tum", "--align", "none"]
    code, out = invoke(cli, *arguments, "--json")
    assert code == 0
    expected = {name: error.as_dict() for name, error in errors_of(run, align="none").items()}
    assert json.loads(out)["trajectories"] == expected
    code, out = invoke(cli, *arguments)
    assert f"odometry.tum: {errors_of(run, align='none')['odometry.tum']}." in out


@pytest.fixture
def files(tmp_path):
    for name, trajectory in (("estimate", ESTIMATE), ("truth", TRUTH)):
        write_tum(tmp_path / f"{name}.tum", trajectory)
    return tmp_path / "estimate.tum", tmp_path / "truth.tum"


@pytest.mark.parametrize("align", ["yaw", "se3", "first", "none"])
def test_the_command_on_a_trajectory(cli, files, align):
    arguments = [files[0], "--truth", files[1], "--align", align]
    code, out = invoke(cli, *arguments, "--json")
    expected = trajectory_error(*map(read_trajectory, files), align=align)
    assert (code, json.loads(out)) == (0, expected.as_dict())
    code, out = invoke(cli, *arguments, "--rpe-poses", 2)
    assert f"{expected.absolute.statistics[0].rms:.3f}" in out
    assert "RPE over 2 poses, deg" in out
    assert "118 pairs" in out
    assert not (files[0].parent / "precision_recall.csv").exists()


def test_the_command_takes_the_span_and_the_tolerance(cli, files):
    arguments = [files[0], "--truth", files[1], "--json"]
    _, out = invoke(cli, *arguments, "--rpe-distance", 5)
    assert (
        json.loads(out)["rpe_m"]
        == trajectory_error(*map(read_trajectory, files), span=Span(5)).as_dict()["rpe_m"]
    )
    write_tum(files[1], Trajectory(TRUTH.stamps + 0.05, TRUTH.poses))
    assert "stamps" in invoke(cli, *arguments)[1]
    assert json.loads(invoke(cli, *arguments, "--stamp-tolerance", 0.1)[1])["poses"] == len(TRUTH)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--rpe-distance", 1, "--rpe-poses", 1], "either --rpe-distance or --rpe-poses"),
        (["--rpe-distance", -1], "a positive distance"),
        (["--align", "sim3"], "--align"),
        (["--stamp-tolerance", -1], "--stamp-tolerance"),
    ],
)
def test_the_command_refuses_impossible_options(cli, files, options, named):
    code, err = invoke(cli, files[0], "--truth", files[1], *options)
    assert code == 2
    assert named in err


def test_the_command_names_an_absent_trajectory(cli, files):
    code, err = invoke(cli, files[0].parent / "absent.tum", "--truth", files[1])
    assert code == 2
    assert "absent.tum: No such file" in err


# --- evo, as a separate program

EVO = shutil.which("evo_ape", path=os.environ.get("EVO_BIN"))
EVO_NAMES = dict(zip(NUMBERS, ("rmse", "mean", "median", "max"), strict=True))


def evo(program, result, files, *options):
    """The numbers that evo computes, under our names."""
    path = Path(EVO).with_name(program)
    arguments = ["tum", files[1], files[0], *options, "--save_results", result, "--no_warnings"]
    environment = os.environ | {"HOME": str(result.parent), "MPLBACKEND": "agg"}
    subprocess.run([path, *arguments], check=True, capture_output=True, timeout=120, env=environment)
    with ZipFile(result) as archive:
        told = json.loads(archive.read("stats.json"))
    return {ours: told[theirs] for ours, theirs in EVO_NAMES.items()}


@pytest.mark.skipif(EVO is None, reason="evo is not installed (on PATH, or in the folder EVO_BIN)")
@pytest.mark.parametrize("align", ["se3", "first", "none"])
def test_against_evo(files, tmp_path, align):
    """Files of different lengths, with jittered stamps and, in the estimate, stops."""
    rng = np.random.default_rng(3)
    chosen = np.sort(rng.choice(len(TRUTH), 90, replace=False))
    estimate = ESTIMATE.poses[chosen]
    estimate[40:43] = estimate[40]
    write_tum(files[0], Trajectory(ESTIMATE.stamps[chosen] + rng.uniform(-0.008, 0.008, 90), estimate))
    option = {"se3": ["--align"], "first": ["--align_origin"], "none": []}[align]
    spans = [
        (Span(10.0), ["--delta", "10", "--delta_unit", "m"]),
        (Span(1, "poses"), ["--delta", "1", "--delta_unit", "f"]),
        (Span(7, "poses"), ["--delta", "7", "--delta_unit", "f"]),
    ]
    trajectories = [read_trajectory(file) for file in files]
    told = trajectory_error(*trajectories, align=align).as_dict()
    for unit, relation in (("m", "trans_part"), ("deg", "angle_deg")):
        theirs = evo("evo_ape", tmp_path / f"ape_{unit}.zip", files, "-r", relation, *option)
        assert told[f"ate_{unit}"] == pytest.approx(theirs, rel=1e-6)
        for number, (span, options) in enumerate(spans):
            told_rpe = trajectory_error(*trajectories, align=align, span=span).as_dict()
            result = tmp_path / f"rpe_{unit}_{number}.zip"
            theirs = evo("evo_rpe", result, files, "-r", relation, *options, "--all_pairs", *option)
            assert told_rpe[f"rpe_{unit}"] == pytest.approx(theirs, rel=1e-6)
