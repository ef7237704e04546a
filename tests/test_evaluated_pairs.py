"""Pairs, queries, revisits and runs against ground truth: closed forms, counts by hand, naive loops."""

import csv
import json
from collections import namedtuple
from dataclasses import astuple, replace
from inspect import signature

import numpy as np
import pytest
from evaluation_util import (
    HULL,
    NAMES,
    POSES,
    RECORDS,
    SQUARE,
    candidate,
    record,
    right,
    true_pose,
    write_run,
    wrong,
)
from scipy.spatial.transform import Rotation

from terrainloop.cli.evaluate import command
from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.criteria import criteria
from terrainloop.evaluation.pairs import YAW_TOLERANCE, Tolerance, evaluate_pairs
from terrainloop.evaluation.retrieval import Retrieval, retrieval
from terrainloop.evaluation.summary import evaluate_run
from terrainloop.evaluation.truth import MIN_OVERLAP, GroundTruth
from terrainloop.geometry import inverse, se3

METRE = Tolerance(1.0)
NO_POSE = np.full((4, 4), np.nan)


def evaluated(*pairs, poses=POSES, tolerance=METRE, **truth):
    return evaluate_pairs(pairs, GroundTruth(RECORDS, poses, **truth), tolerance)


# --- errors of a pose


def test_a_true_pose_has_no_error():
    (pair,) = evaluated(right("d", "a"))
    errors = pair.position_error, pair.height_error, pair.yaw_error, pair.rotation_error
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)
    assert pair.pose_is_right
    assert pair.is_within(1e-9, 1e-9)
    # a covers x from -0.5 to 1.5; d, turned about by half a turn, from -0.5 to 1.5 too.
    assert pair.overlap == pytest.approx(1.0)
    assert pair.query == 3


def test_position_errors_are_those_in_the_target_frame():
    T = se3(0.3, -0.4, 0.25, 0.0, 0.0, 0.0) @ true_pose("d", "a")
    (pair,) = evaluated(candidate("d", "a", T))
    assert pair.position_error == pytest.approx(0.5)
    assert pair.height_error == pytest.approx(0.25)
    assert pair.yaw_error == pytest.approx(0.0, abs=1e-12)
    assert pair.pose_is_right
    distance = np.sqrt(0.5**2 + 0.25**2)
    assert pair.is_within(distance + 1e-9, 0.1)
    assert not pair.is_within(distance - 1e-9, 0.1)


@pytest.mark.parametrize("turn", [-0.06, 0.06, 3.0])
def test_yaw_errors_turn_about_the_middle_of_the_source(turn):
    middle = np.array([0.5, 0.0])
    about = se3(*middle, 0, 0, 0, 0) @ se3(0, 0, 0, 0, 0, turn) @ se3(*-middle, 0, 0, 0, 0)
    (pair,) = evaluated(candidate("d", "a", true_pose("d", "a") @ about))
    assert pair.yaw_error == pytest.approx(abs(turn))
    assert pair.rotation_error == pytest.approx(abs(turn))
    assert pair.position_error == pytest.approx(0.0, abs=1e-12)
    assert pair.pose_is_right == (abs(turn) < np.radians(5))


def test_yaw_errors_do_not_wrap():
    """Half a turn, estimated a little short and a little long of it."""
    for turn in (-0.02, 0.02):
        (pair,) = evaluated(candidate("d", "a", true_pose("d", "a") @ se3(0, 0, 0, 0, 0, turn)))
        assert pair.yaw_error == pytest.approx(0.02)


def test_rotation_errors_are_those_of_the_whole_rotation():
    rng = np.random.default_rng(0)
    for angles in [*rng.uniform(-0.5, 0.5, (20, 3)), [0.0, 0.0, np.pi], [1e-7, 0.0, 0.0]]:
        turn = se3(0, 0, 0, *angles)
        (pair,) = evaluated(candidate("e", "b", true_pose("e", "b") @ turn))
        assert pair.rotation_error == pytest.approx(Rotation.from_matrix(turn[:3, :3]).magnitude(), rel=1e-6)


