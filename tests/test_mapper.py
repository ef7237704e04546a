"""Scans in, a corrected trajectory out: streamed, as a whole, by the command."""

import json
from itertools import pairwise

import gtsam
import numpy as np
import pytest
import tifffile

from terrainloop.config import Settings
from terrainloop.detection.run import CORRECTED, OF_A_RUN, Run
from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import exp_se3, inverse, se3, transform
from terrainloop.io.clouds import read_cloud
from terrainloop.io.trajectories import Trajectory, read_trajectory, write_tum
from terrainloop.scan import PosedScan, Scan
from terrainloop.slam.mapper import Mapper
from terrainloop.slam.run import PRODUCTS, run_slam
from terrainloop.slam.submapping import Submapper

REACH, RADIUS, STEP, LAPS = 4.0, 7.0, 0.5, 1.5
BUMPS = np.random.default_rng(5)
CENTRES, SIZES = BUMPS.uniform(-14, 14, (1500, 2)), BUMPS.uniform(0.2, 0.5, 1500)
HEIGHTS = BUMPS.normal(0, 0.12, 1500)


def ground(xy):
    near = np.abs(CENTRES - xy.mean(axis=0)).max(axis=1) < REACH + 2.0
    squares = ((xy[:, None] - CENTRES[near]) ** 2).sum(axis=2)
    return (HEIGHTS[near] * np.exp(-squares / (2 * SIZES[near] ** 2))).sum(axis=1)


def recorded(seed=0):
    """Scans, poses by drifting odometry, and true poses, of a drive in circles."""
    rng = np.random.default_rng(seed)
    angles = np.arange(0, LAPS * 2 * np.pi, STEP / RADIUS)
    truth = np.array([se3(RADIUS * np.cos(a), RADIUS * np.sin(a), 1.0, 0, 0, a + np.pi / 2) for a in angles])
    odometry = [truth[0]]
    for before, after in pairwise(truth):
        drift = exp_se3([0, 0, np.radians(0.12), 0.006, 0.004, 0.002])
        odometry.append(odometry[-1] @ inverse(before) @ after @ drift)
    posed = []
    for stamp, (T, seen) in enumerate(zip(truth, odometry, strict=True)):
        radius, angle = REACH * np.sqrt(rng.uniform(0, 1, 700)), rng.uniform(0, 2 * np.pi, 700)
        xy = T[:2, 3] + np.c_[radius * np.cos(angle), radius * np.sin(angle)]
        points = np.c_[xy, ground(xy) + rng.normal(0, 0.01, len(xy))]
        posed.append(PosedScan(Scan(transform(inverse(T), points), float(stamp)), seen))
    return posed, truth


