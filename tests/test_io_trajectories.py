import os
from pathlib import Path

import numpy as np
import pytest
from clouds_util import DATA, UTM
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.io import Trajectory, read_trajectory, write_tum

KITTI_LINE = "0 -1 0 4.5 1 0 0 -2 0 0 1 0.25"


def _trajectory(count=50, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    poses[:, :3, 3] = UTM + rng.normal(0, 10, (count, 3))
    return Trajectory(1.7e9 + np.sort(rng.uniform(0, 100, count)), poses)


def test_tum_round_trip(tmp_path):
    trajectory = _trajectory()
    write_tum(tmp_path / "t.tum", trajectory)
    again = read_trajectory(tmp_path / "t.tum")
    assert np.array_equal(again.stamps, trajectory.stamps)
    assert np.array_equal(again.poses[:, :3, 3], trajectory.poses[:, :3, 3])
    np.testing.assert_allclose(again.poses, trajectory.poses, rtol=0, atol=1e-9)


def test_tum_by_hand(tmp_path):
    path = tmp_path / "t.tum"
    # A quarter turn about z, its quaternion rounded; blank lines and comments in between.
    path.write_text(
        "# stamp tx ty tz qx qy qz qw\n\n10.5 1 2 3 0 0 0.7071068 0.7071068 # text\n11e0 0 0 0 0 0 0 -1\n"
    )
    trajectory = read_trajectory(path)
    quarter = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(trajectory.poses, [quarter, np.eye(4)], atol=1e-15)
    assert trajectory.stamps.tolist() == [10.5, 11.0]
    assert len(trajectory) == 2


def test_kitti_by_hand(tmp_path):
    (tmp_path / "t.txt").write_text(f"{KITTI_LINE}\n1 0 0 0 0 1 0 0 0 0 1 0\n")
    trajectory = read_trajectory(tmp_path / "t.txt")
    quarter = [[0, -1, 0, 4.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1]]
    np.testing.assert_allclose(trajectory.poses, [quarter, np.eye(4)], atol=1e-15)
    assert trajectory.stamps.tolist() == [0.0, 1.0]


def test_rotations_rounded_in_the_file_come_out_orthogonal(tmp_path):
    poses = np.round(_trajectory().poses[:, :3], 3)
    np.savetxt(tmp_path / "t.txt", poses.reshape(-1, 12))
    rotations = read_trajectory(tmp_path / "t.txt").poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotations, poses[..., :3], atol=2e-3)


GOOD = "0 1 2 3 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("", 1, "stamp tx ty tz"),
        ("# only a comment\n", 1, "no line of numbers"),
        ("1 2 3\n", 1, "3 columns"),
        (f"# c\n{GOOD}0 1 2 3 0 0 1\n", 3, "7 columns"),
        (f"{GOOD}{KITTI_LINE}\n", 2, "12 columns"),
        (f"{GOOD}0 1 2 3 0 0 zero 1\n", 2, "'zero'"),
        (f"{GOOD}0 1 2 3 0 0 nan 1\n", 2, "nan"),
        (f"{GOOD}0 1 inf 3 0 0 0 1\n", 2, "inf"),
        (f"{GOOD}{GOOD}1 1 2 3 0 0 0 0\n", 3, "quaternion"),
        (f"{GOOD}1 1 2 3 0 0 0 0.5\n", 2, "quaternion"),
        (f"{GOOD}1 1 2 3 0 1 0 1\n", 2, "quaternion"),
        (f"{GOOD}1 1 2 3 0 0 1e-160 1e200\n", 2, "quaternion"),
        (f"{GOOD}1_0 1 2 3 0 0 0 1\n", 2, "'1_0'"),
        (f"{GOOD}1 1 2 1e12 0 0 0 1\n", 2, "metres"),
        (f"{GOOD}1 1 2 {'9' * 3000} 0 0 0 1\n", 2, "'9999"),
        (f"{GOOD}{'x' * 3000} 1 2 0 0 0 0 1\n", 2, "'xxxx"),
        (f"{GOOD}" + "1," * 1000 + "\n", 2, "1 columns"),
        ("1e200 0 0 0 0 1 0 0 0 0 1 0\n", 1, "rotation matrix"),
        ("1 0 0 1e300 0 1 0 0 0 0 1 0\n", 1, "metres"),
        (f"{KITTI_LINE}\n2 0 0 0 0 1 0 0 0 0 1 0\n", 2, "rotation matrix"),
        (f"{KITTI_LINE}\n-1 0 0 0 0 1 0 0 0 0 1 0\n", 2, "rotation matrix"),
    ],
)
def test_errors_name_file_line_and_columns(tmp_path, text, line, said):
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(TerrainLoopError) as caught:
        read_trajectory(path)
    assert f"{path}, line {line};" in str(caught.value)
    assert said in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path))


