"""A second look finds what the first one missed, where the trajectory says, and nothing elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import World

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import inverse, se2, se3, transform, yaw_of
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mission_null import MissionNull, by_mission_null, mirrored
from terrainloop.matching.register import compare, compare_within
from terrainloop.matching.window import Window
from terrainloop.pose_graph import PoseGraph
from terrainloop.record import SubmapRecord
from terrainloop.slam.second_look import second_look

SETTINGS = Settings()
CORNERS = np.array([[-2.0, -2.5], [2.0, -2.5], [2.0, 2.3], [-2.0, 2.3]])


def entry_at(name, x, y, yaw, *, world=0, odometry=None):
    record = SubmapRecord(name, float(name), 1000, "ok", CORNERS, odometry=odometry)
    gradient_map = World.of(world).map(se2(x, y, yaw))
    rng = np.random.default_rng(int(name))
    noisy = {
        axis: getattr(gradient_map, axis) + rng.normal(0, 0.05, gradient_map.mask.shape).astype(np.float32)
        for axis in ("gradient_x", "gradient_y")
    }
    return MapEntry.of(record, replace(gradient_map, **noisy), SETTINGS)


def allowing(number):
    match = SETTINGS.match.model_copy(update={"max_false_loops": number})
    return SETTINGS.model_copy(update={"match": match})


# --- a window


def test_poses_fill_the_window_and_no_more():
    field = entry_at("0", 0, 0, 0).field
    T = se2(1.0, -2.0, 0.7)
    window = Window(T, 0.5, 0.1)
    poses = window.poses(field)
    moved = np.array([transform(pose, field.centre) for pose in poses]) - transform(T, field.centre)
    turned = np.array([yaw_of(inverse(T) @ pose) for pose in poses])
    assert np.abs(moved).max() == pytest.approx(0.5)
    assert np.abs(turned).max() == pytest.approx(0.1)
    assert any(np.allclose(pose, T) for pose in poses)
    gaps = np.diff(np.unique(moved[:, 0].round(9)))
    assert gaps.max() <= 0.5 * field.length_scale + 1e-9


def test_in_a_window_a_pose_is_found_on_less_evidence():
    source, target = entry_at("1", 1.9, 2.4, 0.3), entry_at("0", 0, 0, 0)
    true = se2(1.9, 2.4, 0.3)
    window = Window(true @ se2(0.1, -0.1, 0.02), 0.4, 0.05)
    whole, within = compare(source, target, SETTINGS), compare_within(source, target, window, SETTINGS)
    assert within.found_by == "second look"
    assert within.score > whole.score + 1.0  # decades
    T = within.T_target_source
    assert T[:2, 3] == pytest.approx(true[:2, 2], abs=0.1)


def test_outside_of_its_window_nothing_is_found():
    source, target = entry_at("1", 1.0, 0.5, 0.3), entry_at("0", 0, 0, 0)
    assert compare(source, target, SETTINGS)
    elsewhere = Window(se2(-1.5, 1.5, 2.0), 0.5, 0.05)
    assert not compare_within(source, target, elsewhere, SETTINGS)


def test_mirror_images_show_what_chance_does_in_a_window():
    rng = np.random.default_rng(0)
    entries = [entry_at(f"{k}", 0, 0, 0, world=k) for k in range(14)]
    images = [mirrored(entry, SETTINGS) for entry in entries]
    unrelated, by_mirrors = [], []
    for i in range(14):
        for target in entries[:i]:
            window = Window(se2(*rng.uniform(-1.5, 1.5, 2), rng.uniform(-3, 3)), 0.5, 0.05)
            unrelated.append(compare_within(entries[i], target, window, SETTINGS))
            by_mirrors.append(-compare_within(images[i], target, window, SETTINGS).log_nfa)
    null = MissionNull.of(by_mirrors, SETTINGS.calibration)
    decided = [by_mission_null(pair, null, SETTINGS, len(unrelated)) for pair in unrelated]
    scores = np.array([pair.score for pair in decided])
    assert np.mean(scores > 1) < 0.2
    assert np.mean(scores > 2) < 0.05
    assert scores.max() < 3
    assert not any(decided)


# --- a mission


PLACES = [(0, 0, 0), (20, 0, 0), (40, 0, 0), (40.5, 0.5, 2.0), (20.4, -0.3, 1.0), (1.9, 2.4, 0.3)]


@pytest.fixture(scope="module")
def mission():
    """A drive along three places and back; the last submap shares little ground with the first."""
    poses = [se3(x, y, 0, 0, 0, yaw) for x, y, yaw in PLACES]
    entries = {}
    for k, (x, y, yaw) in enumerate(PLACES):
        place = 20.0 * round(x / 20)
        entries[f"{k}"] = entry_at(f"{k}", x - place, y, yaw, world=int(place), odometry=poses[k])
    loops = [known(poses, source, target) for source, target in ((3, 2), (4, 1))]
    steps = np.tile(np.diag([0.002, 0.002, 0.004, 0.03, 0.03, 0.03]) ** 2, (len(PLACES), 1, 1))
    return entries, PoseGraph.of([entry.record for entry in entries.values()], loops, steps).solve()


def known(poses, source, target):
    found = LoopCandidate.without_transform(f"{source}", f"{target}", "found")
    T = inverse(poses[target]) @ poses[source]
    covariance = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.01]) ** 2
    return replace(found, T_target_source=T, covariance=covariance, accepted=True)


def test_it_looks_where_the_trajectory_lays_submaps_upon_each_other(mission):
    entries, solution = mission
    (candidate,) = second_look(entries, solution, allowing(1.0), 0.5)
    assert (candidate.source, candidate.target) == ("5", "0")
    assert candidate
    assert candidate.T_target_source[:2, 3] == pytest.approx([1.9, 2.4], abs=0.15)


def test_other_ground_at_that_place_is_no_loop(mission):
    entries, solution = mission
    other = entries | {"5": entry_at("5", 1.9, 2.4, 0.3, world=77, odometry=entries["5"].record.odometry)}
    (candidate,) = second_look(other, solution, SETTINGS, 0.5)
    assert not candidate


def test_its_share_decides(mission):
    entries, solution = mission
    (candidate,) = second_look(entries, solution, SETTINGS, 1e-300)
    assert "chance explains it" in candidate.reason


def test_submaps_that_nothing_ties_are_not_looked_at(mission):
    entries, _ = mission
    records = [replace(entry.record, session=name) for name, entry in entries.items()]
    loops = [known([record.odometry for record in records], 4, 1)]
    apart = PoseGraph.of(records, loops).solve()
    assert second_look(entries, apart, SETTINGS, 0.5) == []
