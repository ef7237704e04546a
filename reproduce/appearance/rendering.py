"""Images of the rover's left camera, and colours for the points of its clouds."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import ndimage

from reproduce.appearance.ground import Ground, Light, Sun, ground_of, light, stream
from terrainloop.geometry import Array, transform
from terrainloop.simulation.missions import SimulatedMission
from terrainloop.simulation.sensors import StereoCamera, cast_rays
from terrainloop.simulation.setups import SETUPS
from terrainloop.simulation.terrain import Terrain

STEP = 4  # pixels between the rays that are cast first
BEND = 0.02  # second difference of the inverse depth from ray to ray above which each pixel is cast
FAR = 40.0  # metres; where rays end
HAZE = 150.0  # metres; where the plain has faded into the sky, three pixels below the horizon
GREY = np.array([0.30, 0.59, 0.11], dtype=np.float32)  # of red, green and blue (ITU-R BT.601)
NOISE = 1.5  # standard deviation of a pixel at mid-grey, of 255; half of it is there in the dark


@dataclass(frozen=True)
class Sky:
    """The sun during a drive.

    Attributes
    ----------
    elevation_deg : float
        Elevation of the sun, constant.
    turn_deg : float
        Change of its azimuth from one submap to the next.
    """

    elevation_deg: float = 35.0
    turn_deg: float = 0.6

    def suns(self, mission: SimulatedMission) -> list[Sun]:
        """The sun at each submap; its first azimuth depends on the seed of the mission."""
        first = np.random.default_rng(stream(mission.seed, 1)).uniform(0, 360)
        return [Sun(first + self.turn_deg * i, self.elevation_deg) for i in range(len(mission.clouds))]


def images_of(
    mission: SimulatedMission, every: int = 2, sky: Sky | None = None
) -> list[tuple[NDArray[np.uint8], ...]]:
    """Left images (rows, columns) of every so many-th frame of each submap, in the order driven.

    Drawn from a stream of their own: they change nothing else of a mission, and how many of them are
    asked for changes none of them. A LiDAR takes none.
    """
    setup = SETUPS[mission.sensor]
    camera = setup.sensor
    if not isinstance(camera, StereoCamera):
        return [()] * len(mission.clouds)
    ground = ground_of(mission.terrain, mission.world, mission.seed)

    def image(submap: int, frame: int, shone: Light) -> NDArray[np.uint8]:
        rng = np.random.default_rng(stream(mission.seed, 2, submap, frame))
        return photograph(ground, mission.frames[submap, frame] @ setup.T_body_sensor, shone, camera, rng)

    taken = []
    with ThreadPoolExecutor() as pool:
        for submap, sun in enumerate((sky or Sky()).suns(mission)):
            frames, shone = range(0, setup.frames, every), light(mission.terrain, sun)
            taken.append(tuple(pool.map(image, [submap] * len(frames), frames, [shone] * len(frames))))
    return taken


def colours_of(mission: SimulatedMission, sky: Sky | None = None) -> list[NDArray[np.uint8]]:
    """Red, green and blue (N, 3) of the points of each submap, as its camera would colour them.

    A point has the mean colour of the ground of its voxel's size where the truth puts it, under the
    sun of its submap, with an exposure of each submap and noise of each point.
    """
    ground = ground_of(mission.terrain, mission.world, mission.seed)
    voxel = SETUPS[mission.sensor].voxel
    colours = []
    for submap, sun in enumerate((sky or Sky()).suns(mission)):
        points = transform(mission.truth[submap], mission.clouds[submap])
        seen = ground.brightness(points[:, :2], voxel, light(mission.terrain, sun))
        rng = np.random.default_rng(stream(mission.seed, 3, submap))
        colours.append(_exposed(seen, float((seen @ GREY).mean()), rng))
    return colours


def photograph(
    ground: Ground, T_world_camera: Array, shone: Light, camera: StereoCamera, rng: Generator
) -> NDArray[np.uint8]:
    """A grey image (rows, columns) of the ground.

    Parameters
    ----------
    ground : Ground
        What is photographed.
    T_world_camera : array, (4, 4)
        Pose of the camera, x along the optical axis.
    shone : Light
        The sun and the shadows of the terrain.
    camera : StereoCamera
        Its left eye takes the picture.
    rng : numpy.random.Generator
        Source of exposure and noise.
    """
    origin = T_world_camera[:3, 3]
    v, u = np.arange(camera.height), np.arange(camera.width)
    directions = camera.directions(v, u) @ T_world_camera[:3, :3].T
    inverse_depth = _inverse_depth(ground, origin, camera, T_world_camera, directions)
    seen = inverse_depth > 0
    depth, towards = 1 / inverse_depth[seen], directions[seen]
    # A pixel sees depth / f of ground across and, on the level, that by the sine of the grazing angle
    # along; the noise is averaged over the geometric mean of the two.
    sine = np.maximum(-towards[:, 2], 0.03) / np.linalg.norm(towards, axis=-1)
    xy = origin[:2] + depth[:, None] * towards[:, :2]
    grey = np.empty(seen.shape, dtype=np.float32)
    grey[seen] = ground.brightness(xy, depth / camera.focal_length / np.sqrt(sine), shone) @ GREY
    exposure = float(grey[seen].mean())
    grey[~seen] = sky = np.float32(1.6 * exposure)
    grey[seen] += np.minimum(depth / HAZE, 1) * (sky - grey[seen])
    radius = np.hypot(*np.meshgrid(u - u.mean(), v - v.mean())) / camera.focal_length
    vignetting = np.cos(np.arctan(radius)) ** 2
    return _exposed(ndimage.gaussian_filter(grey * vignetting.astype(np.float32), 0.5), exposure, rng)


def _exposed(brightness: NDArray[np.float32], mean: float, rng: Generator) -> NDArray[np.uint8]:
    """Brightness that averages ``mean`` as a sensor counts it, 0-255, give or take 5 % of exposure."""
    counts = brightness * (120 * rng.normal(1, 0.05) / mean)
    noise = (
        NOISE * np.sqrt(0.25 + np.maximum(counts, 0) / 170) * rng.standard_normal(counts.shape, np.float32)
    )
    return np.clip(np.rint(counts + noise), 0, 255).astype(np.uint8)


def _inverse_depth(
    ground: Ground, origin: Array, camera: StereoCamera, T_world_camera: Array, directions: Array
) -> Array:
    """One by the depth (rows, columns) of each pixel, in 1 / metres; not positive in the sky.

    Rays are cast through every few pixels. On a plane the inverse depth is linear in the image; where it
    is nearly so it is interpolated and put onto the terrain by a Newton step, and around rocks
    and crests every pixel is cast.
    """
    v, u = np.arange(0, camera.height + STEP, STEP), np.arange(0, camera.width + STEP, STEP)
    coarse = _cast(ground.terrain, origin, camera.directions(v, u) @ T_world_camera[:3, :3].T)
    bent = np.zeros(coarse.shape, dtype=bool)
    for axis in (0, 1):
        second = np.abs(ndimage.correlate1d(coarse, [1, -2, 1], axis=axis, mode="nearest"))
        bent |= second > BEND * np.abs(coarse)
    rows, columns = (
        np.maximum(1 - np.abs(np.arange(n)[:, None] - nodes) / STEP, 0)
        for n, nodes in ((camera.height, v), (camera.width, u))
    )
    fine = rows @ coarse @ columns.T
    edges = rows @ bent @ columns.T > 0
    smooth = ~edges & (fine > 0)
    fine[smooth] = _on_terrain(ground, origin, directions[smooth], fine[smooth])
    fine[edges] = _cast(ground.terrain, origin, directions[edges])
    return np.asarray(fine)


def _cast(terrain: Terrain, origin: Array, directions: Array) -> Array:
    """Inverse depth (...) along directions (..., 3) of unit depth; beyond the terrain, its mean plane."""
    lengths = np.linalg.norm(directions, axis=-1)
    rays = (directions / lengths[..., None]).reshape(-1, 3)
    distance = cast_rays(terrain, origin, rays, FAR).reshape(lengths.shape)
    z, x, y = _mean_plane(terrain)
    beyond = (x * directions[..., 0] + y * directions[..., 1] - directions[..., 2]) / (
        origin[2] - z - x * origin[0] - y * origin[1]
    )
    return np.where(np.isnan(distance), beyond, lengths / distance)


def _mean_plane(terrain: Terrain) -> Array:
    """Height at the world's origin and slopes along x and y of the plane nearest to the terrain."""
    some = terrain.height[::16, ::16]
    y, x = (16 * terrain.resolution * np.indices(some.shape)).reshape(2, -1)
    x, y = x + terrain.origin[0], y + terrain.origin[1]
    return np.linalg.lstsq(np.stack([np.ones_like(x), x, y], axis=-1), some.ravel(), rcond=None)[0]


def _on_terrain(ground: Ground, origin: Array, directions: Array, inverse_depth: Array) -> Array:
    """Inverse depths (N,) after a Newton step onto the height field; unchanged beyond it."""
    points = origin + directions / inverse_depth[:, None]
    above = points[:, 2] - ground.terrain.height_at(points[:, :2])
    slope = ground.terrain.slope_at(points[:, :2])
    falling = (slope * directions[:, :2]).sum(-1) - directions[:, 2]
    step = np.where(ground.terrain.contains(points[:, :2]) & (falling > 0.02), above / falling, 0)
    return 1 / (1 / inverse_depth + np.clip(step, -0.2, 0.2))