def test_a_tilted_pose_is_right_by_yaw_but_not_within_five_degrees():
    T = true_pose("d", "a") @ se3(0, 0, 0, 0, np.radians(8), 0)
    (pair,) = evaluated(candidate("d", "a", T))
    assert pair.pose_is_right
    assert not pair.is_within(2.0, np.radians(5))


@pytest.mark.parametrize("shift", [0.9, 1.1, 50.0])
def test_a_pose_a_metre_off_is_another_place(shift):
    (pair,) = evaluated(candidate("d", "a", se3(shift, 0, 0, 0, 0, 0) @ true_pose("d", "a")))
    assert pair.pose_is_right == (shift < 1.0)


def test_without_a_transform_there_is_no_error():
    (pair,) = evaluated(candidate("d", "a", NO_POSE, accepted=False))
    errors = pair.position_error, pair.height_error, pair.yaw_error, pair.rotation_error
    assert np.isnan(errors).all()
    assert not pair.pose_is_right
    assert not pair.is_within(np.inf, np.inf)
    assert pair.overlap == pytest.approx(1.0)


# --- tolerance


@pytest.mark.parametrize(
    ("side", "expected"),
    [
        (2, 0.2),
        (5, 0.5),
        (9, 0.9),
        (10, 1.0),
        (11, 1.0),
        (35, 1.0),
        (46, 1.0),
        (50, 1.0),
        (75, 1.5),
        (500, 10),
    ],
)
def test_default_tolerance_by_the_size_of_the_submaps(side, expected):
    other = record("x", SQUARE * 1e4)  # one of three does not move the median
    records = [record("a", SQUARE * side / 2), record("b", SQUARE * side / 2), other, RECORDS[2]]
    tolerance = Tolerance.for_submaps(records)
    assert tolerance.position == pytest.approx(expected)
    assert tolerance.yaw == np.radians(5)


def test_the_size_of_a_submap_is_that_of_its_hull_wherever_it_is():
    triangle = np.array([[0.0, 0], [4, 0], [0, 8]]) + np.array([4e5, 5e6])  # 16 square metres
    assert Tolerance.for_submaps([record("a", triangle)]).position == pytest.approx(0.4)


def test_a_given_tolerance_is_taken():
    assert Tolerance.for_submaps(RECORDS, 0.3, 0.2) == Tolerance(0.3, 0.2)
    T = se3(0.5, 0, 0, 0, 0, 0) @ true_pose("d", "a")
    for tolerance, expected in ((Tolerance(0.6), True), (Tolerance(0.4), False), (None, False)):
        (pair,) = evaluated(candidate("d", "a", T), tolerance=tolerance)
        assert pair.pose_is_right == expected
    turned = true_pose("d", "a") @ se3(0, 0, 0, 0, 0, 0.15)
    (pair,) = evaluated(candidate("d", "a", turned), tolerance=Tolerance(1.0, 0.2))
    assert pair.pose_is_right


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["position", "yaw"])
def test_a_tolerance_that_is_no_number_above_0(name, value):
    with pytest.raises(TerrainLoopError, match=f"a {name} tolerance above 0"):
        Tolerance(**{name: value})


def test_defaults_of_the_command_are_those_of_the_library():
    defaults = {name: parameter.default for name, parameter in signature(command).parameters.items()}
    assert defaults["min_overlap"] == MIN_OVERLAP
    assert np.radians(defaults["yaw_tolerance"]) == YAW_TOLERANCE
    assert defaults["position_tolerance"] is None


# --- which pairs count


def test_consecutive_submaps_are_left_out():
    pairs = [right(a, b) for i, a in enumerate(NAMES) for b in NAMES[:i] if "c" not in a + b]
    kept = [p.candidate.source + p.candidate.target for p in evaluated(*pairs)]
    assert kept == ["da", "db", "ea", "eb"]  # b and d have c between them


