"""Overlap, precision and recall, against closed forms, counts and scikit-learn."""

from dataclasses import astuple

import numpy as np
import pytest
from sklearn.metrics import (
    average_precision_score,
    f1_score,
    precision_recall_curve,
    precision_recall_fscore_support,
)

from terrainloop.evaluation.overlap import box_iou, ground_cell, observed_iou, world_boxes
from terrainloop.evaluation.precision_recall import (
    OperatingPoint,
    measure,
    precision_recall,
    recall_at_full_precision,
)
from terrainloop.geometry import se3

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


def test_boxes_without_area_share_nothing():
    np.testing.assert_array_equal(box_iou(np.array([[0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 1, 1.0]]))[:2], 0.0)


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


def ground(*sides, low=(0.0, 0.0), spacing=0.1):
    """Points in the middle of every square of a rectangle, at a height that must not matter."""
    x, y = (start + np.arange(spacing / 2, side, spacing) for start, side in zip(low, sides, strict=True))
    return np.array([(a, b, 3.0 * a) for a in x for b in y])


@pytest.mark.parametrize("cell", [0.2, 0.5, 1.0])
def test_observed_iou_in_closed_form(cell):
    hook = np.vstack([ground(4, 1), ground(1, 2, low=(0, 1))])  # 6 of the 12 m2 of its box
    clouds = [ground(4, 3), hook, ground(2, 3, low=(2, 0)), ground(2, 3), np.empty((0, 3))]
    poses = np.array([np.eye(4)] * 3 + [se3(-6, 0, 0, 0, 0, 0), np.eye(4)])
    expected = np.zeros((5, 5))
    expected[np.diag_indices(4)] = 1.0
    expected[0, 1] = expected[1, 0] = 6 / 12
    expected[0, 2] = expected[2, 0] = 6 / 12
    expected[1, 2] = expected[2, 1] = 2 / 10
    np.testing.assert_allclose(observed_iou(clouds, poses, cell), expected, rtol=0, atol=1e-12)


def test_observed_iou_of_posed_clouds_by_sets():
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(-4, 4, (300, 3)) for _ in range(6)]
    poses = np.array([se3(*rng.uniform(-3, 3, 3), *rng.uniform(-0.1, 0.1, 2), 2.0 * i) for i in range(6)])
    cells = [
        {tuple(np.floor((pose @ [*p, 1.0])[:2] / 0.7)) for p in cloud}
        for cloud, pose in zip(clouds, poses, strict=True)
    ]
    expected = [[len(a & b) / len(a | b) for b in cells] for a in cells]
    np.testing.assert_allclose(observed_iou(clouds, poses, 0.7), expected, rtol=0, atol=1e-12)


def test_no_clouds():
    assert observed_iou([], np.empty((0, 4, 4)), 1.0).shape == (0, 0)


@pytest.mark.parametrize(
    ("density", "expected"), [(200, 0.25), (60, 0.5), (15, 1.0), (6.6, 2.0), (0.01, 8.0)]
)
def test_cell_of_scattered_points(density, expected):
    """A half leaves a cell empty with chance exp(-density cell^2 / 2); IoU is p / (2 - p), p the rest."""
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(0, 32, (int(density * 32**2), 3)) for _ in range(2)]
    assert ground_cell([*clouds, np.empty((0, 3))]) == expected
    seen = -np.expm1(-density * np.array([0.25, 0.5, 1, 2, 4, 8.0]) ** 2 / 2)
    enough = seen / (2 - seen) >= 0.95
    assert ground_cell(clouds) == (2.0 ** (enough.argmax() - 2) if enough.any() else 8.0)


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


def scored(seed, count=120, levels=25):
    """Scores with ties that tell something, and truth; pairs of 16 submaps."""
    rng = np.random.default_rng(seed)
    is_true = rng.random(count) < 0.3
    submaps = np.array([rng.choice(16, 2, replace=False) for _ in range(count)])
    return rng.integers(0, levels, count) + 6.0 * is_true, is_true, submaps


@pytest.mark.parametrize("levels", [3, 25, 10**6])
def test_curve_over_every_score_equals_scikit_learn(levels):
    scores, is_true, _ = scored(1, levels=levels)
    points = precision_recall(scores, is_true)
    precision, recall, thresholds = precision_recall_curve(is_true, scores)
    assert [p.threshold for p in points] == thresholds[::-1].tolist()
    assert [p.precision for p in points] == pytest.approx(precision[-2::-1])
    assert [p.recall for p in points] == pytest.approx(recall[-2::-1])


@pytest.mark.parametrize("levels", [3, 25, 10**6])
def test_metrics_equal_scikit_learn(levels):
    scores, is_true, submaps = scored(2, levels=levels)
    metrics = measure(scores, is_true, submaps)
    assert (metrics.pairs, metrics.true_pairs) == (120, is_true.sum())
    assert metrics.average_precision.value == pytest.approx(average_precision_score(is_true, scores))
    assert metrics.max_f1.value == pytest.approx(max(f1_score(is_true, scores >= s) for s in scores))
    full = recall_at_full_precision(scores[is_true], scores[~is_true])
    assert metrics.recall_at_full_precision.value == pytest.approx(full)


