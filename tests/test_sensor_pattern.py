"""Patterns fixed to the sensor are found, measured and subtracted; ground is left alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import World, map_of

from terrainloop.config import Settings
from terrainloop.detection.mission import detect_mission
from terrainloop.detection.run import Run
from terrainloop.detection.sensor_pattern import MIN_SUBMAPS, remove_sensor_pattern
from terrainloop.entry import MapEntry
from terrainloop.geometry import se2, se3, transform
from terrainloop.io.clouds import write_cloud
from terrainloop.record import SubmapRecord

SETTINGS = Settings()
COUNT = 12


def pattern(xy, amplitude):
    """A disparity bias, say: waves in the frame of the sensor; heights (N,) and slopes (N, 2)."""
    k = np.array([[3.1, 4.2], [5.3, -2.2], [-1.4, 5.1]])
    phase = xy @ k.T + (0.3, 1.1, 2.0)
    return amplitude * np.sin(phase).sum(1), amplitude * np.cos(phase) @ k


def entry_of(seed, amplitude=0.0, where=(0.0, 0.0), turn=0.0, noise=0.0):
    """A submap of the world of a seed, at a place of it, with the pattern of the sensor."""
    to_world, rng = se2(*where, turn), np.random.default_rng(seed)

    def ground(xy):
        height, slope = World.of(seed)._height_and_slope(transform(to_world, xy))
        of_sensor = pattern(xy, amplitude)
        slope = slope @ to_world[:2, :2] + of_sensor[1] + rng.normal(0, noise, slope.shape)
        return height + of_sensor[0], slope

    record = SubmapRecord(f"{seed}", None, 1000, "ok")
    return MapEntry.of(record, map_of(ground), SETTINGS)


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
def test_a_pattern_is_measured_and_subtracted(amplitude):
    dirty = [entry_of(seed, amplitude) for seed in range(COUNT)]
    clean = [entry_of(seed) for seed in range(COUNT)]
    cleaned, found = remove_sensor_pattern(dirty, SETTINGS)
    assert found.submaps == COUNT
    assert found.share == pytest.approx(share_of(amplitude), rel=0.35)
    before, after = (
        np.mean([((gradients(a) - gradients(b)) ** 2).mean() for a, b in zip(entries, clean, strict=True)])
        for entries in (dirty, cleaned)
    )
    assert after < 0.5 * before
    assert [entry.record for entry in cleaned] == [entry.record for entry in dirty]
    assert "calibrate the sensor" in str(found)
    assert f"{found.share:.0%}" in str(found)


@pytest.mark.parametrize("first", [0, 100, 200, 300])
def test_ground_alone_is_left_as_it_is(first):
    entries = [entry_of(seed) for seed in range(first, first + COUNT)]
    cleaned, found = remove_sensor_pattern(entries, SETTINGS)
    assert found is None
    assert all(a is b for a, b in zip(entries, cleaned, strict=True))


def test_a_faint_pattern_is_left_as_it_is():
    """It does no harm, and a mean of a few submaps is not free of their ground."""
    assert share_of(0.008) < 0.03
    assert remove_sensor_pattern([entry_of(seed, 0.008) for seed in range(COUNT)], SETTINGS)[1] is None


def test_too_few_submaps_say_nothing():
    entries = [entry_of(seed, 0.02) for seed in range(MIN_SUBMAPS)]
    assert remove_sensor_pattern(entries, SETTINGS) == (entries, None)
    assert remove_sensor_pattern([], SETTINGS) == ([], None)


def test_submaps_without_a_common_frame_say_nothing():
    entries = [entry_of(seed, 0.02) for seed in range(COUNT)]
    finer = replace(entries[0], gradient_map=replace(entries[0].gradient_map, resolution=0.05))
    far = replace(entries[0], gradient_map=replace(entries[0].gradient_map, origin=(5e5, 4e6)))
    for odd in (finer, far):
        assert remove_sensor_pattern([odd, *entries[1:]], SETTINGS)[1] is None


def at_poses(entries, positions):
    poses = [se3(x, y, 0.0, 0.0, 0.0, 0.0) for x, y in positions]
    return [
        replace(entry, record=replace(entry.record, odometry=pose))
        for entry, pose in zip(entries, poses, strict=True)
    ]


def test_a_rover_that_stands_still_sees_its_ground_in_common():
    same = [entry_of(0, noise=0.05) for _ in range(COUNT)]
    still = at_poses(same, np.random.default_rng(0).normal(0, 0.1, (COUNT, 2)))
    assert remove_sensor_pattern(still, SETTINGS)[1] is None
    driving = at_poses(same, np.c_[10.0 * np.arange(COUNT), np.zeros(COUNT)])
    assert remove_sensor_pattern(driving, SETTINGS)[1] is not None


def test_frames_in_the_world_have_no_pattern():
    """Clouds that are not in the frame of the sensor, each pixel of the world seen by a few."""
    entries = [entry_of(0, where=(0.6 * k, 0.0)) for k in range(COUNT)]
    in_world = [
        replace(entry, gradient_map=replace(entry.gradient_map, origin=(-2.0 + 0.6 * k, -2.5)))
        for k, entry in enumerate(entries)
    ]
    assert remove_sensor_pattern(in_world, SETTINGS)[1] is None


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
