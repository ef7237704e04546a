"""The worlds: what each is made of. A function has the name of its world (`names.WORLDS`).

Every function draws a height field in metres on the nodes of a grid.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terrainloop.simulation import relief
from terrainloop.simulation.relief import Grid

Array = NDArray[np.float64]


def etna(rng: Generator, grid: Grid) -> Array:
    """Cinder slopes: 4-8 deg, metre-scale undulation, fine roughness, few rocks."""
    azimuth, steepness = rng.uniform(0, 2 * np.pi), np.tan(np.radians(rng.uniform(4, 8)))
    x = np.arange(grid.size) * grid.resolution
    slope: Array = steepness * (np.cos(azimuth) * x + np.sin(azimuth) * x[:, None])
    undulation = relief.power_law(rng, grid, rms=0.09, outer_scale=9.0, exponent=4.2)
    cinder = relief.power_law(rng, grid, rms=0.006, outer_scale=0.5, exponent=3.0)
    return slope + undulation + cinder + relief.rocks(rng, grid, abundance=0.012, limits=(0.08, 0.8))


def morocco(rng: Generator, grid: Grid) -> Array:
    """A pebble plain: hardly any relief, many small stones, shallow channels."""
    undulation = relief.power_law(rng, grid, rms=0.025, outer_scale=8.0, exponent=4.2)
    gravel = relief.power_law(rng, grid, rms=0.004, outer_scale=0.3, exponent=2.6)
    channel = relief.channels(rng, grid, depth=0.06, width=1.2)
    return undulation + gravel + channel + relief.rocks(rng, grid, abundance=0.03, limits=(0.06, 0.4))


def mars(rng: Generator, grid: Grid) -> Array:
    """Wind ripples with defects, rocks, a few craters."""
    undulation = relief.power_law(rng, grid, rms=0.07, outer_scale=12.0, exponent=4.2)
    sand = relief.power_law(rng, grid, rms=0.004, outer_scale=0.3, exponent=3.0)
    cover = 0.5 + 0.5 * np.tanh(relief.power_law(rng, grid, rms=1.0, outer_scale=8.0, exponent=5.0) + 0.6)
    waves = cover * relief.ripples(rng, grid, height=0.08, wavelength=1.5)
    holes = relief.craters(rng, grid, per_area=0.003, diameters=(1.5, 8.0))
    return undulation + sand + waves + holes + relief.rocks(rng, grid, abundance=0.02, limits=(0.08, 0.8))


def flat(rng: Generator, grid: Grid) -> Array:
    """A playa: millimetres of roughness, less than any of the sensors resolves."""
    return relief.power_law(rng, grid, rms=0.002, outer_scale=0.5, exponent=2.6)


def ripples(rng: Generator, grid: Grid) -> Array:
    """Nothing but wind ripples: ground that repeats itself."""
    sand = relief.power_law(rng, grid, rms=0.004, outer_scale=0.3, exponent=3.0)
    return sand + relief.ripples(rng, grid, height=0.10, wavelength=1.5)


# Ground on which unrelated places look alike: few things on smooth ground, and things that repeat.


def _smooth(rng: Generator, grid: Grid) -> Array:
    """Ground that undulates by centimetres over metres and is smooth below."""
    return relief.power_law(rng, grid, rms=0.03, outer_scale=8.0, exponent=4.0)


def craters(rng: Generator, grid: Grid) -> Array:
    """Craters of any size on smooth ground, about three within 10 m."""
    return _smooth(rng, grid) + relief.craters(rng, grid, per_area=0.03, diameters=(1.6, 4.0))


def sparse_rocks(rng: Generator, grid: Grid) -> Array:
    """A few rocks of any size, shape and place on smooth ground."""
    return _smooth(rng, grid) + relief.rocks(rng, grid, abundance=0.045, limits=(0.3, 1.0))


def boulders(rng: Generator, grid: Grid) -> Array:
    """A few boulders of one size, anywhere on smooth ground."""
    centres = relief.scattered(rng, grid, per_area=0.05)
    return _smooth(rng, grid) + relief.equal_rocks(grid, centres, diameter=0.7)


def equal_rocks(rng: Generator, grid: Grid) -> Array:
    """Equal rocks on smooth ground, always three in the same triangle."""
    triangle = np.array([[-0.9, -0.5], [0.9, -0.5], [0.4, 0.9]])
    centres = relief.copies(rng, grid, pattern=triangle, spacing=8.0)
    return _smooth(rng, grid) + relief.equal_rocks(grid, centres, diameter=0.7)


def lattice(rng: Generator, grid: Grid) -> Array:
    """Equal mounds on a square lattice: every place repeats at every mound."""
    return _smooth(rng, grid) + relief.mounds(rng, grid, height=0.08, spacing=1.1, radius=0.17)


def ruts(rng: Generator, grid: Grid) -> Array:
    """Wheel ruts of one turning radius on smooth ground."""
    return _smooth(rng, grid) + relief.ruts(rng, grid, turning_radius=5.0, gauge=1.0, depth=0.06)


def polygons(rng: Generator, grid: Grid) -> Array:
    """Patterned ground: polygons of similar size between shallow troughs."""
    return _smooth(rng, grid) + relief.polygons(rng, grid, diameter=2.5, depth=0.08, width=0.25)


def terraces(rng: Generator, grid: Grid) -> Array:
    """A flight of equal steps: every place repeats at every step, and slides along it."""
    return flat(rng, grid) + relief.terraces(rng, grid, riser=0.12, tread=1.2)


def built(rng: Generator, grid: Grid) -> Array:
    """A paved site with kerbs, walls and boxes: nothing but straight, parallel edges."""
    return flat(rng, grid) + relief.boxes(rng, grid, per_area=0.05, sides=(0.3, 5.0))


def symmetric(rng: Generator, grid: Grid) -> Array:
    """One figure on bare ground, such that more than one pose fits: mounds in a circle, walls or rings."""
    return flat(rng, grid) + relief.symmetric_figure(rng, grid, height=0.15)
