"""Overlap, precision and recall, and the judge, against closed forms, counts by hand and scikit-learn."""

import numpy as np
import pytest
from sklearn.metrics import precision_recall_fscore_support

from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.judge import judge
from terrainloop.evaluation.overlap import box_iou, world_boxes
from terrainloop.evaluation.precision_recall import OperatingPoint, precision_recall, recall_at_full_precision
from terrainloop.geometry import inverse, se3
from terrainloop.io.results import SubmapRecord
from terrainloop.loop import LoopCandidate

SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])


# --- overlap


def iou_by_counting(a, b):
    """Cells of a fine grid."""
    x, y = np.meshgrid(np.arange(0.005, 10, 0.01), np.arange(0.005, 10, 0.01))
    inside = [(box[0] < x) & (x < box[2]) & (box[1] < y) & (y < box[3]) for box in (a, b)]
    return (inside[0] & inside[1]).sum() / (inside[0] | inside[1]).sum()


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([0, 0, 2, 2], 1.0),
        ([1, 0, 3, 2], 2 / 6),
        ([1, 1, 3, 3], 1 / 7),
        ([0.5, 0.5, 1.5, 1.5], 1 / 4),  # one within the other
        ([0, 0, 2, 1], 1 / 2),
        ([2, 0, 4, 2], 0.0),  # side by side
        ([5, 5, 6, 6], 0.0),
        ([-3, 5, -2, 6], 0.0),
    ],
)
def test_box_iou_in_closed_form(other, expected):
    iou = box_iou(np.array([[0, 0, 2, 2], other], float))
    assert iou[0, 1] == iou[1, 0] == pytest.approx(expected, abs=1e-15)
    np.testing.assert_allclose(np.diag(iou), 1.0)


def test_box_iou_of_many_by_counting():
    rng = np.random.default_rng(0)
    low, size = rng.uniform(0, 6, (6, 2)).round(2), rng.uniform(0.5, 4, (6, 2)).round(2)
    boxes = np.hstack([low, low + size])
    expected = [[iou_by_counting(a, b) for b in boxes] for a in boxes]
    np.testing.assert_allclose(box_iou(boxes), expected, rtol=0, atol=0.01)


def test_no_boxes():
    assert box_iou(world_boxes([], np.empty((0, 4, 4)))).shape == (0, 0)


@pytest.mark.parametrize("turn", [0.0, 30.0, 45.0, 90.0, 200.0])
def test_world_box_of_a_turned_square(turn):
    angle = np.radians(turn)
    half = abs(np.cos(angle)) + abs(np.sin(angle))
    boxes = world_boxes([SQUARE], se3(10.0, 20.0, 5.0, 0.0, 0.0, angle)[None])
    np.testing.assert_allclose(boxes, [[10 - half, 20 - half, 10 + half, 20 + half]], rtol=0, atol=1e-12)


def test_world_box_of_a_lopsided_hull():
    """A triangle's box turns with it: corners (0,0) (4,0) (0,1), a quarter turn to the left."""
    hull = np.array([[0.0, 0], [4, 0], [0, 1]])
    boxes = world_boxes([hull, hull], np.array([np.eye(4), se3(0, 0, 0, 0, 0, np.pi / 2)]))
    np.testing.assert_allclose(boxes, [[0, 0, 4, 1], [-1, 0, 0, 4]], rtol=0, atol=1e-12)


# --- precision and recall

SCORES = [9, 7, 7, 5, 3, 1]
TRUE = [True, True, False, True, False, True]


def test_precision_recall_counted_by_hand():
    points = precision_recall(SCORES, TRUE, [10, 8, 7, 5, 1])
    counted = [(p.true_positives, p.false_positives, p.false_negatives) for p in points]
    assert counted == [(0, 0, 4), (1, 0, 3), (2, 1, 2), (3, 1, 1), (4, 2, 0)]
    assert np.isnan(points[0].precision)
    assert points[0].recall == 0.0
    assert [p.precision for p in points[1:]] == pytest.approx([1, 2 / 3, 3 / 4, 4 / 6])
    assert [p.recall for p in points] == pytest.approx([0, 1 / 4, 2 / 4, 3 / 4, 1])
    assert [p.threshold for p in points] == [10, 8, 7, 5, 1]


