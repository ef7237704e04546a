"""Poses of submaps: gravity-aligned frames by contract, and what is said where they are not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import se3
from terrainloop.io import Trajectory, write_tum
from terrainloop.io.submap_poses import check_upright, read_submap_poses

UPRIGHT = np.eye(3)
CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_body_camera


def _drive(count=9, tilt=0.01, turn=0.5):
    rng = np.random.default_rng(0)
    yaws = turn * np.arange(count)
    x, y = np.cumsum([np.cos(yaws), np.sin(yaws)], axis=1)
    angles = rng.normal(0, tilt, (count, 2))
    return np.array([se3(*p[:2], 0.0, *p[2:4], p[4]) for p in np.column_stack([x, y, angles, yaws])])


def _rotated(poses, right=UPRIGHT, left=UPRIGHT):
    changed = poses.copy()
    changed[:, :3, :3] = left @ poses[:, :3, :3] @ right
    return Trajectory(np.arange(float(len(poses))), changed)


def _w_first(poses):
    x, y, z, w = Rotation.from_matrix(poses[:, :3, :3]).as_quat().T
    misread = Rotation.from_quat(np.stack([w, x, y, z], axis=-1)).as_matrix()
    return _rotated(np.tile(np.eye(4), (len(poses), 1, 1)), misread)


WRONG = {
    "w first": (_w_first(_drive()), "w first"),
    "w first, planar": (_w_first(_drive(tilt=0.0)), "w first"),
    "w first, one heading": (_w_first(_drive(count=3, turn=0.0)), "w first"),
    "w first, driving backwards": (
        _w_first(_drive(count=6, tilt=0.0) @ se3(0, 0, 0, 0, 0, np.pi)),
        "w first",
    ),
    "w first, small tilts": (
        _w_first(_drive(count=3, tilt=0.0, turn=0.05) @ se3(0, 0, 0, 0, 0, 3.0)),
        "w first",
    ),
    "z down": (_rotated(_drive(), np.diag([1.0, -1.0, -1.0])), "z down"),
    "camera": (_rotated(_drive(), CAMERA), "camera frames"),
    "camera pitched down": (
        _rotated(_drive(), Rotation.from_euler("y", 20, degrees=True).as_matrix() @ CAMERA),
        "camera frames",
    ),
    "camera world": (_rotated(_drive(), CAMERA, CAMERA.T), "y axis is vertical"),
    "sensor on a mast": (
        _rotated(_drive(turn=0.1), Rotation.from_euler("y", 50, degrees=True).as_matrix()),
        "sensor poses",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_frames_that_are_not_upright_are_refused_with_the_likely_cause(case):
    trajectory, cause = WRONG[case]
    with pytest.raises(TerrainLoopError, match=f"gravity-aligned.*{cause}"):
        check_upright(trajectory, "odometry.tum")


def test_a_single_frame_on_its_head_is_refused_by_number():
    poses = _drive()
    poses[4] = poses[4] @ se3(0, 0, 0, np.pi / 2, 0, 0)
    with pytest.raises(TerrainLoopError, match=r"90 deg at pose 5 in t\.tum"):
        check_upright(_rotated(poses), "t.tum")


@pytest.mark.parametrize("tilt", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("turn", [0.0, 0.01, 0.5, 3.1])
def test_upright_frames_pass(tilt, turn, caplog):
    check_upright(_rotated(_drive(tilt=tilt, turn=turn)), "t.tum")
    assert not caplog.records


def test_doubtful_frames_are_reported(caplog):
    check_upright(_rotated(_drive() @ se3(0, 0, 0, 0.3, 0.1, 0)), "t.tum")
    assert ["tilted by up to" in record.getMessage() for record in caplog.records] == [True]


def test_poses_of_submaps_are_read_and_checked(tmp_path):
    file = tmp_path / "truth.tum"
    names = [f"s{k}" for k in range(9)]
    write_tum(file, _rotated(_drive()))
    np.testing.assert_allclose(read_submap_poses(file, names).poses, _drive(), atol=1e-9)
    with pytest.raises(TerrainLoopError, match="expected 8 poses"):
        read_submap_poses(file, names[:8])
    with pytest.raises(TerrainLoopError, match="'s0' where 's8' is due"):
        read_submap_poses(file, names[::-1])
    with pytest.raises(TerrainLoopError, match="one possible order"):
        read_submap_poses(file, [f"3.{k}" for k in range(2, 11)])
    write_tum(file, WRONG["w first"][0])
    with pytest.raises(TerrainLoopError, match=r"w first; write qx qy qz qw"):
        read_submap_poses(file, names)
