"""How a sensor is carried and how its frames become submaps."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.geometry import se3
from terrainloop.simulation.odometry import Drift
from terrainloop.simulation.sensors import SpinningLidar, StereoCamera, Survey

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Setup:
    """A sensor on the rover and how its frames become submaps; metres and degrees.

    Attributes
    ----------
    sensor : StereoCamera, SpinningLidar or Survey
        What looks at the ground.
    mast : float
        Height of the sensor above the ground between the wheels.
    pitch_deg : float
        How far the sensor looks down.
    submap_length, frame_spacing : float
        Distance driven in a submap and between two frames.
    voxel : float
        Side of the voxels that are thinned to the mean of their points.
    terrain_resolution : float
        Node distance of the height field.
    drift : Drift
        Errors of the odometry.
    """

    sensor: StereoCamera | SpinningLidar | Survey
    mast: float
    pitch_deg: float
    submap_length: float
    frame_spacing: float
    voxel: float
    terrain_resolution: float
    drift: Drift

    @property
    def frames(self) -> int:
        """Frames in a submap."""
        return round(self.submap_length / self.frame_spacing)

    @property
    def T_body_sensor(self) -> Array:
        """Pose of the sensor on the rover."""
        return se3(0.0, 0.0, self.mast, 0.0, np.radians(self.pitch_deg), 0.0)


_STEREO = Setup(
    sensor=StereoCamera(),
    mast=1.1,
    pitch_deg=20.0,
    submap_length=7.0,
    frame_spacing=0.5,
    voxel=0.035,
    terrain_resolution=0.035,
    drift=Drift(),
)
_LIDAR = Setup(
    sensor=SpinningLidar(),
    mast=1.5,
    pitch_deg=0.0,
    submap_length=25.0,
    frame_spacing=1.0,
    voxel=0.10,
    terrain_resolution=0.05,
    drift=Drift(position=0.002, heading_deg=0.02),  # scan matching drifts less than stereo
)
_SURVEY = Setup(
    sensor=Survey(),
    mast=0.0,
    pitch_deg=0.0,
    submap_length=7.0,
    frame_spacing=7.0,
    voxel=0.035,
    terrain_resolution=0.03,
    drift=Drift(),
)
SETUPS = {
    "stereo": _STEREO,
    "lidar": _LIDAR,
    "survey": _SURVEY,
    "biased_stereo": replace(_STEREO, sensor=StereoCamera(bias=0.2)),
    "biased_lidar": replace(_LIDAR, sensor=SpinningLidar(range_bias=0.015, elevation_bias_deg=0.05)),
}
"""By name, `names.SENSORS`."""

MOST_SUBMAPS = 10_000
"""Of a simulated mission; the memory for its terrain, which grows with their square, is exceeded before."""


def checked_setup(sensor: str | Setup, submaps: int, seed: int) -> Setup:
    """The setup of a name, or the one given, after checking what a simulation is asked for.

    Raises
    ------
    TerrainLoopError
        Unknown sensor, no submaps, or a negative seed.
    """
    if not isinstance(sensor, Setup) and sensor not in SETUPS:
        raise TerrainLoopError(
            expected="a sensor out of " + ", ".join(SETUPS), found=repr(sensor), mend="choose one of these"
        )
    if submaps < 1:
        raise TerrainLoopError(
            expected="at least one submap", found=str(submaps), mend="ask for 1 or more; 16 has loops"
        )
    if submaps > MOST_SUBMAPS:
        raise TerrainLoopError(
            expected=f"at most {MOST_SUBMAPS} submaps", found=str(submaps), mend="simulate several missions"
        )
    if seed < 0:
        raise TerrainLoopError(expected="a seed of 0 or more", found=str(seed), mend="drop the sign")
    return sensor if isinstance(sensor, Setup) else SETUPS[sensor]