def test_precision_recall_equals_scikit_learn():
    rng = np.random.default_rng(0)
    is_true = rng.random(200) < 0.3
    scores = rng.integers(0, 15, 200) + 5 * is_true
    for point in precision_recall(scores, is_true, range(1, 21)):
        precision, recall, _, _ = precision_recall_fscore_support(
            is_true, scores >= point.threshold, average="binary", zero_division=np.nan
        )
        assert point.precision == pytest.approx(precision, nan_ok=True)
        assert point.recall == pytest.approx(recall)


def test_without_pairs_nothing_is_claimed():
    (point,) = precision_recall([], [], [3])
    assert point == OperatingPoint(3.0, 0, 0, 0)
    assert np.isnan(point.precision)
    assert np.isnan(point.recall)


def test_a_score_that_is_no_number_matches_nothing():
    (point,) = precision_recall([np.nan, 5.0], [True, True], [1])
    assert (point.true_positives, point.false_negatives) == (1, 1)


@pytest.mark.parametrize(
    ("positive", "negative", "expected"),
    [
        ([5, 6, 7, 8], [1, 2, 6.5], 0.5),
        ([5, 6], [1, 2], 1.0),
        ([5, 6], [9], 0.0),
        ([5, 6], [], 1.0),
        ([5, 6], [6], 0.0),  # equal is not above
        ([5, 6, 6], [5], 2 / 3),
        ([-5], [], 1.0),
    ],
)
def test_recall_at_full_precision(positive, negative, expected):
    assert recall_at_full_precision(positive, negative) == pytest.approx(expected)


@pytest.mark.parametrize("negative", [[], [3.0]])
def test_recall_without_positives_is_no_number(negative):
    assert np.isnan(recall_at_full_precision([], negative))


# --- the judge

