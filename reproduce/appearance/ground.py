"""Appearance of the ground of a simulated world: grain, stones, rocks, sun and shadows.

The appearance of a point depends only on the world, the seed, its position and the sun. All noise comes from
hashed lattices, each rotated and shifted at random, so that nothing is periodic.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import ArrayLike
from scipy import ndimage

from reproduce.appearance.looks import LOOKS, Look
from reproduce.appearance.noise import Image, Lattice, value_noise
from terrainloop.geometry import Array
from terrainloop.simulation.terrain import Terrain

FINEST, COARSEST = 0.002, 4.096  # metres; cells of the finest and the coarsest octave of the albedo
FAR_BLUR = 0.08  # metres; of the terrain's slope where a pixel sees as much
TERRAIN_TAKES_OVER = 0.064  # metres; coarser relief than this is in the terrain
STONE_HEIGHT = 0.6  # of a dome, in radii
STONE_REACH = 1.9  # radii from its centre to the end of its shadow at most
UNIFORM = np.float32(np.sqrt(12))  # a uniform number times this has unit variance


def stream(seed: int, *key: int) -> SeedSequence:
    """Random numbers for the appearance, apart from those of terrain, path, odometry and sensor."""
    return SeedSequence((seed, 0x5EE), spawn_key=key)


@dataclass(frozen=True)
class Sun:
    """Direction from the ground to the sun, in degrees; azimuth from x to y."""

    azimuth_deg: float
    elevation_deg: float

    @property
    def direction(self) -> Array:
        """Unit vector (3,) towards the sun."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        level = np.cos(elevation)
        return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


@dataclass(frozen=True, eq=False)
class Light:
    """The sun, and which nodes of a terrain it reaches: 1 in the sun, 0 in a shadow, (rows, columns)."""

    sun: Sun
    lit: Image


def light(terrain: Terrain, sun: Sun, reach: float = 8.0) -> Light:
    """Cast the shadows of a height field.

    A node is in shadow if, within ``reach`` metres towards the sun, the ground rises above its
    line to it. The greatest rise over 2 k nodes follows from that over k nodes and the same k nodes away,
    so that doubling takes the logarithm of the reach. Borders blur over 2 cm of height, as a
    sun half a degree wide and a camera's pixels blur them.
    """
    towards = np.array([np.sin(np.radians(sun.azimuth_deg)), np.cos(np.radians(sun.azimuth_deg))])
    fall = terrain.resolution * np.tan(np.radians(sun.elevation_deg))
    rise, nodes = _shifted(terrain.height, towards) - np.float32(fall), 1
    while nodes * terrain.resolution < reach:
        rise = np.maximum(rise, _shifted(rise, nodes * towards) - np.float32(nodes * fall))
        nodes *= 2
    lit = np.clip((terrain.height - rise) / 0.02 + 0.5, 0, 1).astype(np.float32)
    _set_border(lit, 1.0)
    return Light(sun, lit)


def _shifted(image: Image, by: Array) -> Image:
    """The image (rows, columns) shifted by a number of rows and columns."""
    return np.asarray(ndimage.shift(image, -by, order=1, mode="nearest"))


