import logging
import os

import numpy as np
import pytest
from clouds_util import DATA, ground

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import inverse, se3
from terrainloop.io import Trajectory, load_mission, write_cloud, write_tum
from terrainloop.io.missions import read_sessions

TUM_LINES = "10.5 0 0 0 0 0 0 1\n11.5 1 0 0 0 0 0 1\n12.5 2 0 0 0 0 0 1\n"
KITTI_LINES = "1 0 0 7 0 1 0 0 0 0 1 0\n" * 3


def _mission(folder, names=("000.ply", "001.npy", "002.xyz")):
    folder.mkdir(exist_ok=True)
    for seed, name in enumerate(names):
        write_cloud(folder / name, ground(seed=seed))


def test_clouds_in_their_folder_with_both_trajectories(tmp_path):
    _mission(tmp_path / "clouds")
    (tmp_path / "odometry.tum").write_text(TUM_LINES)
    (tmp_path / "truth.txt").write_text(KITTI_LINES)
    (tmp_path / "stray.ply").write_text("not looked at")
    mission = load_mission(str(tmp_path))
    assert mission.names == ("000", "001", "002")
    assert len(mission) == 3
    assert mission.truth.poses[2, 0, 3] == 7
    submaps = list(mission)
    assert [submap.name for submap in submaps] == ["000", "001", "002"]
    assert [submap.stamp for submap in submaps] == [10.5, 11.5, 12.5]
    for seed, submap in enumerate(submaps):
        np.testing.assert_allclose(submap.points, ground(seed=seed), atol=1e-6)


def test_clouds_straight_in_the_folder_leave_text_to_notes(tmp_path):
    _mission(tmp_path)
    (tmp_path / "truth.txt").write_text(KITTI_LINES)
    (tmp_path / "passes.csv").write_text("cloud,pass\n000,0\n")
    (tmp_path / "._000.ply").write_text("what a file manager leaves behind")
    mission = load_mission(tmp_path)
    assert mission.names == ("000", "001", "002")
    assert mission.odometry is None
    assert [submap.stamp for submap in mission] == [0, 1, 2]


def test_text_clouds_count_inside_clouds(tmp_path):
    (tmp_path / "clouds").mkdir()
    for name in ("a.txt", "b.csv", "C.XYZ"):
        np.savetxt(tmp_path / "clouds" / name, ground())
    assert load_mission(tmp_path).names == ("C", "a", "b")


def test_without_trajectories_the_stamp_is_the_index(tmp_path):
    _mission(tmp_path)
    assert load_mission(tmp_path).read(2).stamp == 2.0


def test_broken_clouds_are_left_out_and_named(tmp_path, caplog):
    _mission(tmp_path)
    (tmp_path / "001.npy").write_bytes(b"garbage")
    (tmp_path / "truth.tum").write_text(TUM_LINES)
    mission = load_mission(tmp_path)
    with caplog.at_level(logging.WARNING, logger="terrainloop.io.missions"):
        submaps = list(mission)
    assert [(submap.name, submap.stamp) for submap in submaps] == [("000", 10.5), ("002", 12.5)]
    assert ["left out 001.npy" in record.getMessage() for record in caplog.records] == [True]
    with pytest.raises(TerrainLoopError, match=r"001\.npy"):
        mission.read(1)


def test_only_broken_clouds_are_an_error(tmp_path):
    for name in ("a.ply", "b.laz"):
        (tmp_path / name).write_bytes(b"garbage")
    with pytest.raises(TerrainLoopError, match="2 broken"):
        list(load_mission(tmp_path))


def test_clouds_are_read_only_when_asked_for(tmp_path):
    _mission(tmp_path)
    submaps = iter(load_mission(tmp_path))
    assert next(submaps).name == "000"
    (tmp_path / "001.npy").unlink()
    assert [submap.name for submap in submaps] == ["002"]


@pytest.mark.parametrize("kind", ["absent", "file"])
def test_a_mission_is_a_folder(tmp_path, kind):
    path = tmp_path / "m"
    if kind == "file":
        path.write_text("")
    with pytest.raises(TerrainLoopError, match="mission folder"):
        load_mission(path)


@pytest.mark.parametrize("path", [None, 3, ["m"], "a\0b", "x" * 5000])
def test_what_is_no_path_is_no_mission(path):
    with pytest.raises(TerrainLoopError, match="mission folder") as caught:
        load_mission(path)
    assert len(str(caught.value)) < 500