POSES = np.array(
    [
        se3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        se3(20.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        se3(40.0, 0.0, 0.0, 0.0, 0.0, 2.0),  # broken
        se3(1.0, 0.0, 0.3, 0.0, 0.0, np.pi),
        se3(0.0, 30.0, 0.0, 0.02, -0.01, -2.0),
    ]
)
NAMES = "abcde"
# Hulls off the origins of their frames, as those of clouds are.
HULLS = {name: SQUARE + np.array([0.5, 0.0]) for name in NAMES}
RECORDS = [
    SubmapRecord(name, float(i), 0 if name == "c" else 500, "broken" if name == "c" else "ok")
    if name == "c"
    else SubmapRecord(name, float(i), 500, "ok", HULLS[name])
    for i, name in enumerate(NAMES)
]


def candidate(source, target, T, *, accepted=True, score=9.0):
    return LoopCandidate(
        source, target, T, np.eye(6), 9, 1.0, 0.1, 0.5, score, accepted, "constructed"
    )  # fmt: skip


def true(source, target):
    i, j = NAMES.index(source), NAMES.index(target)
    return inverse(POSES[j]) @ POSES[i]


def test_a_true_pose_has_no_error():
    (pair,) = judge([candidate("d", "a", true("d", "a"))], RECORDS, POSES)
    assert pair.position_error == pytest.approx(0.0, abs=1e-12)
    assert pair.height_error == pytest.approx(0.0, abs=1e-12)
    assert pair.yaw_error == pytest.approx(0.0, abs=1e-12)
    assert pair.pose_is_right
    # a covers x from -0.5 to 1.5; d, turned about by half a turn, from -0.5 to 1.5 too.
    assert pair.overlap == pytest.approx(1.0)


def test_position_errors_are_told_in_the_target_frame():
    T = se3(0.3, -0.4, 0.25, 0.0, 0.0, 0.0) @ true("d", "a")
    (pair,) = judge([candidate("d", "a", T)], RECORDS, POSES)
    assert pair.position_error == pytest.approx(0.5)
    assert pair.height_error == pytest.approx(0.25)
    assert pair.yaw_error == pytest.approx(0.0, abs=1e-12)
    assert pair.pose_is_right


@pytest.mark.parametrize("turn", [-0.06, 0.06, 3.0])
def test_yaw_errors_turn_about_the_middle_of_the_source(turn):
    middle = np.array([0.5, 0.0])
    about = se3(*middle, 0, 0, 0, 0) @ se3(0, 0, 0, 0, 0, turn) @ se3(*-middle, 0, 0, 0, 0)
    (pair,) = judge([candidate("d", "a", true("d", "a") @ about)], RECORDS, POSES)
    assert pair.yaw_error == pytest.approx(abs(turn))
    assert pair.position_error == pytest.approx(0.0, abs=1e-12)
    assert pair.pose_is_right == (abs(turn) < np.radians(5))


def test_yaw_errors_do_not_wrap():
    """Half a turn, estimated a little short and a little long of it."""
    for turn in (-0.02, 0.02):
        T = true("d", "a") @ se3(0, 0, 0, 0, 0, turn)
        (pair,) = judge([candidate("d", "a", T)], RECORDS, POSES)
        assert pair.yaw_error == pytest.approx(0.02)


@pytest.mark.parametrize("shift", [0.9, 1.1, 50.0])
def test_a_pose_a_metre_off_is_another_place(shift):
    T = se3(shift, 0, 0, 0, 0, 0) @ true("d", "a")
    (pair,) = judge([candidate("d", "a", T)], RECORDS, POSES)
    assert pair.pose_is_right == (shift < 1.0)


def test_without_a_transform_there_is_no_error():
    (pair,) = judge([candidate("d", "a", np.full((4, 4), np.nan), accepted=False)], RECORDS, POSES)
    assert np.isnan([pair.position_error, pair.height_error, pair.yaw_error]).all()
    assert not pair.pose_is_right
    assert pair.overlap == pytest.approx(1.0)


def test_consecutive_submaps_are_left_out():
    candidates = [
        candidate(a, b, np.eye(4)) for i, a in enumerate(NAMES) for b in NAMES[:i] if "c" not in a + b
    ]
    kept = [(p.candidate.source, p.candidate.target) for p in judge(candidates, RECORDS, POSES)]
    assert kept == [("d", "a"), ("d", "b"), ("e", "a"), ("e", "b")]  # b and d have c between them


def test_pairs_of_one_session_are_left_out():
    candidates = [candidate(a, b, np.eye(4)) for a, b in ("da", "db", "ea", "eb")]
    sessions = {"a": "1", "b": "2", "c": "2", "d": "1", "e": "3"}
    kept = [p.candidate.source + p.candidate.target for p in judge(candidates, RECORDS, POSES, sessions)]
    assert kept == ["db", "ea", "eb"]


def test_overlap_is_that_of_the_posed_boxes():
    poses = POSES.copy()
    poses[4] = se3(1.0, 0.5, 0.0, 0.0, 0.0, 0.0)  # shares (2 - 1) x (2 - 0.5) m with a
    (pair,) = judge([candidate("e", "a", np.eye(4))], RECORDS, poses)
    assert pair.overlap == pytest.approx(1.5 / (8 - 1.5))
    (apart,) = judge([candidate("e", "a", np.eye(4))], RECORDS, POSES)
    assert apart.overlap == 0.0


@pytest.mark.parametrize("count", [0, 4])
def test_another_number_of_poses_is_an_error(count):
    with pytest.raises(TerrainLoopError, match=rf"5 submaps; found {count} poses"):
        judge([], RECORDS, POSES[:count])


def test_an_unknown_name_is_an_error():
    with pytest.raises(TerrainLoopError, match=r"submaps.csv; found no 'z'"):
        judge([candidate("z", "a", np.eye(4))], RECORDS, POSES)


def test_a_name_without_session_is_an_error():
    with pytest.raises(TerrainLoopError, match=r"sessions file; found no 'd'"):
        judge([candidate("d", "a", np.eye(4))], RECORDS, POSES, {"a": "1"})