def test_pairs_of_one_session_are_left_out():
    sessions = {"a": "1", "b": "2", "c": "2", "d": "1", "e": "3"}
    pairs = evaluated(*(right(a, b) for a, b in ("da", "db", "ea", "eb")), sessions=sessions)
    assert [p.candidate.source + p.candidate.target for p in pairs] == ["db", "ea", "eb"]


def test_overlap_is_that_of_the_posed_boxes():
    poses = POSES.copy()
    poses[4] = se3(1.0, 0.5, 0.0, 0.0, 0.0, 0.0)  # shares (2 - 1) x (2 - 0.5) m with a
    (pair,) = evaluated(candidate("e", "a", np.eye(4)), poses=poses)
    assert pair.overlap == pytest.approx(1.5 / (8 - 1.5))
    (apart,) = evaluated(candidate("e", "a", np.eye(4)))
    assert apart.overlap == 0.0


Scored = namedtuple("Scored", "source target score T_target_source")


def test_any_scored_pair_is_evaluated():
    """The pairs of a baseline are evaluated as loop candidates are."""
    T = se3(0.3, 0, 0, 0, 0, 0.01) @ true_pose("d", "a")
    (theirs,), (ours,) = (evaluated(pair) for pair in (Scored("d", "a", 9.0, T), candidate("d", "a", T)))
    assert theirs.candidate.score == 9.0
    assert [getattr(theirs, name) for name in ("position_error", "yaw_error", "overlap")] == [
        getattr(ours, name) for name in ("position_error", "yaw_error", "overlap")
    ]


def test_observed_overlap_is_handed_on():
    observed = np.arange(25.0).reshape(5, 5) / 25
    pairs = right("d", "a"), right("e", "b")
    assert [p.observed_overlap for p in evaluated(*pairs, observed=observed)] == [15 / 25, 21 / 25]
    assert np.isnan([p.observed_overlap for p in evaluated(*pairs)]).all()


# --- criteria


def test_criteria_of_correctness():
    """Four pairs: true and right; true and wrong; little overlap and right; none and wrong."""
    poses = POSES.copy()
    poses[4] = se3(1.5, 0.0, 0.0, 0.0, 0.0, 0.0)  # e shares 1/7 with a, as much with d
    off = se3(5, 0, 0, 0, 0, 0)
    pairs = [
        Scored("d", "a", 5.0, true_pose("d", "a")),
        Scored("e", "a", 3.0, true_pose("e", "a", poses)),
        Scored("e", "b", 2.0, off),
        Scored("d", "b", 4.0, off),
    ]
    observed = np.zeros((5, 5))
    observed[3, 1] = observed[4, 0] = 0.5
    both = evaluated(*pairs, poses=poses, observed=observed)

    def counted(criterion):
        points = criterion.curve()
        return [(p.threshold, p.true_positives, p.false_positives, p.false_negatives) for p in points]

    by = criteria(both, 0.3)
    assert list(by) == ["overlap", "overlap and pose", "pose"]
    assert counted(by["overlap"]) == [(5, 1, 0, 0), (4, 1, 1, 0), (3, 1, 2, 0), (2, 1, 3, 0)]
    assert counted(by["overlap and pose"]) == counted(by["overlap"])
    assert counted(by["pose"]) == [(5, 1, 0, 0), (4, 1, 1, 0), (2, 1, 2, 0)]
    seen = criteria(both, 0.3, observed=True)
    assert counted(seen["overlap"]) == [(5, 0, 1, 2), (4, 1, 1, 1), (3, 2, 1, 0), (2, 2, 2, 0)]
    assert counted(seen["overlap and pose"]) == [(5, 0, 1, 2), (4, 0, 2, 2), (3, 1, 2, 1), (2, 1, 3, 1)]
    assert counted(seen["pose"]) == [(4, 0, 1, 2), (3, 1, 1, 1), (2, 1, 2, 1)]
    assert seen["pose"].metrics().average_precision.value == pytest.approx(1 / 4)
    turned = criteria(both, 0.3, scores=[2, 3, 4, 5])
    assert counted(turned["overlap"]) == [(5, 0, 1, 1), (4, 0, 2, 1), (3, 0, 3, 1), (2, 1, 3, 0)]


