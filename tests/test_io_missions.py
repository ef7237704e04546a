import logging

import numpy as np
import pytest
from clouds_util import DATA, ground

from terrainloop.errors import TerrainLoopError
from terrainloop.io import load_mission, write_cloud

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


def test_an_empty_folder_lists_what_was_looked_for(tmp_path):
    (tmp_path / "passes.csv").write_text("cloud,pass\n")
    with pytest.raises(TerrainLoopError, match=r"\*\.ply \*\.pcd \*\.las \*\.laz \*\.npy \*\.npz \*\.xyz\)"):
        load_mission(tmp_path)


def test_two_clouds_of_one_name_are_an_error(tmp_path):
    _mission(tmp_path, ["a.ply", "b.ply", "b.npy"])
    with pytest.raises(TerrainLoopError, match="2 files named b"):
        load_mission(tmp_path)


def test_numbers_without_padding_are_an_error(tmp_path):
    _mission(tmp_path, ["scan_9.ply", "scan_10.ply"])
    with pytest.raises(TerrainLoopError, match="pad the numbers"):
        load_mission(tmp_path)


@pytest.mark.parametrize("names", [["9.25.ply", "9.5.ply"], ["a2.ply", "b1.ply"], ["007.ply", "010.ply"]])
def test_other_names_keep_their_alphabetical_order(tmp_path, names):
    _mission(tmp_path, names)
    assert [file.name for file in load_mission(tmp_path).files] == names


@pytest.mark.parametrize("name", ["odometry.tum", "truth.tum", "odometry.txt", "truth.txt"])
def test_a_trajectory_has_one_line_a_cloud(tmp_path, name):
    _mission(tmp_path, ["0.ply", "1.ply"])
    (tmp_path / name).write_text(TUM_LINES)
    with pytest.raises(TerrainLoopError, match=f"expected 2 poses, one a cloud; found 3 in .*{name}"):
        load_mission(tmp_path)


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