def rms(trajectory, truth):
    """Of positions, the first poses laid upon each other."""
    moved = truth[0] @ inverse(trajectory.poses[0]) @ trajectory.poses
    return np.sqrt(((moved[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean())


@pytest.fixture(scope="module")
def drive():
    return recorded()


@pytest.fixture(scope="module")
def mapped(drive):
    """The mapper after the drive, and the scan that completed each loop."""
    mapper, completed = Mapper(), {}
    for number, each in enumerate(drive[0]):
        for loop in mapper.add(each.scan, each.T_world_sensor):
            completed[loop.source, loop.target] = number
    mapper.finish()
    return mapper, completed


def test_loops_come_as_soon_as_the_drive_comes_back(mapped):
    _, completed = mapped
    lap, of_submap = 2 * np.pi * RADIUS / STEP, 7
    far = {pair: scan for pair, scan in completed.items() if int(pair[0]) - int(pair[1]) > 4}
    assert len(far) > 3
    for (source, _), scan in far.items():
        assert lap * 0.8 < scan <= (int(source) + 1.5) * of_submap


def test_the_trajectory_is_corrected_at_every_scan(mapped, drive):
    mapper, _ = mapped
    posed, truth = drive
    before, after = mapper.odometry, mapper.trajectory
    np.testing.assert_array_equal(before.poses, [each.T_world_sensor for each in posed])
    np.testing.assert_array_equal(after.stamps, np.arange(len(posed)))
    assert rms(before, truth) > 0.5
    assert rms(after, truth) < rms(before, truth) / 4
    steps = [np.linalg.norm(np.diff(each.poses[:, :3, 3], axis=0), axis=1) for each in (before, after)]
    assert np.abs(steps[1] - steps[0]).max() < 0.1  # no jump from submap to submap


def test_the_corrected_poses_tie_the_submaps_to_the_ground(mapped):
    mapper, _ = mapped
    result = mapper.solution
    assert result.kept.all()
    for posed, T in list(zip(mapper.submaps, result.poses, strict=False))[::5]:
        world = transform(T, posed.submap.points)
        world = world[np.hypot(*world[:, :2].T) < 11.0]
        assert np.abs(world[:, 2] - ground(world[:, :2])).mean() < 0.15


def test_scans_must_be_in_order_and_posed(drive):
    posed, _ = drive
    mapper = Mapper()
    mapper.add(posed[1].scan, posed[1].T_world_sensor)
    with pytest.raises(TerrainLoopError, match="later than the one before"):
        mapper.add(posed[0].scan, posed[0].T_world_sensor)
    with pytest.raises(TerrainLoopError, match="rigid"):
        mapper.add(posed[2].scan, np.zeros((4, 4)))
    assert len(mapper.odometry) == 1


def test_without_loops_the_trajectory_is_that_of_odometry(drive):
    posed, _ = drive
    mapper = Mapper()
    for each in posed[:11]:
        mapper.add_posed(each)
    assert mapper.finish() == []
    assert len(mapper.submaps) == 2
    np.testing.assert_array_equal(mapper.trajectory.poses, mapper.odometry.poses)


def test_each_cloud_may_have_hyperparameters_of_its_own(drive):
    posed, _ = drive
    settings = Settings()
    settings = settings.model_copy(update={"map": settings.map.model_copy(update={"fit": "submap"})})
    mapper = Mapper(settings)
    for each in posed[:20]:
        mapper.add_posed(each)
    mapper.finish()
    assert len({entry.gradient_map.parameters for entry in mapper.detector.entries.values()}) > 1


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    """The drive as a folder of scans, and what the command made of it."""
    posed, truth = drive
    folder = tmp_path_factory.mktemp("drive")
    (folder / "scans").mkdir()
    for number, each in enumerate(posed):
        np.save(folder / "scans" / f"{number:04d}.npy", each.scan.points)
    stamps = np.arange(len(posed), dtype=float)
    write_tum(folder / "odometry.tum", Trajectory(stamps, [each.T_world_sensor for each in posed]))
    write_tum(folder / "truth.tum", Trajectory(stamps, truth))
    return folder


def test_the_command_leaves_all_that_was_promised(folder, mapped, tmp_path, cli):
    out = tmp_path / "out"
    _, text, _ = cli("slam", folder, "-o", out, "--truth", folder / "truth.tum", "--json", "--workers", "1")
    told = json.loads(text)
    assert {path.name for path in out.iterdir()} == {
        *OF_A_RUN, *CORRECTED, *PRODUCTS, "trajectory.png", "relief.png"
    }  # fmt: skip
    mapper, _ = mapped
    written = read_trajectory(out / "trajectory.tum")
    np.testing.assert_allclose(written.poses, mapper.trajectory.poses, atol=0.02)
    assert told["after"]["ate_m"]["rms"] < told["before"]["ate_m"]["rms"] / 4
    assert told["scans"] == len(written)
    assert len(told["loops"]) == len(Run.read(out).loops) == len(mapper.detector.loops)
    _, values = gtsam.readG2o(str(out / "graph.g2o"), True)
    assert values.size() == len(mapper.submaps)
    assert len(read_cloud(out / "map.ply")) > 1000
    assert np.isfinite(tifffile.imread(out / "map.tif")).any()


def test_the_command_says_what_it_did(folder, tmp_path, cli):
    for number in range(30, len(list((folder / "scans").iterdir()))):
        (folder / "scans" / f"{number:04d}.npy").unlink()
    for name in ("odometry.tum", "truth.tum"):
        lines = (folder / name).read_text().splitlines()[:30]
        (folder / name).write_text("\n".join(lines))
    out = tmp_path / "out"
    _, text, _ = cli("slam", folder, "-o", out, "--truth", folder / "truth.tum", "--length", "4")
    text = " ".join(text.split())
    assert "the loops moved the trajectory by up to" in text
    assert "Against the truth:" in text
    assert "trajectory.png" in text


def test_an_interrupt_leaves_what_was_found_by_then(drive, tmp_path):
    posed, _ = drive

    def scans():
        yield from posed[:30]
        raise KeyboardInterrupt

    result = run_slam(scans(), output=tmp_path)
    assert not result.run.complete
    assert not Run.read(tmp_path).complete
    assert len(read_trajectory(tmp_path / "trajectory.tum")) == 30


def test_scans_without_ground_are_an_error_and_leave_nothing(tmp_path):
    empty = [PosedScan(Scan(np.empty((0, 3)), float(k)), np.eye(4)) for k in range(5)]
    with pytest.raises(TerrainLoopError, match="scans of which a submap can be made"):
        run_slam(empty, output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_same_scans_give_the_same_bytes(drive, tmp_path):
    posed, _ = drive
    for name, workers in (("a", 1), ("b", 2)):
        run_slam(posed[:50], submapper=Submapper(length=4.0), output=tmp_path / name, workers=workers)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