def test_criteria_of_no_pairs():
    for criterion in criteria([], 0.3).values():
        assert criterion.curve() == []
        assert criterion.metrics().pairs == 0


# --- queries and revisits


def counts(*pairs, **truth):
    known = GroundTruth(RECORDS, POSES, **truth)
    found = evaluate_pairs(pairs, known, METRE)
    return retrieval(found, [pair.candidate.score for pair in found], known, 0.3)


def test_the_best_match_of_a_query_counts():
    """d revisits a; e revisits nothing."""
    assert counts(right("d", "a", score=5.0), wrong("d", "b", score=4.0)) == Retrieval(1, 1, 1, 1, 1, 1)
    assert counts(right("d", "a", score=4.0), wrong("d", "b", score=5.0)) == Retrieval(1, 0, 1, 0, 1, 1)
    other = wrong("d", "b", score=5.0, accepted=False)
    assert counts(right("d", "a", score=4.0), other) == Retrieval(1, 0, 1, 1, 1, 1)


def test_a_tie_is_right_if_all_of_it_is():
    pairs = right("d", "a", score=5.0), wrong("d", "b", score=5.0)
    assert counts(*pairs).right_at_one == counts(*pairs[::-1]).right_at_one == 0
    assert counts(right("d", "a", score=5.0), right("d", "b", score=5.0)).right_at_one == 1


def test_a_loop_of_a_query_without_a_true_pair_counts_for_precision_only():
    assert counts(right("d", "a"), wrong("e", "a")) == Retrieval(1, 1, 2, 1, 1, 1)


def test_a_right_loop_to_another_submap_closes_the_revisit():
    result = counts(wrong("d", "a", score=5.0, accepted=False), right("d", "b", score=7.0))
    assert result == Retrieval(1, 1, 1, 1, 1, 1)


def test_a_query_whose_pairs_were_not_comparable_is_not_right():
    pairs = right("d", "a", score=-np.inf, accepted=False), wrong("e", "a", accepted=False)
    assert counts(*pairs) == Retrieval(1, 0, 0, 0, 1, 0)


def test_a_revisit_that_was_never_compared_stays_open():
    result = counts(wrong("e", "b", accepted=False))
    assert result == Retrieval(0, 0, 0, 0, 1, 0)
    assert result.closed_share == 0.0
    assert np.isnan([result.recall_at_one, result.precision_at_one]).all()
    assert np.isnan(counts(sessions=dict.fromkeys(NAMES, "one")).closed_share)


def naive_boxes(records, poses):
    """Bounding-box IoU, corner by corner."""
    boxes = []
    for one, pose in zip(records, poses, strict=True):
        corners = [(pose @ [x, y, 0, 1])[:2] for x, y in one.hull]
        boxes.append([[f(c[k] for c in corners) for f in (min, max)] for k in (0, 1)])

    def iou(a, b):
        sides = [max(0.0, min(p[1], q[1]) - max(p[0], q[0])) for p, q in zip(a, b, strict=True)]
        areas = [(box[0][1] - box[0][0]) * (box[1][1] - box[1][0]) for box in (a, b)]
        return sides[0] * sides[1] / (sum(areas) - sides[0] * sides[1])

    return [[iou(a, b) for b in boxes] for a in boxes]