def test_an_empty_folder_lists_what_was_looked_for(tmp_path):
    (tmp_path / "passes.csv").write_text("cloud,pass\n")
    with pytest.raises(TerrainLoopError, match=r"\*\.ply \*\.pcd \*\.las \*\.laz \*\.npy \*\.npz \*\.xyz\)"):
        load_mission(tmp_path)


def test_two_clouds_of_one_name_are_an_error(tmp_path):
    _mission(tmp_path, ["a.ply", "b.ply", "b.npy"])
    with pytest.raises(TerrainLoopError, match="2 files named b"):
        load_mission(tmp_path)


@pytest.mark.parametrize("names", [["9.25.ply", "9.5.ply"], ["a2.ply", "b1.ply"], ["007.ply", "010.ply"]])
def test_without_poses_names_that_are_ambiguous_keep_their_order(tmp_path, names):
    _mission(tmp_path, names)
    assert [file.name for file in load_mission(tmp_path).files] == names


@pytest.mark.parametrize("name", ["odometry.tum", "truth.tum", "odometry.txt", "truth.txt"])
def test_a_trajectory_has_one_line_a_cloud(tmp_path, name):
    _mission(tmp_path, ["0.ply", "1.ply"])
    (tmp_path / name).write_text(TUM_LINES)
    with pytest.raises(TerrainLoopError, match=f"expected 2 poses, one for each cloud; found 3 in .*{name}"):
        load_mission(tmp_path)


def test_poses_go_to_the_clouds_that_the_numbers_name(tmp_path):
    names = [f"run_2_part_{k}.npy" for k in (7, 8, 9, 10, 11, 100)]
    _mission(tmp_path, names)
    poses = np.array([se3(10.0 * k, 0, 0, 0, 0, 0) for k in range(6)])
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(6.0), poses))
    mission = load_mission(tmp_path)
    assert [file.name for file in mission.files] == names
    for seed, submap in enumerate(mission):
        np.testing.assert_allclose(submap.points, ground(seed=seed), atol=1e-6)
        assert submap.stamp == seed


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to(path.parent / "gone")])
def test_a_trajectory_that_is_no_file_is_refused_at_once(tmp_path, make):
    _mission(tmp_path)
    make(tmp_path / "odometry.tum")
    with pytest.raises(TerrainLoopError, match=r"odometry\.tum"):
        load_mission(tmp_path)


def test_a_cloud_that_is_a_pipe_is_a_broken_one(tmp_path):
    _mission(tmp_path)
    os.mkfifo(tmp_path / "003.ply")
    mission = load_mission(tmp_path)
    assert len(mission) == 4
    assert len(list(mission)) == 3


def test_a_name_that_is_not_in_utf8_is_refused(tmp_path):
    _mission(tmp_path)
    (tmp_path / os.fsdecode(b"sc\xe4n.ply")).write_bytes(b"ply")
    with pytest.raises(TerrainLoopError, match=r"UTF-8.*sc\\udce4n"):
        load_mission(tmp_path)


def _drive(count=12):
    """A rover's poses along a curve that begins at the origin."""
    yaws = 0.4 * np.arange(count)
    steps = 5.0 * np.column_stack([np.cos(yaws), np.sin(yaws)])
    xy = np.cumsum(steps, axis=0) + np.array([40.0, 10.0])
    return np.array([se3(x, y, 0.1, 0.01, -0.01, yaw) for (x, y), yaw in zip(xy, yaws, strict=True)])


def test_poses_inverse_to_the_odometry_are_refused(tmp_path):
    _mission(tmp_path, [f"{k:02d}.npy" for k in range(12)])
    poses, stamps = _drive(), np.arange(12.0)
    inverted = np.array([inverse(pose) for pose in poses])
    write_tum(tmp_path / "odometry.tum", Trajectory(stamps, poses))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, poses))
    assert len(load_mission(tmp_path)) == 12
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, inverted))
    with pytest.raises(TerrainLoopError, match=r"inverse poses.*truth\.tum"):
        load_mission(tmp_path)
    write_tum(tmp_path / "odometry.tum", Trajectory(stamps, inverted))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, poses))
    with pytest.raises(TerrainLoopError, match="inverse poses"):
        load_mission(tmp_path)


def test_trajectories_that_move_in_different_ways_are_reported(tmp_path, caplog):
    _mission(tmp_path, [f"{k:02d}.npy" for k in range(12)])
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(12.0), _drive()))
    write_tum(tmp_path / "truth.tum", Trajectory(np.arange(12.0), _drive()[[0, 10, 11, *range(1, 10)]]))
    load_mission(tmp_path)
    assert not caplog.records  # neighbours are still neighbours
    write_tum(tmp_path / "truth.tum", Trajectory(np.arange(12.0), _drive()[::-1]))
    load_mission(tmp_path)
    assert ["steps" in record.getMessage() for record in caplog.records] == [True]


