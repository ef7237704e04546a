"""Every figure makes a picture, also of what went wrong, without a warning and the same each time."""

import sys
from dataclasses import replace
from importlib import import_module

import cv2
import numpy as np
import pytest
from conftest import STRICT
from evaluation_util import right, write_run, wrong

from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.summary import evaluate_run
from terrainloop.features import extract_features
from terrainloop.geometry import se2, se3
from terrainloop.loop import LoopCandidate
from terrainloop.record import SubmapRecord
from terrainloop.report.figures import (
    figure_map,
    figure_match,
    figure_mission,
    figure_precision_recall,
    save_figure,
)
from terrainloop.submap import Submap

HULL = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
T_PLANAR = se2(0.4, -0.3, 0.5)
LOOP = LoopCandidate(
    "000003", "000000", se3(0.4, -0.3, 0.1, 0.0, 0.01, 0.5), np.eye(6),
    7, 2.5, 0.1, 0.6, 7.0, True, "7 inliers, SSD ratio 0.10",
)  # fmt: skip
NO_LOOP = replace(
    LOOP,
    T_target_source=np.full((4, 4), np.nan),
    covariance=np.full((6, 6), np.nan),
    accepted=False,
    inliers=0,
    reason="no two of 0 associations agree on a transform",
)


@pytest.fixture(scope="module")
def target(world):
    return world(0).map()


@pytest.fixture(scope="module")
def source(world):
    return world(0).map(T_PLANAR)


@pytest.fixture(scope="module")
def submap(world):
    return Submap(world(0).observe(np.eye(4), (0.0, 0.0), seed=0), "000003")


def unknown(gradient_map):
    return replace(gradient_map, mask=np.zeros_like(gradient_map.mask))


def flat(gradient_map):
    zero = np.zeros_like(gradient_map.elevation)
    return replace(gradient_map, elevation=zero, gradient_x=zero, gradient_y=zero)


def entry(gradient_map):
    return MapEntry.of(SubmapRecord("submap"), gradient_map, STRICT)