def naive_retrieval(pairs, is_right, iou, names, sessions, least):
    """The definitions of docs/evaluation.md, query by query."""
    n = len(names)
    number = {name: i for i, name in enumerate(names)}
    counted = [0] * 6
    for query in range(n):
        mine = []
        for pair, good in zip(pairs, is_right, strict=True):
            i, j = number[pair.source], number[pair.target]
            if max(i, j) == query and abs(i - j) != 1 and sessions[names[i]] != sessions[names[j]]:
                mine.append((pair.score, good, pair.accepted, iou[i][j]))
        if any(shared > least for *_, shared in mine):
            counted[0] += 1
            top = max(score for score, *_ in mine)
            counted[1] += top > -np.inf and all(good for score, good, *_ in mine if score == top)
        loops = [(score, good) for score, good, accepted, _ in mine if accepted]
        if loops:
            counted[2] += 1
            counted[3] += all(good for score, good in loops if score == max(loops)[0])
        if any(
            iou[query][j] > least and sessions[names[query]] != sessions[names[j]] for j in range(query - 1)
        ):
            counted[4] += 1
            counted[5] += any(good for _, good in loops)
    return Retrieval(*counted)


@pytest.mark.parametrize("seed", range(12))
def test_retrieval_equals_the_naive_count(seed):
    rng = np.random.default_rng(seed)
    names = [f"s{i}" for i in range(14)]
    poses = np.array([se3(*rng.uniform(0, 6, 2), 0, 0, 0, rng.uniform(-3, 3)) for _ in names])
    records = [record(name, SQUARE * rng.uniform(0.8, 2.0, 2)) for name in names]
    sessions = {name: str(rng.integers(3)) if seed % 3 else name for name in names}
    pairs, is_right = [], []
    for i in range(14):
        for j in range(i):
            if rng.random() < 0.85:
                good, swap = rng.random() < 0.6, rng.random() < 0.2
                shift = rng.uniform(-0.2, 0.2) if good else rng.uniform(2, 3)
                a, b = (j, i) if swap else (i, j)
                T = se3(shift, 0, 0, 0, 0, 0) @ inverse(poses[b]) @ poses[a]
                score = -np.inf if rng.random() < 0.1 else float(rng.integers(6))
                accepted = bool(score > 2)
                pairs.append(candidate(names[a], names[b], T, score=score, accepted=accepted))
                is_right.append(good)
    known = GroundTruth(records, poses, sessions)
    found = evaluate_pairs(pairs, known, METRE)
    result = retrieval(found, [pair.candidate.score for pair in found], known, 0.3)
    iou = naive_boxes(records, poses)
    np.testing.assert_allclose(known.box_overlap, iou, rtol=0, atol=1e-12)
    assert result == naive_retrieval(pairs, is_right, iou, names, sessions, 0.3)
    assert result.revisits > 2
    assert result.queries > 1


def test_revisits_by_the_observed_ground():
    observed = np.zeros((5, 5))
    observed[4, 1] = observed[4, 3] = observed[1, 4] = 0.4  # d is e's predecessor
    known = GroundTruth(RECORDS, POSES, observed=observed)
    assert known.revisits(0.3).tolist() == [3]
    assert known.revisits(0.3, observed=True).tolist() == [4]
    assert known.revisits(0.4, observed=True).tolist() == []


# --- what is refused


@pytest.mark.parametrize("count", [0, 4])
def test_another_number_of_poses_is_an_error(count):
    with pytest.raises(TerrainLoopError, match=rf"5 submaps; found {count} poses"):
        GroundTruth(RECORDS, POSES[:count])


def skewed(pose, change):
    pose = pose.copy()
    pose[:3, :3] = change @ pose[:3, :3]
    return pose


@pytest.mark.parametrize(
    "pose",
    [
        np.zeros((4, 4)),
        np.diag([0.0, 0, 0, 1]),  # a quaternion that overflows
        np.full((4, 4), np.nan),
        se3(np.inf, 0, 0, 0, 0, 0),
        se3(0, 1e200, 0, 0, 0, 0),
        skewed(POSES[1], np.diag([1.0, -1, 1])),
        skewed(POSES[1], 1.1 * np.eye(3)),
        skewed(POSES[1], 1e200 * np.eye(3)),
        np.eye(4)[[0, 1, 2, 2]],
    ],
)
def test_a_true_pose_that_is_not_rigid_is_an_error(pose):
    poses = POSES.copy()
    poses[1] = pose
    with pytest.raises(TerrainLoopError, match=r"true poses with a rotation .* no such pose for 'b'"):
        GroundTruth(RECORDS, poses)