@pytest.mark.parametrize("path", [None, 3, ["t.tum"]])
def test_what_is_no_path_is_refused(path):
    with pytest.raises(TerrainLoopError, match="trajectory"):
        read_trajectory(path)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00\x01\x80"])
def test_files_that_are_no_text_are_refused(tmp_path, content):
    path = tmp_path / "bad.tum"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(TerrainLoopError, match=r"bad\.tum"):
        read_trajectory(path)


@pytest.mark.parametrize(("stamps", "poses"), [((2,), (3, 4, 4)), ((2, 1), (2, 4, 4)), ((2,), (2, 3, 4))])
def test_shapes_are_checked(stamps, poses):
    with pytest.raises(TerrainLoopError, match="one stamp for each pose"):
        Trajectory(np.zeros(stamps), np.zeros(poses))


def test_numbers_are_finite():
    poses = np.tile(np.eye(4), (3, 1, 1))
    for stamps in ([0.0, np.nan, 1.0], ["a", "b", "c"]):
        with pytest.raises(TerrainLoopError, match="stamps"):
            Trajectory(stamps, poses)
    with pytest.raises(TerrainLoopError, match="finite"):
        Trajectory(np.arange(3.0), np.where(poses == 1, np.inf, 0.0))


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_only_regular_files_are_opened(tmp_path, make):
    make(tmp_path / "t.tum")
    with pytest.raises(TerrainLoopError, match="not a regular file"):
        read_trajectory(tmp_path / "t.tum")


def test_a_line_without_end_is_refused_before_it_is_read(tmp_path):
    (tmp_path / "t.tum").write_text("0 " * 1_000_000)
    with pytest.raises(TerrainLoopError, match="line 1 has more than"):
        read_trajectory(tmp_path / "t.tum")


def test_a_file_larger_than_any_trajectory_is_refused(tmp_path):
    with (tmp_path / "t.tum").open("wb") as file:
        file.truncate(10**12)  # sparse
    with pytest.raises(TerrainLoopError, match="MiB"):
        read_trajectory(tmp_path / "t.tum")


def test_a_trajectory_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    write_tum(tmp_path / "t.tum", _trajectory())
    before = (tmp_path / "t.tum").read_bytes()

    def interrupted(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(OSError, match="space"):
        write_tum(tmp_path / "t.tum", _trajectory(seed=1))
    assert [file.name for file in tmp_path.iterdir()] == ["t.tum"]
    assert (tmp_path / "t.tum").read_bytes() == before


@pytest.mark.skipif(not DATA.is_dir(), reason="real data absent")
def test_real_truth():
    trajectory = read_trajectory(DATA / "missions" / "pozo_r20" / "truth.tum")
    raw = np.loadtxt(DATA / "missions" / "pozo_r20" / "truth.tum")
    assert np.array_equal(trajectory.poses[:, :3, 3], raw[:, 1:4])
    np.testing.assert_allclose(
        np.arctan2(trajectory.poses[:, 1, 0], trajectory.poses[:, 0, 0]),
        2 * np.arctan2(raw[:, 6], raw[:, 7]) - 2 * np.pi * (raw[:, 7] < 0),
        atol=1e-8,
    )
