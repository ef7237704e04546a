"""A stereo camera, a spinning LiDAR and an even survey of a height field.

Sensor frames: x forward, y left, z up. Camera and LiDAR see by casting rays, so what lies behind a rock or
a crest is missing, as it is for a rover. Their errors of calibration, zero by default, are drawn from a seed
of the sensor's own: they are the same in every frame, and do not average out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import ndimage

from terrainloop.geometry import inverse, transform
from terrainloop.simulation.terrain import CEILING_PIXELS, Terrain

Array = NDArray[np.float64]


def cast_rays(terrain: Terrain, origin: Array, directions: Array, max_range: float) -> Array:
    """Distance from a point to the terrain along each ray.

    A ray strides while it stays above all heights nearby, else it steps by less than the terrain's
    resolution; the crossing is then bisected to a hundredth of a step.

    Parameters
    ----------
    terrain : Terrain
        What the rays hit.
    origin : array, (3,)
        World point above the ground where all rays start.
    directions : array, (N, 3)
        Unit vectors in the world.
    max_range : float
        Where rays end, in metres.

    Returns
    -------
    array, (N,)
        Distances in metres; NaN where a ray meets nothing within the range and the terrain.
    """
    step, stride = 0.8 * terrain.resolution, (CEILING_PIXELS - 2) * terrain.resolution
    top = float(terrain.height.max())
    result = np.full(len(directions), np.nan)
    active, reached, (dx, dy, dz) = np.arange(len(directions)), np.zeros(len(directions)), directions.T.copy()
    while active.size:
        x, y, z = origin[0] + reached * dx, origin[1] + reached * dy, origin[2] + reached * dz
        near = z + np.minimum(stride * dz, 0) <= _ceiling_at(terrain, x, y)
        under = near.copy()
        under[near] = z[near] <= terrain.height_at(np.stack([x[near], y[near]], axis=-1))
        result[active[under]] = reached[under]
        going = np.flatnonzero(~(under | (reached > max_range) | ((dz >= 0) & (z > top))))
        reached = reached[going] + np.where(near[going], step, stride)
        active, dx, dy, dz = active[going], dx[going], dy[going], dz[going]
    hit = np.flatnonzero(~np.isnan(result))
    result[hit] = _bisect(terrain, origin, directions[hit], result[hit], step)
    inside = terrain.contains(origin[:2] + result[:, None] * directions[:, :2])
    return np.where(inside & (result <= max_range), result, np.nan)


def _ceiling_at(terrain: Terrain, x: Array, y: Array) -> NDArray[np.float32]:
    rows, columns = terrain.height.shape
    column = ((x - terrain.origin[0]) / terrain.resolution + 0.5).astype(np.int64).clip(0, columns - 1)
    row = ((y - terrain.origin[1]) / terrain.resolution + 0.5).astype(np.int64).clip(0, rows - 1)
    return np.asarray(terrain.ceiling[row, column])


def _bisect(terrain: Terrain, origin: Array, directions: Array, far: Array, step: float) -> Array:
    """Where rays that are above ground at ``far - step`` and below it at ``far`` cross it."""
    near = far - step
    for _ in range(7):
        middle = 0.5 * (near + far)
        points = origin + middle[:, None] * directions
        below = points[:, 2] <= terrain.height_at(points[:, :2])
        near, far = np.where(below, near, middle), np.where(below, middle, far)
    return 0.5 * (near + far)


def _returns(terrain: Terrain, T_world_sensor: Array, rays: Array, max_range: float, rng: Generator) -> Array:
    """Distance (N,) along unit rays (N, 3) of the sensor frame; NaN where nothing comes back.

    Below 6 deg of incidence ever fewer of the hits come back.
    """
    origin, directions = T_world_sensor[:3, 3], rays @ T_world_sensor[:3, :3].T
    distances = cast_rays(terrain, origin, directions, max_range)
    slope = terrain.slope_at(origin[:2] + np.nan_to_num(distances)[:, None] * directions[:, :2])
    along_normal = directions[:, 2] - (slope * directions[:, :2]).sum(-1)
    incidence = -along_normal / np.sqrt(1 + (slope**2).sum(-1))
    return np.where(rng.uniform(0, 0.1, len(rays)) < incidence, distances, np.nan)


@dataclass(frozen=True)
class StereoCamera:
    """A stereo camera with a dense matcher.

    Attributes
    ----------
    width, height : int
        Image size in pixels.
    column_step : int
        Rays are cast for every row but only every `column_step`-th column: on flat ground rows thin out
        with the square of the range, columns only with the range.
    focal_length : float
        Focal length in pixels; 457 with 640 columns is a field of view of 70 deg.
    baseline : float
        Distance between the two cameras, in metres.
    max_range : float
        Greatest depth kept, in metres.
    smooth_noise, white_noise : float
        Standard deviations of the disparity error, in pixels: one part that neighbouring pixels share,
        as semi-global matching makes it, and one of each pixel alone.
    correlation : float
        Standard deviation of the Gaussian that smooths the shared part, in pixels.
    locking : float
        Amplitude of the bias towards whole disparities, in pixels (Shimizu & Okutomi 2001).
    blank : float
        Share of the image without texture, hence without depth.
    bias : float
        RMS of an error of the disparity that is the same in every frame, in pixels, as an imperfect
        rectification leaves it.
    bias_correlation : float
        Standard deviation of the Gaussian that smooths it over the image, in pixels.
    bias_seed : int
        Another camera, another error.
    """

    width: int = 640
    height: int = 480
    column_step: int = 4
    focal_length: float = 457.0
    baseline: float = 0.15
    max_range: float = 8.0
    smooth_noise: float = 0.15
    white_noise: float = 0.05
    correlation: float = 5.0
    locking: float = 0.04
    blank: float = 0.06
    bias: float = 0.0
    bias_correlation: float = 8.0
    bias_seed: int = 0

    @property
    def view_centre(self) -> float:
        """Distance ahead of the sensor of the middle of what it sees, in metres."""
        return 0.5 * self.max_range

    def observe(self, terrain: Terrain, T_world_sensor: Array, rng: Generator) -> Array:
        """Points (N, 3) that the matcher yields, in the sensor frame (x along the optical axis)."""
        columns = np.arange(0, self.width, self.column_step)
        pixels = self.directions(np.arange(self.height), columns)
        depth = self._true_depth(terrain, T_world_sensor, pixels, rng)
        true_disparity = self.focal_length * self.baseline / depth
        disparity = _flying_pixels(true_disparity, rng) + self._disparity_error(true_disparity, rng)
        measured = self.focal_length * self.baseline / np.maximum(disparity, 0.1)
        # What the left image shows at a column below the disparity is outside the right image.
        unseen = columns < true_disparity
        kept = ~unseen & (measured <= self.max_range) & ~self._blank_areas(rng)
        return measured[kept][:, None] * pixels[kept]

    def directions(self, rows: NDArray[np.int_], columns: NDArray[np.int_]) -> Array:
        """Directions (len(rows), len(columns), 3) of pixels in the sensor frame, with unit depth."""
        right, down = np.meshgrid(
            (columns - 0.5 * (self.width - 1)) / self.focal_length,
            (rows - 0.5 * (self.height - 1)) / self.focal_length,
        )
        return np.stack([np.ones_like(right), -right, -down], axis=-1)

    def _true_depth(self, terrain: Terrain, T_world_sensor: Array, pixels: Array, rng: Generator) -> Array:
        """Depth image (rows, columns) in metres; NaN where nothing or only grazed ground is seen."""
        lengths = np.linalg.norm(pixels, axis=-1)
        rays = (pixels / lengths[..., None]).reshape(-1, 3)
        # Noise may bring ground from beyond the range within it.
        distances = _returns(terrain, T_world_sensor, rays, 1.15 * self.max_range, rng)
        return np.asarray(distances.reshape(lengths.shape) / lengths)

    def _disparity_error(self, disparity: Array, rng: Generator) -> Array:
        """Error (rows, columns) in pixels: smooth over the image, white, and pixel locking."""
        smooth = self._smooth_field(rng, disparity.shape, self.correlation)
        white = rng.standard_normal(disparity.shape)
        locking = -self.locking * np.sin(2 * np.pi * disparity)
        error = self.smooth_noise * smooth + self.white_noise * white + locking
        return np.asarray(error + self.disparity_bias() if self.bias else error)

    def disparity_bias(self) -> Array:
        """Error (rows, columns cast) of the disparity in every frame, in pixels."""
        shape = self.height, len(range(0, self.width, self.column_step))
        field = self._smooth_field(np.random.default_rng(self.bias_seed), shape, self.bias_correlation)
        return self.bias * field

    def _blank_areas(self, rng: Generator) -> NDArray[np.bool_]:
        """Where (rows, columns) the image has too little texture to match."""
        shape = self.height, len(range(0, self.width, self.column_step))
        texture = self._smooth_field(rng, shape, 4 * self.correlation)
        return np.asarray(texture < np.quantile(texture, self.blank))

    def _smooth_field(self, rng: Generator, shape: tuple[int, ...], sigma: float) -> Array:
        """Unit-variance noise smoothed by a Gaussian of ``sigma`` pixels."""
        white = rng.standard_normal(shape)
        field = ndimage.gaussian_filter(white, (sigma, sigma / self.column_step), mode="wrap")
        return np.asarray(field / field.std())


def _flying_pixels(disparity: Array, rng: Generator) -> Array:
    """Disparities with some pixels at edges drawn to anywhere between the two sides."""
    for axis in (0, 1):
        beside = np.roll(disparity, 1, axis)
        flying = (np.abs(beside - disparity) > 1) & (rng.random(disparity.shape) < 0.15)
        mixed = disparity + rng.random(disparity.shape) * (beside - disparity)
        disparity = np.where(flying, mixed, disparity)
    return disparity


@dataclass(frozen=True)
class SpinningLidar:
    """A spinning LiDAR, upright on the rover.

    Attributes
    ----------
    rings : int
        Lasers, evenly spread over the elevations.
    elevations_deg : (float, float)
        Lowest and highest laser.
    azimuth_step_deg : float
        Rotation between two shots.
    max_range : float
        Greatest distance kept, in metres.
    range_noise : float
        Standard deviation of a distance, in metres.
    range_bias, elevation_bias_deg : float
        Standard deviations over the rings of an error of the distance (metres) and of the elevation that
        is the same in every turn.
    bias_seed : int
        Another LiDAR, other errors.
    """

    rings: int = 32
    elevations_deg: tuple[float, float] = (-25.0, 15.0)
    azimuth_step_deg: float = 0.3
    max_range: float = 20.0
    range_noise: float = 0.02
    range_bias: float = 0.0
    elevation_bias_deg: float = 0.0
    bias_seed: int = 0

    @property
    def view_centre(self) -> float:
        """Distance ahead of the sensor of the middle of what it sees, in metres."""
        return 0.0

    def observe(self, terrain: Terrain, T_world_sensor: Array, rng: Generator) -> Array:
        """Points (N, 3) of one turn, in the sensor frame."""
        first_azimuth = rng.uniform(0, np.radians(self.azimuth_step_deg))
        range_bias, elevation_bias = self.ring_biases()
        elevation = np.radians(np.linspace(*self.elevations_deg, self.rings))
        rays, believed = (self._rays(first_azimuth, e) for e in (elevation + elevation_bias, elevation))
        distances = _returns(terrain, T_world_sensor, rays, self.max_range, rng)
        back = ~np.isnan(distances)
        measured = distances[back] + self.range_noise * rng.standard_normal(back.sum())
        measured += np.repeat(range_bias, len(rays) // self.rings)[back]
        return np.asarray(measured[:, None] * believed[back])

    def ring_biases(self) -> tuple[Array, Array]:
        """Errors (rings,) of the distance, in metres, and of the elevation, in radians, in every turn."""
        range_bias, elevation_bias = np.random.default_rng(self.bias_seed).standard_normal((2, self.rings))
        return self.range_bias * range_bias, np.radians(self.elevation_bias_deg) * elevation_bias

    def _rays(self, first_azimuth: float, elevation: Array) -> Array:
        """Unit vectors (N, 3) of one turn at elevations (rings,), in the sensor frame."""
        elevation = elevation[:, None]
        azimuth = first_azimuth + np.radians(np.arange(0, 360, self.azimuth_step_deg))
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Survey:
    """Evenly spread points of a square, all equally accurate and none hidden, as a survey yields them.

    Attributes
    ----------
    side : float
        Of the square about the sensor, in metres.
    points : int
        How many.
    noise : float
        Standard deviation of a height, in metres.
    """

    side: float = 9.0
    points: int = 7000
    noise: float = 0.006

    @property
    def max_range(self) -> float:
        """Horizontal distance of the corners, in metres."""
        return float(self.side / np.sqrt(2))

    @property
    def view_centre(self) -> float:
        """Distance ahead of the sensor of the middle of what it sees, in metres."""
        return 0.0

    def observe(self, terrain: Terrain, T_world_sensor: Array, rng: Generator) -> Array:
        """Points (N, 3) of the square, in the sensor frame."""
        level = np.zeros((self.points, 3))
        level[:, :2] = rng.uniform(-0.5 * self.side, 0.5 * self.side, (self.points, 2))
        ground = transform(T_world_sensor, level)
        ground[:, 2] = terrain.height_at(ground[:, :2]) + self.noise * rng.standard_normal(self.points)
        return transform(inverse(T_world_sensor), ground)