@pytest.mark.parametrize("tilt", [[np.pi, 0], [0, 1.0], [-1.6, 0]])
def test_a_truth_that_is_not_gravity_aligned_is_an_error(tilt):
    poses = POSES.copy()
    poses[4] = se3(1, 2, 3, *tilt, 0.3)
    with pytest.raises(TerrainLoopError, match=r"z up; found a tilt of \d+ deg at pose 5"):
        GroundTruth(RECORDS, poses)


@pytest.mark.parametrize(
    "hull",
    [
        np.empty((0, 2)),
        HULL[:1],
        HULL[:2],
        HULL[[0, 1, 1]],
        np.where(HULL > 1, np.nan, HULL),
        np.where(HULL > 1, np.inf, HULL),
        HULL * 1e12,
    ],
)
def test_a_hull_without_area_is_an_error(hull):
    records = [record("a"), record("b", hull), *RECORDS[2:]]
    with pytest.raises(TerrainLoopError, match=r"three or more finite corners .* for 'b'"):
        GroundTruth(records, POSES)


def test_a_name_that_repeats_is_an_error():
    records = [*RECORDS[:4], record("b")]
    with pytest.raises(TerrainLoopError, match=r"every submap once .* 'b' 2 times"):
        GroundTruth(records, POSES)


@pytest.mark.parametrize("sessions", [{}, {"a": "1"}, dict.fromkeys("abce", "1")])
def test_a_name_without_session_is_an_error(sessions):
    with pytest.raises(TerrainLoopError, match="a session for every submap"):
        GroundTruth(RECORDS, POSES, sessions)


def moved(x=0.0, roll=0.0):
    T = true_pose("d", "a").copy()
    T[0, 3] += x
    T[0, 0] += roll
    return T


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([right("d", "a"), candidate("z", "a", np.eye(4))], "no 'z'"),
        ([candidate("a", "z" * 10**6, np.eye(4))], "no 'zzz"),
        ([candidate("c", "a", np.eye(4))], "'c', which is marked as broken"),
        ([right("a", "a")], "two different submaps"),
        ([right("d", "a"), right("e", "a"), right("d", "a", score=3.0)], "every pair once"),
        ([right("d", "a"), right("a", "d")], "every pair once"),
        ([right("d", "a", score=np.nan)], "a score that is a number"),
        ([right("d", "a", score=np.inf)], "a score that is a number"),
        ([candidate("d", "a", moved(x=np.inf))], "a rigid transform"),
        ([candidate("d", "a", moved(x=np.nan))], "a rigid transform"),
        ([candidate("d", "a", moved(x=1e300))], "a rigid transform"),
        ([candidate("d", "a", moved(roll=0.1))], "a rigid transform"),
        ([candidate("b", "a", np.zeros((4, 4)))], "a rigid transform"),  # also of a pair that is left out
    ],
)
def test_a_faulty_pair_is_an_error(pairs, message):
    with pytest.raises(TerrainLoopError, match=message) as error:
        evaluated(*pairs)
    assert len(str(error.value)) < 400


# --- a run


