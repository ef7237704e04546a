"""The motion of the rover on the terrain, and its estimate by odometry."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrainloop.geometry import inverse, se3, transform, yaw_of
from terrainloop.simulation.paths import Path
from terrainloop.simulation.terrain import Terrain

Array = NDArray[np.float64]

WHEELBASE, TRACK = 0.9, 0.7  # metres


@dataclass(frozen=True)
class Drift:
    """Errors of a visual-inertial odometry, as standard deviations.

    Attributes
    ----------
    position : float
        Drift per metre travelled of each of forwards, sideways and up (0.007 = 0.7 %).
    heading_deg : float
        Drift of the heading, in degrees per metre travelled.
    memory : float
        Metres after which both drift rates are forgotten.
    gravity_deg : float
        Error of the gravity direction about each horizontal axis, constant within a submap.
    jitter_deg : float
        Error of the attitude about each axis, of each frame alone.
    """

    position: float = 0.007
    heading_deg: float = 0.1
    memory: float = 10.0
    gravity_deg: float = 0.4
    jitter_deg: float = 0.05


@dataclass(frozen=True)
class Estimate:
    """Odometry of a drive of K frames in M submaps.

    Attributes
    ----------
    local : array, (K, 4, 4)
        T_submap_body of each frame, in the frame of its submap.
    odometry : array, (M, 4, 4)
        T_odometry_submap of each submap.
    truth : array, (M, 4, 4)
        T_world_submap of each submap: takes its first frame to the true pose of the rover.
    """

    local: Array
    odometry: Array
    truth: Array


def true_poses(terrain: Terrain, path: Path) -> Array:
    """T_world_body (K, 4, 4) of a rover whose wheelbase rests on the mean plane of the ground below."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 7) * WHEELBASE, np.linspace(-0.5, 0.5, 7) * TRACK)
    poses = []
    for (px, py), heading in zip(path.xy, path.heading, strict=True):
        level = se3(px, py, 0.0, 0.0, 0.0, heading)
        ground = terrain.height_at(transform(level, np.stack([x, y, 0 * x], axis=-1))[..., :2])
        # Least-squares plane; its terms are orthogonal over a centred footprint.
        rise, bank = (x * ground).sum() / (x**2).sum(), (y * ground).sum() / (y**2).sum()
        pitch, roll = -np.arctan(rise), np.arctan(bank * np.cos(np.arctan(rise)))
        poses.append(se3(px, py, float(ground.mean()), roll, pitch, heading))
    return np.stack(poses)


def estimate(true: Array, frames_per_submap: int, drift: Drift, rng: Generator) -> Estimate:
    """Dead reckoning along true poses T_world_body (K, 4, 4), cut into submaps of a given number of frames.

    Attitude is observed up to the gravity error, so only position and heading drift. Each step of the
    rover is rotated by the attitude estimated at that time, which tilts a submap as a whole by its gravity
    error. Odometry starts at the true first pose.
    """
    steps = np.linalg.norm(np.diff(true[:, :3, 3], axis=0, prepend=true[:1, :3, 3]), axis=1)
    rates = _drift_rates(rng, steps, drift)
    heading_error = np.cumsum(np.radians(drift.heading_deg) * rates[:, 3] * steps)
    submap = np.arange(len(true)) // frames_per_submap
    tilts = np.radians(drift.gravity_deg) * rng.standard_normal((submap[-1] + 1, 3)) * [1, 1, 0]
    jitter = np.radians(drift.jitter_deg) * rng.standard_normal((len(true), 3))
    heading = Rotation.from_rotvec(heading_error[:, None] * [0, 0, 1])
    believed = (heading * Rotation.from_rotvec(tilts[submap])).as_matrix() @ true[:, :3, :3]
    moved = np.diff(true[:, :3, 3], axis=0)[:, None] @ true[:-1, :3, :3]  # in the body frame
    moved = moved[:, 0] + drift.position * rates[1:, :3] * steps[1:, None]
    body = np.tile(np.eye(4), (len(true), 1, 1))
    body[:, :3, :3] = believed
    body[0, :3, 3] = true[0, :3, 3]
    body[1:, :3, 3] = true[0, :3, 3] + np.cumsum((believed[:-1] @ moved[..., None])[..., 0], axis=0)
    starts = range(0, len(true), frames_per_submap)
    odometry = np.stack([_levelled(body[i]) for i in starts])
    truth = np.stack([true[i] @ inverse(body[i]) @ T for i, T in zip(starts, odometry, strict=True)])
    body[:, :3, :3] = believed @ Rotation.from_rotvec(jitter).as_matrix()
    local = np.stack([inverse(odometry[m]) @ T for m, T in zip(submap, body, strict=True)])
    return Estimate(local, odometry, truth)


def _levelled(T: Array) -> Array:
    """The upright pose with the same position and yaw."""
    x, y, z = T[:3, 3]
    return se3(x, y, z, 0.0, 0.0, yaw_of(T))


def _drift_rates(rng: Generator, steps: Array, drift: Drift) -> Array:
    """Slowly changing unit-variance rates (K, 4): an Ornstein-Uhlenbeck process of the distance."""
    kept = np.exp(-steps / drift.memory)[:, None]
    rates = rng.standard_normal((len(steps), 4))
    for i in range(1, len(steps)):
        rates[i] = kept[i] * rates[i - 1] + np.sqrt(1 - kept[i] ** 2) * rates[i]
    return rates