@dataclass(frozen=True, eq=False)
class Ground:
    """A terrain with its appearance; make it with `ground_of`.

    Attributes
    ----------
    terrain : Terrain
        Its shape.
    look : Look
        Its material.
    nodes : array, (rows, columns, 5) float32
        At each node of the terrain: slope along x and y, the same two smoothed by `FAR_BLUR`, and 1 on
        rocks, 0 elsewhere.
    salt : int
        Number that the hashes of this world and seed are mixed with.
    """

    terrain: Terrain
    look: Look
    nodes: Image
    salt: int

    def brightness(self, xy: Array, footprint: ArrayLike, light: Light) -> Image:
        """Light reflected by the ground, in red, green and blue (N, 3); white paper facing the sun is 1.

        Lambert's law on the slopes of terrain, grain and stones, times the albedo.

        Parameters
        ----------
        xy : array, (N, 2)
            World points in metres.
        footprint : array, (N,), or float
            Extent of the ground that is averaged, in metres; finer detail fades out.
        light : Light
            Sun and shadows.
        """
        footprint = np.broadcast_to(np.asarray(footprint, dtype=np.float32), len(xy))
        near_x, near_y, far_x, far_y, rock = _at_nodes(self.nodes, self.terrain, xy).T
        lit = _at_nodes(light.lit[..., None], self.terrain, xy)[:, 0]
        far = np.clip(footprint / np.float32(FAR_BLUR) - 0.5, 0, 1)
        slope_x, slope_y = near_x + far * (far_x - near_x), near_y + far * (far_y - near_y)
        surface = _Surface(np.ones_like(rock), slope_x, slope_y, lit)
        self._add_grain(surface, xy, footprint)
        for layer in range(len(self.look.stones)):
            self._add_stones(surface, xy, footprint, light.sun, layer)
        mean, deviation = self.look.rock_tone
        tone = surface.tone * (1 + rock * (mean - 1 + deviation * value_noise(xy, 0.3, self.salt + 30)[0]))
        received = self.look.sky_light + (1 - self.look.sky_light) * surface.sunlight(light.sun)
        tint = np.array(self.look.tint, dtype=np.float32)
        # Rocks are a little less coloured than the dust around them.
        tints = tint + 0.3 * rock[:, None] * (tint.mean() - tint)
        return np.asarray(tints * (tone * received)[:, None])

    def _add_grain(self, surface: "_Surface", xy: Array, footprint: Image) -> None:
        """Noise of all octaves: tone by all of them, slope by those finer than the terrain."""
        for octave in range(round(np.log2(COARSEST / FINEST)) + 1):
            cell = FINEST * 2**octave
            # A cell is half a wave: the mean over one cell leaves half of it, over one and a half little.
            weight = np.clip(1.5 - footprint / np.float32(cell), 0, 1)
            seen = np.flatnonzero(weight)
            value, along_x, along_y = weight[seen] * value_noise(xy[seen], cell, self.salt + octave)
            surface.tone[seen] += np.float32(self.look.contrast) * value
            if cell <= TERRAIN_TAKES_OVER:
                surface.slope_x[seen] += np.float32(self.look.roughness) * along_x
                surface.slope_y[seen] += np.float32(self.look.roughness) * along_y
        np.maximum(surface.tone, 0.3, out=surface.tone)

    def _add_stones(self, surface: "_Surface", xy: Array, footprint: Image, sun: Sun, layer: int) -> None:
        """At most one stone in each cell: a dome and its shadow."""
        cell, share = self.look.stones[layer]
        salt = self.salt + 40 + 10 * layer
        chosen = np.flatnonzero(footprint < 0.2 * cell)
        lattice = Lattice.of(xy[chosen], cell, salt)
        there = lattice.hashed(salt) < share
        chosen, lattice = chosen[there], lattice.only(there)
        x, y, size, tone = (lattice.hashed(salt + k) for k in range(1, 5))
        radius = 0.08 + 0.12 * size**2  # in cells; most are small
        # At this distance from the borders stone and shadow are within the cell, so neighbours need no check.
        room = 1 - 2 * STONE_REACH * radius
        dx, dy = (w - 0.5 - room * (at - 0.5) for w, at in ((lattice.u, x), (lattice.v, y)))
        rho = np.hypot(dx, dy) / radius
        fade = np.clip(2 - 2 * footprint[chosen] / (radius * np.float32(cell)), 0, 1)
        on = fade * np.clip((1 - rho) * 8, 0, 1)
        mean, deviation = self.look.stone_tone
        surface.tone[chosen] *= 1 + on * (mean - 1 + deviation * UNIFORM * (tone - 0.5))
        steepness = -on * STONE_HEIGHT / np.sqrt(1.1 - np.minimum(rho, 1) ** 2) / radius
        slope_x, slope_y = lattice.to_world(steepness * dx, steepness * dy)
        surface.slope_x[chosen] += slope_x
        surface.slope_y[chosen] += slope_y
        shadow = lattice.from_world(-sun.direction[:2] / sun.direction[2])
        surface.lit[chosen] *= 1 - (fade - on) * _in_shadow(dx / radius, dy / radius, shadow)


def _in_shadow(dx: Image, dy: Image, shadow: Array) -> Image:
    """Darkness at points around a dome of radius 1, given the shadow of a pole of height 1."""
    length = float(np.hypot(*shadow))
    x, y = shadow / length
    along = np.clip(dx * x + dy * y, 0, min(STONE_HEIGHT * length, STONE_REACH - 1))
    return np.clip((1 - np.hypot(dx - along * x, dy - along * y)) * 8, 0, 1)


def ground_of(terrain: Terrain, world: str, seed: int) -> Ground:
    """The ground of a simulated world: the same terrain, world and seed always look the same."""
    slopes = np.gradient(terrain.height, terrain.resolution)[::-1]
    blur = FAR_BLUR / terrain.resolution
    smooth = [ndimage.gaussian_filter(slope, blur, mode="nearest") for slope in slopes]
    slopes_mean = [slope.mean() for slope in slopes]
    # Rocks are what rises above its surroundings by more than the roughness of any world.
    level = ndimage.gaussian_filter(terrain.height, 0.2 / terrain.resolution, mode="nearest")
    rock = np.clip((terrain.height - level - 0.015) / 0.02, 0, 1)
    salt = int(stream(seed, 0).generate_state(1)[0])
    nodes = np.dstack([*slopes, *smooth, rock]).astype(np.float32)
    _set_border(nodes, [*slopes_mean, *slopes_mean, 0.0])
    return Ground(terrain, LOOKS[world], nodes, salt)


def _set_border(nodes: Image, value: ArrayLike) -> None:
    """Make the border plain: everything beyond the terrain looks like it."""
    nodes[[0, -1]] = value
    nodes[:, [0, -1]] = value


@dataclass(frozen=True, eq=False)
class _Surface:
    """Tone, slope and share of the sunlight (N,) of some points; layers of detail are added in place."""

    tone: Image
    slope_x: Image
    slope_y: Image
    lit: Image

    def sunlight(self, sun: Sun) -> Image:
        """Sunlight received: that of a surface which faces the sun is 1."""
        x, y, z = sun.direction.astype(np.float32)
        facing = np.maximum(z - x * self.slope_x - y * self.slope_y, 0)
        return np.asarray(self.lit * facing / np.sqrt(1 + self.slope_x**2 + self.slope_y**2))


def _at_nodes(layers: Image, terrain: Terrain, xy: Array) -> Image:
    """Bilinear values (N, layers) of images (rows, columns, layers) over the terrain's nodes."""
    columns, nodes = layers.shape[1], layers.reshape(-1, layers.shape[2])
    corner, x, y = terrain.cell_at(xy)
    u, v = x.astype(np.float32)[:, None], y.astype(np.float32)[:, None]
    lower = nodes[corner] * (1 - u) + nodes[corner + 1] * u
    upper = nodes[corner + columns] * (1 - u) + nodes[corner + columns + 1] * u
    return np.asarray(lower * (1 - v) + upper * v)