def test_everything_of_a_run(tmp_path):
    """One right loop on a revisit, one wrong loop, one pair without a pose, one consecutive pair."""
    T = se3(0.1, 0, 0.05, 0, 0, 0.01) @ true_pose("d", "a")
    pairs = [
        candidate("d", "a", T, score=12.0),
        wrong("e", "a", score=7.0),
        wrong("e", "b", score=1.5, accepted=False),
        candidate("d", "b", NO_POSE, score=0.0, accepted=False),
        right("b", "a"),
    ]
    evaluation = evaluate_run(tmp_path, write_run(tmp_path, pairs), position_tolerance=0.4)
    result = evaluation.as_dict()
    assert (result["pairs"], result["pairs_left_out"]) == (4, 1)
    assert (result["accepted"], result["accepted_right_pose"], result["accepted_wrong_pose"]) == (2, 1, 1)
    assert result["share_within_2m_5deg"] == result["share_yaw_within_10deg"] - 0.5 == 0.5
    assert result["right_pose_median_height_error_m"] == pytest.approx(0.05)
    assert result["right_pose_median_yaw_error_deg"] == pytest.approx(np.degrees(0.01))
    (row,) = result["retrieval"]
    assert row == {
        **{"truth": "box", "true_pairs": 1, "true_pairs_found": 1},
        **{"queries": 1, "right_at_one": 1, "answered": 2, "answered_right": 1, "revisits": 1, "closed": 1},
        **{"recall_at_one": 1.0, "precision_at_one": 0.5, "closed_share": 1.0},
    }
    at = {point["min_score"]: point for point in result["precision_recall"]}
    assert list(at) == [0, 1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 50]
    assert (at[1]["right_poses"], at[1]["wrong_poses"]) == (1, 2)
    assert (at[6]["right_poses"], at[6]["wrong_poses"]) == (1, 1)
    assert at[6]["pose_precision"] == at[6]["precision"] == 0.5
    assert at[10]["pose_precision"] == at[10]["pose_recall"] == 1.0
    assert np.isnan(at[15]["pose_precision"])
    assert at[15]["pose_recall"] == 0.0
    assert result["recall_before_first_disjoint"] == pytest.approx(
        {"0.1-0.3": np.nan, "0.3-1": 1.0}, nan_ok=True
    )


def chain(count, spacing=3.0):
    """Submaps of 2 m in a row, too far apart to share ground, and their poses."""
    poses = np.array([se3(spacing * i, 0, 0, 0, 0, 0) for i in range(count)])
    return [record(f"s{i}", SQUARE) for i in range(count)], poses


@pytest.mark.parametrize(
    ("error", "within", "yaw_within"),
    [
        (se3(1.9, 0, 0, 0, 0, 0), 1, 1),
        (se3(2.1, 0, 0, 0, 0, 0), 0, 1),
        (se3(1.5, 0, 1.5, 0, 0, 0), 0, 1),  # 2.1 m in space
        (se3(0, 0, 0, 0, 0, np.radians(4.9)), 1, 1),
        (se3(0, 0, 0, 0, 0, np.radians(5.1)), 0, 1),
        (se3(0, 0, 0, np.radians(5.1), 0, 0), 0, 1),
        (se3(0, 0, 0, 0, 0, np.radians(-9.9)), 0, 1),
        (se3(0, 0, 0, 0, 0, np.radians(10.1)), 0, 0),
    ],
)
def test_shares_that_others_report(tmp_path, error, within, yaw_within):
    """The error is one at the middle of the source; a second loop is far off."""
    records, poses = chain(3)
    pairs = [candidate("s2", "s0", inverse(poses[0]) @ poses[2] @ error)]
    result = evaluate_run(tmp_path, write_run(tmp_path, pairs, records, poses)).as_dict()
    assert (result["share_within_2m_5deg"], result["share_yaw_within_10deg"]) == (within, yaw_within)


def test_pairs_by_bands_of_overlap(tmp_path):
    """Squares of 2 m at distance d share (2 - d) / (2 + d)."""
    overlaps = [0.05, 0.1 + 1e-6, 0.2, 0.3 - 1e-6, 0.3 + 1e-6, 0.6, 1.0, 0.0]
    distances = [2 * (1 - o) / (1 + o) for o in overlaps]
    others, lonely = chain(2 * len(overlaps), spacing=100.0)
    poses = lonely.copy()
    poses[1::2, :2, 3] = poses[0, :2, 3] + np.c_[distances, np.zeros(len(overlaps))]
    pairs = [
        candidate(f"s{i}", "s0", inverse(poses[0]) @ poses[i], score=float(i))
        for i in range(3, len(poses), 2)
    ]
    result = evaluate_run(tmp_path, write_run(tmp_path, pairs, others, poses)).as_dict()
    assert result["pairs_by_overlap"] == {"0.1-0.3": 3, "0.3-1": 3}
    assert (result["true_pairs"], result["disjoint_pairs"]) == (3, 1)
    assert result["recall_before_first_disjoint"] == {"0.1-0.3": 0.0, "0.3-1": 0.0}  # the last scores most