def test_odometry_that_looks_inverse_is_reported(tmp_path, caplog):
    _mission(tmp_path, [f"{k:02d}.npy" for k in range(12)])
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(12.0), _drive()))
    load_mission(tmp_path)
    assert not caplog.records
    inverted = np.array([inverse(pose) for pose in _drive()])
    write_tum(tmp_path / "odometry.tum", Trajectory(np.arange(12.0), inverted))
    load_mission(tmp_path)
    assert ["T_submap_world" in record.getMessage() for record in caplog.records] == [True]


def test_a_mission_is_a_sequence(tmp_path):
    _mission(tmp_path)
    mission = load_mission(tmp_path)
    assert [mission[i].name for i in (0, 2, -1, np.int64(-3))] == ["000", "002", "002", "000"]
    assert [submap.name for submap in mission[1:]] == ["001", "002"]
    assert mission[5:] == []
    for index in (3, -4):
        with pytest.raises(TerrainLoopError, match="index below 3"):
            mission[index]
    with pytest.raises(IndexError):
        mission[3]
    for index in ("000", 1.0, None, slice("a", "b")):
        with pytest.raises(TerrainLoopError, match="integer or a slice"):
            mission[index]


def test_a_slice_leaves_out_what_is_broken_and_an_index_refuses_it(tmp_path):
    _mission(tmp_path)
    (tmp_path / "001.npy").write_bytes(b"garbage")
    mission = load_mission(tmp_path)
    assert [submap.name for submap in mission[:2]] == ["000"]
    with pytest.raises(TerrainLoopError, match=r"001\.npy"):
        mission[1]


def test_a_mission_describes_itself_in_a_line(tmp_path):
    _mission(tmp_path)
    assert repr(load_mission(tmp_path)) == f"Mission({tmp_path}, 3 clouds, 000 ... 002)"
    (tmp_path / "truth.tum").write_text(TUM_LINES)
    assert repr(load_mission(tmp_path)).endswith("002, truth)")
    assert repr(load_mission(tmp_path).truth) == "Trajectory(3 poses, stamps 10.5 to 12.5)"


def test_sessions_by_cloud(tmp_path):
    file = tmp_path / "s.csv"
    file.write_text("cloud, session\n\n000,morning\n001, noon \n", encoding="utf-8-sig")
    assert read_sessions(file) == {"000": "morning", "001": "noon"}
    file.write_text("cloud,pass\r\na,1\r\nb,1\r\n")
    assert read_sessions(str(file)) == {"a": "1", "b": "1"}


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", 1),
        ("000,a\n001,b\n", 1),
        ("session,cloud\na,000\n", 1),
        ("cloud,session,note\n000,a,x\n", 1),
        ("cloud\n000\n", 1),
        ("cloud,session\n000,a\n001\n", 3),
        ("cloud,session\n000,a\n\n001,b,c\n", 4),
        ("cloud,session\n000,a\n000,b\n", 3),
        ("cloud,session\n000,a\n000,a\n", 3),
        ("cloud,session\n000,\n", 2),
        ("cloud,session\n ,a\n", 2),
        ("cloud;session\n000;a\n", 1),
    ],
)
def test_sessions_that_are_not_clear_are_refused_by_line(tmp_path, content, line):
    file = tmp_path / "s.csv"
    file.write_text(content)
    with pytest.raises(TerrainLoopError, match=f"s.csv, line {line};") as caught:
        read_sessions(file)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "spoil", [os.mkfifo, os.mkdir, lambda path: path.write_bytes(b"cloud,session\n\xff")]
)
def test_sessions_from_no_text_are_refused(tmp_path, spoil):
    spoil(tmp_path / "s.csv")
    with pytest.raises(TerrainLoopError, match=r"s\.csv"):
        read_sessions(tmp_path / "s.csv")


@pytest.mark.skipif(not DATA.is_dir(), reason="real data absent")
def test_real_mission():
    mission = load_mission(DATA / "missions" / "pozo_r20")
    assert len(mission) == len(mission.truth) == 109
    assert mission.names[-1] == "000108"
    for index in (0, 54, 108):
        submap = mission.read(index)
        assert submap.stamp == index
        assert np.ptp(submap.points[:, :2], axis=0).max() <= 40.001  # discs of 20 m radius
        assert submap.repairs == ()
