"""Patterns fixed to the sensor are found, measured and subtracted; ground is left alone."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import World, map_of

from terrainloop.config import Settings
from terrainloop.detection import sensor_pattern
from terrainloop.detection.detector import LoopDetector
from terrainloop.detection.flat_field import MIN_SUBMAPS
from terrainloop.detection.mission import detect_mission
from terrainloop.detection.run import Run
from terrainloop.detection.sensor_pattern import SensorPatterns
from terrainloop.entry import MapEntry
from terrainloop.geometry import se2, se3, transform, yaw_of
from terrainloop.io.clouds import write_cloud
from terrainloop.record import SubmapRecord, hull_overlap

SETTINGS = Settings()
COUNT = 12


WAVES = np.random.default_rng(0).normal(0, 4.0, (2, 12, 2))  # of two sensors, radians per metre


def pattern(xy, amplitude, sensor=0):
    """A disparity bias, say: waves in the frame of the sensor; heights (N,) and slopes (N, 2)."""
    k = WAVES[sensor]
    phase, amplitude = xy @ k.T + np.arange(len(k)), amplitude / 2
    return amplitude * np.sin(phase).sum(1), amplitude * np.cos(phase) @ k


def entry_of(
    seed,
    amplitude=0.0,
    where=(0.0, 0.0),
    turn=0.0,
    noise=0.0,
    *,
    index=None,
    session="",
    relief=1.0,
    sensor=0,
    frame=None,
    with_hull=False,
):
    """A submap of the world of a seed, at a place of it, with the pattern of the sensor.

    Its frame is that of the sensor, or one in which the sensor is at a pose (x, y, 0 or pi).
    """
    index = seed if index is None else index
    to_world, rng = se2(*where, turn), np.random.default_rng(index)

    def ground(xy):
        height, slope = World.of(seed)._height_and_slope(transform(to_world, xy))
        of_sensor = pattern(xy, amplitude, sensor)
        slope = relief * slope @ to_world[:2, :2] + of_sensor[1] + rng.normal(0, noise, slope.shape)
        return relief * height + of_sensor[0], slope

    x, y, yaw = (0.0, 0.0, 0.0) if frame is None else frame
    about_middle = se2(0.0, -0.1, 0.0) @ se2(0.0, 0.0, yaw) @ se2(0.0, 0.1, 0.0)
    gradient_map = map_of(ground, about_middle)
    gradient_map = replace(gradient_map, origin=(x - 2.0, y - 2.5))
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.8], [0.0, 4.8]]) + gradient_map.origin
    record = SubmapRecord(f"{index}", float(index), 1000, "ok", session=session)
    record = replace(record, hull=corners) if with_hull else record
    return MapEntry.of(record, gradient_map, SETTINGS)


def cleaned(entries):
    """The entries as matched when all are known in advance, and the warnings."""
    patterns = SensorPatterns(SETTINGS, entries)
    return [patterns.cleaned(entry) for entry in entries], patterns.warnings


def one_by_one(entries):
    patterns = SensorPatterns(SETTINGS)
    for entry in entries:
        patterns.add(entry)
    return [patterns.cleaned(entry) for entry in entries], patterns.warnings


def all_same(entries, others):
    return all(a is b for a, b in zip(entries, others, strict=True))


def error(entries, clean):
    return np.mean([((gradients(a) - gradients(b)) ** 2).mean() for a, b in zip(entries, clean, strict=True)])


def gradients(entry):
    return np.stack([entry.gradient_map.gradient_x, entry.gradient_map.gradient_y])


def share_of(amplitude):
    """Of the energy of the slopes that the pattern is."""
    with_it, without = (
        np.mean([(g - g.mean(axis=(1, 2), keepdims=True)).var() for g in map(gradients, entries)])
        for entries in (
            [entry_of(seed, amplitude) for seed in range(COUNT)],
            [entry_of(seed) for seed in range(COUNT)],
        )
    )
    return 1.0 - without / with_it


@pytest.mark.parametrize("amplitude", [0.02, 0.03])
@pytest.mark.parametrize("remove", [cleaned, one_by_one])
def test_a_pattern_is_measured_and_subtracted(amplitude, remove):
    dirty = [entry_of(seed, amplitude) for seed in range(COUNT)]
    clean = [entry_of(seed) for seed in range(COUNT)]
    without, (words,) = remove(dirty)
    assert float(re.search(r"(\d+)%", words).group(1)) == pytest.approx(100 * share_of(amplitude), rel=0.35)
    assert "calibrate the sensor" in words
    assert error(without, clean) < 0.6 * error(dirty, clean)
    assert [entry.record for entry in without] == [entry.record for entry in dirty]


@pytest.mark.parametrize("first", [0, 100, 200, 300])
@pytest.mark.parametrize("remove", [cleaned, one_by_one])
def test_ground_alone_is_left_as_it_is(first, remove):
    entries = [entry_of(seed) for seed in range(first, first + COUNT)]
    without, warnings = remove(entries)
    assert warnings == ()
    assert all_same(without, entries)


def test_a_faint_pattern_is_left_as_it_is():
    """It does no harm, and a mean of a few submaps is not free of their ground."""
    assert share_of(0.008) < 0.03
    entries = [entry_of(seed, 0.008) for seed in range(COUNT)]
    assert all_same(cleaned(entries)[0], entries)


def test_too_few_submaps_say_nothing():
    entries = [entry_of(seed, 0.02) for seed in range(MIN_SUBMAPS)]
    assert all_same(cleaned(entries)[0], entries)
    assert cleaned([]) == ([], ())


def test_submaps_without_a_common_frame_say_nothing():
    entries = [entry_of(seed, 0.02) for seed in range(COUNT)]
    finer = replace(entries[0], gradient_map=replace(entries[0].gradient_map, resolution=0.05))
    far = replace(entries[0], gradient_map=replace(entries[0].gradient_map, origin=(5e5, 4e6)))
    for odd in (finer, far):
        assert cleaned([odd, *entries[1:]])[1] == ()


def test_a_submap_that_does_not_fit_is_left_as_it_is():
    """Online the pattern is known when it comes."""
    entries = [entry_of(seed, 0.03) for seed in range(5)]
    finer, far, beside = (
        replace(
            entry_of(seed, 0.02),
            gradient_map=replace(entries[0].gradient_map, **other),
        )
        for seed, other in enumerate(
            ({"resolution": 0.05}, {"origin": (5e5, 4e6)}, {"origin": (90.0, 0.0)}), 9
        )
    )
    without, (_,) = one_by_one([*entries, finer, far, beside])
    assert without[5] is finer
    assert without[6] is far
    assert (gradients(without[7]) == gradients(beside)).all()


def test_a_pattern_shows_on_the_smooth_submaps_of_a_mission():
    """Rough ground would drown it in a plain mean."""
    smooth, rough = range(4), range(10, 18)
    entries = [entry_of(seed, 0.006, relief=0.1 if seed in smooth else 1.0) for seed in (*smooth, *rough)]
    clean = [entry_of(seed, relief=0.1) for seed in smooth]
    without, (_,) = cleaned(entries)
    assert error(without[:4], clean) < 0.5 * error(entries[:4], clean)


def test_each_session_has_a_pattern_of_its_own():
    entries = [entry_of(seed, 0.03, session="ab"[seed % 2], sensor=seed % 2) for seed in range(2 * COUNT)]
    clean = [entry_of(seed) for seed in range(2 * COUNT)]
    without, (first, second) = cleaned(entries)
    assert first.startswith("a: a pattern fixed to the sensor")
    assert second.startswith("b: a pattern fixed to the sensor")
    assert error(without, clean) < 0.5 * error(entries, clean)


def test_a_pattern_that_changes_is_measured_anew(monkeypatch):
    monkeypatch.setattr(sensor_pattern, "PERIOD", 8)
    entries = [entry_of(seed, 0.03 if seed < 16 else -0.03) for seed in range(32)]
    patterns = SensorPatterns(SETTINGS)
    before = []
    for entry in entries:
        patterns.add(entry)
        before.append(patterns.cleaned(entry))
    last = [patterns.cleaned(entry) for entry in entries]
    assert all_same(last[8:], before[8:])  # old submaps are not cleaned again
    clean = [entry_of(seed) for seed in range(24, 32)]
    assert error(last[24:], clean) < 0.5 * error(entries[24:], clean)


def at_poses(entries, positions):
    poses = [se3(x, y, 0.0, 0.0, 0.0, 0.0) for x, y in positions]
    return [
        replace(entry, record=replace(entry.record, odometry=pose))
        for entry, pose in zip(entries, poses, strict=True)
    ]


def test_a_rover_that_stands_still_sees_its_ground_in_common():
    same = [entry_of(0, noise=0.05, index=k) for k in range(COUNT)]
    still = at_poses(same, np.random.default_rng(0).normal(0, 0.1, (COUNT, 2)))
    came_from_afar = at_poses([entry_of(1, index=COUNT)], [(20.0, 0.0)])
    assert cleaned([*came_from_afar, *still])[1] == ()
    driving = at_poses(same, np.c_[10.0 * np.arange(COUNT), np.zeros(COUNT)])
    assert "loops of a vehicle that stood still need its odometry" in cleaned(driving)[1][0]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_copies_of_a_few_clouds_are_ground_not_a_pattern(noise):
    entries = [entry_of(k % 3, noise=noise, index=k) for k in range(12)]
    without, warnings = cleaned(entries)
    assert warnings == ()
    assert all_same(without, entries)


def test_frames_in_the_world_have_no_pattern():
    """Clouds that are not in the frame of the sensor, each pixel of the world seen by a few."""
    entries = [entry_of(0, where=(0.6 * k, 0.0), index=k) for k in range(COUNT)]
    in_world = [
        replace(entry, gradient_map=replace(entry.gradient_map, origin=(-2.0 + 0.6 * k, -2.5)))
        for k, entry in enumerate(entries)
    ]
    assert cleaned(in_world)[1] == ()


def online(entries):
    """Every pair, compared as submaps come in, and the warnings."""
    pairs = []
    detector = LoopDetector(Settings(skip_recent=0), null_scores=[], on_pair=pairs.append)
    for entry in entries:
        detector.add_entry(entry)
    return pairs, detector.warnings


@pytest.fixture(scope="module")
def biased():
    """Places seen through one strong pattern; the last ones show the first ones again."""
    seeds = [*range(8), 0, 1]
    places = [(0.0, 0.0, 0.0)] * 8 + [(0.5, 0.4, 2.0), (-0.6, 0.3, -1.0)]
    return [
        entry_of(seed, 0.03, where[:2], where[2], noise=0.02, index=k)
        for k, (seed, where) in enumerate(zip(seeds, places, strict=True))
    ]


def test_online_too_no_pattern_makes_a_loop(biased):
    pairs, (warning,) = online(biased)
    loops = {(pair.source, pair.target): pair for pair in pairs if pair}
    assert set(loops) == {("8", "0"), ("9", "1")}
    for (_, target), loop in loops.items():
        x, y, yaw = {"0": (0.5, 0.4, 2.0), "1": (-0.6, 0.3, -1.0)}[target]
        assert loop.T_target_source[:2, 3] == pytest.approx([x, y], abs=0.1)
        assert yaw_of(loop.T_target_source) == pytest.approx(yaw, abs=0.05)
    assert "was subtracted" in warning


def test_reasons_name_the_pattern_that_was_subtracted(biased):
    pairs, _ = online(biased)
    told = [pair.reason.endswith("was subtracted") for pair in pairs]
    first = sum(range(4))  # pairs of the four submaps before the pattern is known
    assert not any(told[:first])
    assert all(told[first:])
    assert re.search(
        r"; a pattern fixed to the sensor \(\d+% of the slopes of 5 submaps\) was", pairs[first].reason
    )


def test_loops_that_a_pattern_may_explain_wait_for_other_submaps():
    def explained(entries):
        pairs, warnings = online(entries)
        told = "a pattern fixed to the sensor may explain it" in pairs[-1].reason
        assert told == any("1 would-be loops were refused" in words for words in warnings)
        return told, bool(pairs[-1])

    same = [entry_of(0, noise=0.05, index=k) for k in range(2)]
    assert explained(same) == (True, False)
    from_afar = [entry_of(1, index=2), *same]
    assert explained(at_poses(from_afar, [(20.0, 0.0), (0.0, 0.0), (0.1, 0.0)])) == (False, True)
    assert explained(at_poses(from_afar, [(20.0, 0.0), (0.0, 0.0), (9.0, 0.0)])) == (True, False)
    copies = [same[0], replace(same[0], record=same[1].record)]
    assert explained(copies) == (False, True)
    elsewhere = [same[0], entry_of(0, where=(1.5, 1.0), noise=0.05, index=1)]
    assert explained(elsewhere) == (False, True)


def test_where_a_pattern_was_found_the_identity_needs_odometry(biased):
    again = entry_of(3, 0.03, noise=0.02, index=10)
    pairs, _ = online([*biased, again])
    assert ("10", "3") not in {(pair.source, pair.target) for pair in pairs if pair}
    (pair,) = (pair for pair in pairs if (pair.source, pair.target) == ("10", "3"))
    assert pair.reason.startswith("a pattern fixed to the sensor explains it")
    assert np.isnan(pair.covariance).all()
    positions = np.c_[10.0 * np.arange(11), np.zeros(11)]
    positions[-1] = positions[3]
    pairs, _ = online(at_poses([*biased, again], positions))
    assert ("10", "3") in {(pair.source, pair.target) for pair in pairs if pair}


def test_another_sensor_is_not_trusted_at_the_identity_after_a_pattern_was_found():
    first = [entry_of(seed, 0.03, noise=0.02, relief=0.1) for seed in range(8)]
    second = [entry_of(seed, 0.03, noise=0.02, relief=0.1, sensor=1) for seed in (8, 9)]
    pairs, _ = online([*first, *second])
    assert not any(pairs)
    assert "explains it, the two agree in the same part of its view" in pairs[-1].reason
    assert "was subtracted" not in pairs[-1].reason


def test_other_submaps_refute_a_pattern():
    places = [entry_of(seed, noise=0.02, index=seed) for seed in range(6)]
    pairs, _ = online([*places, entry_of(0, noise=0.02, index=6)])
    assert [(pair.source, pair.target) for pair in pairs if pair] == [("6", "0")]


def test_a_sensor_that_takes_turns_with_another_makes_no_loop():
    """Their mean is no pattern, but submaps of either agree among themselves at the identity."""
    entries = [entry_of(seed, 0.03, noise=0.02, relief=0.1, sensor=seed % 2) for seed in range(10)]
    pairs, (warning,) = online(entries)
    assert "would-be loops were refused" in warning
    assert not any(pairs)
    assert any("explains it, 3 other submaps agree there too" in pair.reason for pair in pairs)


FRAMES = {
    "mown, back and forth": lambda k: (0.0, 0.0, np.pi * (k % 2)),
    "of the ground": lambda k: (20.0 * k, 5.0 * k, np.pi * (k % 2)),
    "UTM": lambda k: (5e5 + 20.0 * k, 4.2e6, np.pi * (k % 2)),
}


@pytest.mark.parametrize("frame_of", FRAMES.values(), ids=FRAMES)
def test_a_pattern_is_found_in_the_view_where_frames_are_not_of_the_sensor(frame_of):
    entries = [
        entry_of(seed, 0.03, noise=0.02, relief=0.1, frame=frame_of(seed), with_hull=True)
        for seed in range(10)
    ]
    pairs, (warning,) = online(entries)
    assert not any(pairs)
    assert sum("explains it" in pair.reason for pair in pairs) > 20
    assert "would-be loops were refused: they lie where a pattern" in warning


def test_in_the_view_of_a_sensor_two_or_three_submaps_decide_nothing():
    entries = [
        entry_of(seed, 0.03, noise=0.02, relief=0.1, frame=(20.0 * seed, 0.0, 0.0), with_hull=True)
        for seed in range(3)
    ]
    pairs, _ = online(entries)
    assert not any(pairs)
    assert all("too few other submaps tell" in pair.reason for pair in pairs)


def test_a_revisit_in_the_same_view_is_found_among_other_places():
    frames = [*((20.0 * k, 0.0, 0.0) for k in range(6)), (200.0, 3.0, np.pi)]
    entries = [
        entry_of(seed, noise=0.02, index=k, frame=frame, with_hull=True)
        for k, (seed, frame) in enumerate(zip([*range(6), 0], frames, strict=True))
    ]
    pairs, warnings = online(entries)
    assert [(pair.source, pair.target) for pair in pairs if pair] == [("6", "0")]
    assert warnings == ()


ODOMETRY = {
    "zeros": lambda k: (0.0, 0.0),
    "degrees": lambda k: (14.99 + 1e-4 * k, 37.7),
    "a few centimetres": lambda k: (0.05 * np.cos(k), 0.05 * np.sin(k)),
}


@pytest.mark.parametrize("position_of", ODOMETRY.values(), ids=ODOMETRY)
@pytest.mark.parametrize("frame", [None, (20.0, 5.0, 0.0)])
def test_no_odometry_makes_a_loop_of_a_pattern(position_of, frame):
    entries = [
        entry_of(seed, 0.03, noise=0.02, relief=0.1, frame=frame, with_hull=True) for seed in range(10)
    ]
    pairs, warnings = online(at_poses(entries, [position_of(k) for k in range(10)]))
    assert not any(pairs)
    assert warnings


def test_overlap_of_two_views_is_that_of_their_hulls():
    box = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]])
    far = np.array([5e5, 4.2e6])
    assert hull_overlap(box, box) == pytest.approx(1.0)
    assert hull_overlap(box + far + [1.0, 0.0], box + far) == pytest.approx(3.0 / 5.0, abs=1e-3)
    assert hull_overlap(box[[2, 3, 0, 1]], box + 9.0) == 0.0
    assert hull_overlap(np.empty((0, 2)), box) == 0.0


@pytest.fixture(scope="module")
def biased_mission(tmp_path_factory):
    """Unrelated places, all seen with one strong pattern."""
    folder, rng = tmp_path_factory.mktemp("biased"), np.random.default_rng(5)
    for seed in range(10):
        xy = rng.uniform(-2.5, 2.5, (4000, 2))
        z = 0.3 * World.of(seed).height(xy) + pattern(xy, 0.02)[0] + rng.normal(0, 0.002, len(xy))
        write_cloud(folder / f"{seed:02d}.ply", np.c_[xy, z])
    return folder


def test_a_mission_says_that_its_sensor_has_a_pattern(biased_mission, tmp_path, cli):
    _, out, _ = cli(
        "detect", biased_mission, "-o", tmp_path / "run", "--all-pairs", "--json", "--workers", "1"
    )
    told = json.loads(out)
    (warning,) = told["warnings"]
    assert "pattern fixed to the sensor" in warning
    assert told["loops"] == []
    assert Run.read(tmp_path / "run").warnings == (warning,)
    assert detect_mission(biased_mission).warnings == (warning,)


def test_the_table_shows_it_too(biased_mission, tmp_path, cli):
    _, out, _ = cli("detect", biased_mission, "-o", tmp_path / "run", "--workers", "1")
    assert "pattern fixed to the sensor" in " ".join(out.split())