def test_a_right_pose_on_little_overlap_is_right_by_pose(tmp_path):
    """A perfect run is not called wrong because a pair shares less than the paper asks for."""
    poses = POSES.copy()
    poses[4] = se3(1.5, 0.0, 0.0, 0.0, 0.0, 0.0)  # e shares 1/7 with a
    pairs = [right("d", "a"), candidate("e", "a", true_pose("e", "a", poses))]
    result = evaluate_run(tmp_path, write_run(tmp_path, pairs, poses=poses)).as_dict()
    assert (result["accepted_right_pose"], result["accepted_wrong_pose"]) == (2, 0)
    point = result["precision_recall"][5]
    assert (point["precision"], point["pose_precision"], point["pose_recall"]) == (0.5, 1.0, 1.0)


COLUMNS = ["min_score", "precision", "recall", "true_positives", "false_positives", "false_negatives"]


def test_files_keep_their_columns(tmp_path):
    evaluation = evaluate_run(tmp_path, write_run(tmp_path, [right("d", "a"), wrong("e", "a")]))
    evaluation.write(tmp_path)
    with (tmp_path / "precision_recall.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][:7] == [*COLUMNS, "pose_precision"]
    assert len(rows) == 14
    with (tmp_path / "precision_recall_curve.csv").open(newline="") as file:
        curve = list(csv.reader(file))
    assert curve[0] == ["truth", "right_by", *COLUMNS]
    assert {row[1] for row in curve[1:]} == {"overlap", "overlap and pose", "pose"}


@pytest.mark.parametrize("pairs", [[], [right("b", "a")], [candidate("d", "a", NO_POSE, accepted=False)]])
def test_a_run_without_loops(tmp_path, pairs):
    evaluation = evaluate_run(tmp_path, write_run(tmp_path, pairs))
    result = evaluation.as_dict()
    assert result["accepted"] == result["retrieval"][0]["closed"] == 0
    assert np.isnan(result["share_within_2m_5deg"])
    evaluation.write(tmp_path)
    json.dumps(result)


@pytest.mark.parametrize("least", [-0.1, 1.5, np.nan])
def test_a_minimum_overlap_that_is_no_share(tmp_path, least):
    with pytest.raises(TerrainLoopError, match="between 0 and 1"):
        evaluate_run(tmp_path, write_run(tmp_path, []), min_overlap=least)


def test_inverse_poses_are_noticed(tmp_path):
    """Poses given as T_submap_world make right loops look wrong."""
    poses = np.array([inverse(pose) for pose in POSES])
    pairs = [right("d", "a"), right("d", "b"), right("e", "a"), wrong("e", "b")]
    with pytest.raises(TerrainLoopError, match=r"T_world_submap.*3 of 4 loops .* invert"):
        evaluate_run(tmp_path, write_run(tmp_path, pairs, poses=poses))


def test_wrong_loops_are_not_taken_for_inverse_poses(tmp_path):
    inverted = candidate("d", "b", POSES[1] @ inverse(POSES[3]))
    pairs = [wrong("d", "a"), inverted, wrong("e", "a"), right("e", "b")]
    result = evaluate_run(tmp_path, write_run(tmp_path, pairs)).as_dict()
    assert (result["accepted_right_pose"], result["accepted_wrong_pose"]) == (1, 3)


def test_evaluated_pairs_can_be_changed():
    """Experiments replace what they vary."""
    (pair,) = evaluated(right("d", "a"))
    assert not replace(pair, position_error=5.0).pose_is_right
    assert astuple(replace(pair, tolerance=Tolerance(9.0)).tolerance) == (9.0, YAW_TOLERANCE)