def pictures(make, tmp_path):
    """The picture of a figure made twice, which must be the same file."""
    for name in ("a.png", "b.png"):
        save_figure(make(), tmp_path / name)
    data = (tmp_path / "a.png").read_bytes()
    assert data == (tmp_path / "b.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    image = cv2.imread(str(tmp_path / "a.png"))
    rows, columns = image.shape[:2]
    assert 300 < rows < 2000
    assert 300 < columns < 2000
    return image


def drawn_share(image):
    return (image < 250).any(axis=-1).mean()


def test_map(submap, source, tmp_path):
    image = pictures(lambda: figure_map(submap, source), tmp_path)
    assert drawn_share(image) > 0.25
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 300  # colour maps, not just text


def test_a_map_draws_itself(source, tmp_path):
    image = pictures(source.plot, tmp_path)
    assert drawn_share(image) > 0.25


def test_map_of_unknown_ground(submap, source, tmp_path):
    known = pictures(lambda: figure_map(submap, source), tmp_path)
    veiled = pictures(lambda: figure_map(submap, unknown(source)), tmp_path)
    assert 0.05 < drawn_share(veiled) < 1.0
    assert veiled.astype(float).mean() > known.astype(float).mean()  # white covers the gradients


def test_map_of_flat_ground(submap, source, tmp_path):
    assert drawn_share(pictures(lambda: figure_map(submap, flat(source)), tmp_path)) > 0.05


def test_map_of_one_pixel(submap, source, tmp_path):
    pixel = np.s_[:1, :1]
    names = ("elevation", "gradient_x", "gradient_y", "variance", "gradient_variance", "mask")
    one = replace(source, **{name: getattr(source, name)[pixel] for name in names})
    assert drawn_share(pictures(lambda: figure_map(submap, one), tmp_path)) > 0.02


def test_map_far_from_the_origin(submap, source, tmp_path):
    far = replace(source, origin=(source.origin[0] + 5e5, source.origin[1] + 4e6))
    cloud = Submap(submap.points + np.array([5e5, 4e6, 0.0]), "utm")
    assert drawn_share(pictures(lambda: figure_map(cloud, far), tmp_path)) > 0.25


def match(source, target, candidate):
    return figure_match(entry(source), entry(target), candidate, STRICT)


def test_match(source, target, tmp_path):
    loop = pictures(lambda: match(source, target, LOOP), tmp_path)
    assert drawn_share(loop) > 0.25
    without = entry(source)
    without = replace(without, features=extract_features(flat(source), STRICT.features))
    none = pictures(lambda: figure_match(without, entry(target), LOOP, STRICT), tmp_path)
    assert (loop != none).any(axis=-1).mean() > 0.001  # the associations show


def test_match_that_was_rejected(source, target, tmp_path):
    """Without a transform there is nothing to lay over each other."""
    rejected = pictures(lambda: match(source, target, NO_LOOP), tmp_path)
    accepted = pictures(lambda: match(source, target, LOOP), tmp_path)
    assert drawn_share(rejected) > 0.02
    assert drawn_share(accepted) > drawn_share(rejected)


@pytest.mark.parametrize("ground", [unknown, flat])
def test_match_of_nothing_to_see(source, target, tmp_path, ground):
    for candidate in (NO_LOOP, LOOP):
        image = pictures(lambda c=candidate: match(ground(source), ground(target), c), tmp_path)
        assert drawn_share(image) > 0.005


def test_match_laid_far_apart(source, target, tmp_path):
    apart = replace(LOOP, T_target_source=se3(80.0, 0, 0, 0, 0, 0))
    assert drawn_share(pictures(lambda: match(source, target, apart), tmp_path)) > 0.01


POSES = np.array([se3(6.0 * i, 1.0 * (i % 2), 0, 0, 0, 0.3 * i) for i in range(4)])
NAMES = ("000000", "000001", "000002", "000003")


def test_mission(tmp_path):
    with_loop, without = (
        pictures(
            lambda loops=loops: figure_mission(NAMES, POSES, [HULL] * 4, loops, title="two legs"), tmp_path
        )
        for loops in ([LOOP, LOOP], [])
    )
    assert drawn_share(with_loop) > 0.02
    assert (with_loop != without).any(axis=-1).mean() > 1e-3


def test_mission_with_a_broken_cloud(tmp_path):
    hulls = [HULL, np.empty((0, 2)), HULL, HULL]
    assert (
        drawn_share(pictures(lambda: figure_mission(NAMES, POSES, hulls, [], title="one broken"), tmp_path))
        > 0.01
    )


def test_mission_of_one_submap(tmp_path):
    image = pictures(lambda: figure_mission(NAMES[:1], POSES[:1], [HULL], [], title="one"), tmp_path)
    assert drawn_share(image) > 0.01


@pytest.mark.parametrize(
    "pairs",
    [
        [right("d", "a"), wrong("e", "a")],
        [right("d", "a")],
        [wrong("e", "b")],  # nothing true, nothing found
        [right("d", "a", accepted=False)],
        [],
    ],
)
def test_precision_recall(pairs, tmp_path):
    evaluation = evaluate_run(tmp_path, write_run(tmp_path, pairs))
    assert drawn_share(pictures(lambda: figure_precision_recall(evaluation), tmp_path)) > 0.005


def test_curves_of_precision_and_recall_are_drawn_in_steps(tmp_path):
    """The area beneath a curve is its average precision; the mark is at the accepted loops."""
    pairs = [
        right("d", "a", score=9.0, accepted=False),
        wrong("e", "a", score=12.0),
        wrong("e", "b", score=2.0),
    ]
    evaluation = evaluate_run(tmp_path, write_run(tmp_path, pairs))
    curves, by_threshold = figure_precision_recall(evaluation).axes
    by_pose, *_, accepted = curves.get_lines()
    assert by_pose.get_drawstyle() == "steps-pre"
    recall, precision = by_pose.get_xdata(), by_pose.get_ydata()
    assert np.diff(recall) @ precision[1:] == pytest.approx(1 / 2)
    assert (accepted.get_xdata(), accepted.get_ydata()) == ([0.0], [0.0])
    drawn = by_threshold.get_lines()[0].get_ydata()
    np.testing.assert_array_equal(drawn, [row["pose_precision"] for row in evaluation.table])


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for name in [
        *filter(lambda name: name.startswith("matplotlib."), sys.modules),
        "terrainloop.report.figures",
    ]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(TerrainLoopError, match=r"expected matplotlib.*terrainloop\[figures\]"):
        import_module("terrainloop.report.figures")