def test_metrics_by_hand():
    """Thresholds 9, 7, 5, 3, 1: precision 1, 2/3, 3/4, 3/5, 4/6 at recall 1/4, 2/4, 3/4, 3/4, 1."""
    metrics = measure(SCORES, TRUE, [(0, 9)] * 6)
    assert metrics.recall_at_full_precision.value == pytest.approx(1 / 4)
    assert metrics.max_f1.value == pytest.approx(2 * 4 / (6 + 4))
    assert metrics.average_precision.value == pytest.approx((1 + 2 / 3 + 3 / 4 + 4 / 6) / 4)


def test_one_false_match_among_many_ends_full_precision():
    is_true = np.arange(40) != 30
    metrics = measure(-np.arange(40), is_true, np.c_[np.arange(40), np.arange(40) + 50])
    assert metrics.recall_at_full_precision.value == pytest.approx(30 / 39)


def test_a_true_pair_matched_wrongly_is_false_and_missed():
    is_right = [True, True, True, False, False, True]  # the third is no true pair, so its match is not right
    points = precision_recall(SCORES, TRUE, is_right=is_right)
    counted = [(p.true_positives, p.false_positives, p.false_negatives) for p in points]
    assert counted == [(1, 0, 3), (2, 1, 2), (2, 2, 2), (2, 3, 2), (3, 3, 1)]
    metrics = measure(SCORES, TRUE, [(0, 9)] * 6, is_right)
    assert metrics.average_precision.value == pytest.approx((1 + 2 / 3 + 3 / 6) / 4)
    assert metrics.max_f1.value == pytest.approx(2 * 3 / (6 + 4))


@pytest.mark.parametrize("nothing", [-np.inf, np.nan])
def test_pairs_that_nothing_matches_stay_missed(nothing):
    scores, is_true = [8.0, nothing, 5.0, nothing], [True, True, True, False]
    metrics = measure(scores, is_true, [(0, 9)] * 4)
    assert metrics.recall_at_full_precision.value == pytest.approx(2 / 3)
    assert metrics.average_precision.value == pytest.approx(2 / 3)
    assert metrics.max_f1.value == pytest.approx(2 * 2 / (2 + 3))
    assert [p.threshold for p in precision_recall(scores, is_true)] == [8.0, 5.0]


def test_intervals_are_those_of_submaps_drawn_again():
    """Every pair written out as often as its submaps were drawn, measured by scikit-learn."""
    scores, is_true, submaps = scored(3)
    rng, averages = np.random.default_rng(0), []
    for _ in range(1000):
        times = np.bincount(rng.integers(16, size=16), minlength=16)
        again = np.repeat(np.arange(len(scores)), times[submaps[:, 0]] * times[submaps[:, 1]])
        if is_true[again].any():
            averages.append(average_precision_score(is_true[again], scores[again]))
    estimate = measure(scores, is_true, submaps).average_precision
    assert (estimate.low, estimate.high) == pytest.approx(tuple(np.percentile(averages, [2.5, 97.5])))
    assert estimate.low < estimate.value < estimate.high


def test_intervals_are_the_same_again():
    scores, is_true, submaps = scored(4)
    names = np.array([f"{n:06d}" for n in range(16)])[submaps]
    order = np.random.default_rng(0).permutation(len(scores))
    assert measure(scores, is_true, submaps) == measure(scores[order], is_true[order], names[order])


def test_pairs_of_few_submaps_tell_less_than_as_many_of_many():
    """600 true pairs, of which a third is missed: those of every third source."""
    widths = []
    for count in (6, 60):
        source = np.arange(600) % count
        scores = np.where(source % 3 == 0, -np.inf, 9.0)
        f1 = measure(scores, np.ones(600), np.c_[source, source + 100]).max_f1
        assert f1.value == pytest.approx(2 * 400 / (400 + 600))
        widths.append(f1.high - f1.low)
    assert widths[0] > 2 * widths[1]


@pytest.mark.parametrize("count", [0, 5])
def test_metrics_without_true_pairs_are_no_numbers(count):
    metrics = measure(np.arange(count), np.zeros(count), np.zeros((count, 2)))
    assert (metrics.pairs, metrics.true_pairs) == (count, 0)
    assert np.isnan([astuple(e) for e in (metrics.recall_at_full_precision, metrics.average_precision)]).all()
    assert str(metrics.max_f1) == "-"


def test_a_method_that_compares_nothing_finds_nothing():
    metrics = measure([-np.inf] * 3, [True, True, False], [(0, 2), (0, 3), (1, 3)])
    assert astuple(metrics.average_precision) == astuple(metrics.max_f1) == (0, 0, 0)
    assert precision_recall([-np.inf] * 3, [True, True, False]) == []
