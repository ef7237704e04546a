"""Building blocks of a height field: noise, ripples, craters, channels, rocks, and shapes that repeat.

Functions of a grid return heights in metres on its nodes (rows = y, columns = x), unless stated otherwise.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial import KDTree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """A square grid of ``size`` x ``size`` nodes, ``resolution`` metres apart."""

    size: int
    resolution: float

    @property
    def extent(self) -> float:
        """Length of a side, in metres."""
        return (self.size - 1) * self.resolution


def power_law(rng: Generator, grid: Grid, *, rms: float, outer_scale: float, exponent: float) -> Array:
    """Isotropic Gaussian noise with power spectral density (k^2 + 1/outer_scale^2)^(-exponent/2).

    Below the outer scale (metres) the surface is self-affine with Hurst exponent (exponent - 2) / 2;
    above it the spectrum is level, so that the amplitude stays finite. ``rms`` is in metres.
    """
    k_squared = sum(k**2 for k in _wave_numbers(grid))
    amplitude = (k_squared + outer_scale**-2) ** (-exponent / 4)
    field = _filtered_noise(rng, grid, amplitude).real
    return np.asarray(rms * (field - field.mean()) / field.std())


def ripples(rng: Generator, grid: Grid, *, height: float, wavelength: float) -> Array:
    """Wind ripples: crest to trough about ``height``, crests about ``wavelength`` apart.

    Noise within a narrow band of wave vectors has a phase that runs from crest to crest and, where its
    amplitude vanishes, ends or forks a crest: the defects of real ripple fields.
    """
    kx, ky = _wave_numbers(grid)
    wind = rng.uniform(0, np.pi)
    along, across = kx * np.cos(wind) + ky * np.sin(wind), ky * np.cos(wind) - kx * np.sin(wind)
    distance = ((along * wavelength - 1) / 0.16) ** 2 + (across * wavelength / 0.28) ** 2
    wave = _filtered_noise(rng, grid, np.exp(-distance / 2))
    phase, strength = np.angle(wave), np.abs(wave) / np.abs(wave).mean()
    profile = np.cos(phase) + 0.25 * np.cos(2 * phase + 0.8)  # sharp crests, a steeper lee side
    return np.asarray(0.5 * height * np.tanh(strength) * profile)


def channels(rng: Generator, grid: Grid, *, depth: float, width: float) -> Array:
    """Shallow meandering channels: they follow the zero contours of smooth noise."""
    level = power_law(rng, grid, rms=1.0, outer_scale=12.0, exponent=6.0)
    slope = np.hypot(*np.gradient(level, grid.resolution))
    return np.asarray(-depth * np.exp(-0.5 * (level / (slope + 0.02) / (0.5 * width)) ** 2))


def craters(rng: Generator, grid: Grid, *, per_area: float, diameters: tuple[float, float]) -> Array:
    """Degraded impact craters, depth about a tenth of the diameter, numbers falling as 1 / D^2.

    Within the rim d ((r/R)^2 - 1); the raised rim decays over a third of the radius.
    """
    heights = np.zeros((grid.size, grid.size))
    smallest, largest = diameters
    for _ in range(rng.poisson(per_area * grid.extent**2)):
        share = rng.uniform()
        radius = 0.5 / np.sqrt((1 - share) / smallest**2 + share / largest**2)
        depth = 2 * radius * rng.uniform(0.06, 0.12)
        window, dx, dy = _around(grid, rng.uniform(0, grid.extent, 2), 2 * radius)
        rho = np.hypot(dx, dy) / radius
        bowl = depth * (np.minimum(rho, 1) ** 2 - 1)
        rim = 0.3 * depth * np.exp(-(((rho - 1) / 0.3) ** 2))
        heights[window] += bowl + rim
    return heights


def rock_diameters(rng: Generator, abundance: float, area: float, limits: tuple[float, float]) -> Array:
    """Diameters of the rocks on an area, by the exponential law of Golombek & Rapp (1997).

    The fraction of ground covered by rocks of diameter D or more is k exp(-q(k) D) with
    q(k) = 1.79 + 0.152 / k (Golombek & Rapp, Size-frequency distributions of rocks on Mars and Earth
    analog sites, J. Geophys. Res. 102 E2, 1997). The density of rocks per metre of diameter follows by
    dividing the covered area by that of one rock: 4 k q exp(-q D) / (pi D^2).

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the sample.
    abundance : float
        k, the fraction of ground that rocks of any size cover.
    area : float
        Ground to furnish, in square metres.
    limits : (float, float)
        Smallest and largest diameter, in metres.

    Returns
    -------
    array, (N,)
        Diameters in metres.
    """
    diameter = np.geomspace(*limits, 2000)
    q = 1.79 + 0.152 / abundance
    density = 4 * abundance * q * np.exp(-q * diameter) / (np.pi * diameter**2)
    steps = 0.5 * (density[1:] + density[:-1]) * np.diff(diameter)
    cumulative = np.concatenate([[0.0], np.cumsum(steps)])
    count = rng.poisson(area * cumulative[-1])
    return np.asarray(np.interp(rng.uniform(0, cumulative[-1], count), cumulative, diameter))


def rocks(rng: Generator, grid: Grid, *, abundance: float, limits: tuple[float, float]) -> Array:
    """Height of the rocks above the ground, their diameters drawn by `rock_diameters`."""
    heights = np.zeros((grid.size, grid.size))
    diameters = rock_diameters(rng, abundance, grid.extent**2, limits)
    reach = np.ceil(0.65 * diameters / grid.resolution).astype(int)  # outlines bulge by at most 30 %
    for half_width in np.unique(reach):
        _add_rocks(rng, heights, diameters[reach == half_width] / grid.resolution, half_width)
    return heights * grid.resolution


def _add_rocks(rng: Generator, heights: Array, diameters: Array, half_width: int) -> None:
    """Raise ``heights`` to half-buried, rotated, lopsided ellipsoids; all lengths in pixels."""
    n = len(diameters)
    centre = rng.uniform(0, len(heights) - 1, (2, n, 1, 1))
    turn, skew_2, skew_3 = rng.uniform(0, 2 * np.pi, (3, n, 1, 1))
    slimness, flatness = rng.uniform(0.6, 1.0, (n, 1, 1)), rng.uniform(0.5, 1.1, (n, 1, 1))
    bluntness, tilt = rng.uniform(2.0, 4.0, (n, 1, 1)), rng.uniform(0.0, 0.35, (n, 1, 1))
    radius = 0.5 * diameters[:, None, None]
    span = np.arange(-half_width, half_width + 1)
    column, row = np.rint(centre[0]) + span, np.rint(centre[1]) + span[:, None]
    dx, dy = column - centre[0], row - centre[1]
    along = (dx * np.cos(turn) + dy * np.sin(turn)) / radius
    across = (dy * np.cos(turn) - dx * np.sin(turn)) / (radius * slimness)
    angle = np.arctan2(across, along)
    outline = 1 + 0.12 * np.cos(2 * angle + skew_2) + 0.1 * np.cos(3 * angle + skew_3)
    rho = np.minimum(np.hypot(along, across) / outline, 1)
    bump = radius * slimness * flatness * np.sqrt(1 - rho**bluntness) * (1 + tilt * along)
    row, column = np.broadcast_arrays(row.astype(int), column.astype(int))
    inside = (bump > 0) & (row >= 0) & (row < len(heights)) & (column >= 0) & (column < len(heights))
    np.maximum.at(heights, (row[inside], column[inside]), bump[inside])


def scattered(rng: Generator, grid: Grid, *, per_area: float) -> Array:
    """Points (N, 2) of a Poisson process with so many per square metre, metres from node (0, 0)."""
    return rng.uniform(0, grid.extent, (rng.poisson(per_area * grid.extent**2), 2))


def copies(rng: Generator, grid: Grid, *, pattern: Array, spacing: float) -> Array:
    """Points (N, 2) of copies of a pattern (K, 2), each rotated at random, metres from node (0, 0).

    There is one copy in each square cell of side ``spacing``, anywhere in the middle half of the cell.
    """
    cells = np.arange(int(np.ceil(grid.extent / spacing)) + 1)
    corners = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2) - rng.uniform(0, 1, 2)
    centres = spacing * (corners + rng.uniform(0.25, 0.75, corners.shape))
    heading = rng.uniform(0, 2 * np.pi, len(centres))
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = pattern.T
    rotated = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return np.asarray((centres[:, None] + rotated).reshape(-1, 2))


def equal_rocks(grid: Grid, centres: Array, *, diameter: float) -> Array:
    """Half-buried rocks of one size and shape, hemispheres flattened to 0.8, at centres (N, 2)."""
    heights, radius = np.zeros((grid.size, grid.size)), 0.5 * diameter
    for centre in centres:
        window, dx, dy = _around(grid, centre, radius)
        dome = 0.8 * np.sqrt(np.clip(radius**2 - dx**2 - dy**2, 0, None))
        heights[window] = np.maximum(heights[window], dome)
    return heights


def mounds(rng: Generator, grid: Grid, *, height: float, spacing: float, radius: float) -> Array:
    """Equal Gaussian mounds (standard deviation ``radius``) on the nodes of a square lattice."""
    u, v = _rotated(rng, grid)
    du, dv = _from_nearest(u, spacing), _from_nearest(v, spacing)
    return np.asarray(height * np.exp(-(du**2 + dv**2) / (2 * radius**2)))


def ruts(rng: Generator, grid: Grid, *, turning_radius: float, gauge: float, depth: float) -> Array:
    """Wheel ruts of vehicles that always steer at the same angle, to the left and right in turn.

    At a constant steering angle a vehicle drives along a circle (Wong, Theory of Ground Vehicles, ch. 5).
    Each track is a chain of half-circles; tracks run side by side without crossing. A wheel leaves a trough
    as wide as a sixth of the gauge between berms of the soil it displaced.
    """
    u, v = _rotated(rng, grid)
    track_spacing = 2 * (turning_radius + gauge)
    track = np.rint(v / track_spacing).astype(int)
    start = rng.uniform(0, 4 * turning_radius, np.ptp(track) + 1)[track - track.min()]
    v = v - track * track_spacing
    along = _from_nearest(u + start + 2 * turning_radius * (v < 0), 4 * turning_radius)
    from_wheel = np.abs(np.abs(np.hypot(along, v) - turning_radius) - 0.5 * gauge) / (gauge / 12)
    berms = 0.4 * np.exp(-0.5 * ((from_wheel - 2.2) / 0.7) ** 2)
    return np.asarray(depth * (berms - np.exp(-0.5 * from_wheel**4)))


def polygons(rng: Generator, grid: Grid, *, diameter: float, depth: float, width: float) -> Array:
    """Patterned ground: troughs over thermal-contraction cracks that divide it into polygons.

    Cracks open where the tension of cooling ground is not yet relieved (Lachenbruch, Geol. Soc. Am. Special
    Paper 70, 1962); the polygons are modelled as Voronoi cells (Cresto Aleina et al., Earth Syst. Dynam. 4,
    2013), here of one point in each cell of a square lattice of side ``diameter``. Troughs have a Gaussian
    cross-section of standard deviation ``width`` / 2.
    """
    seeds = copies(rng, grid, pattern=np.zeros((1, 2)), spacing=diameter)
    x = np.arange(grid.size) * grid.resolution
    nodes = np.stack(np.meshgrid(x, x), axis=-1)
    distances, members = KDTree(seeds).query(nodes, k=2)
    between = np.linalg.norm(np.diff(seeds[members], axis=-2)[..., 0, :], axis=-1)
    from_crack = np.diff(distances**2)[..., 0] / (2 * between)
    return np.asarray(-depth * np.exp(-0.5 * (from_crack / (0.5 * width)) ** 2))


def terraces(rng: Generator, grid: Grid, *, riser: float, tread: float) -> Array:
    """Stairs: level treads between equal straight risers, each spread over a tenth of a tread."""
    u, _ = _rotated(rng, grid)
    stair = np.floor(u / tread)
    return np.asarray(riser * (stair + np.clip(10 * (u / tread - stair), 0, 1)))


def boxes(rng: Generator, grid: Grid, *, per_area: float, sides: tuple[float, float]) -> Array:
    """Blocks with level tops, straight edges and vertical sides, all parallel, as people build them.

    Their sides are log-uniform between two lengths (metres), so that kerbs and walls are among them; their
    heights are 1, 2 or 3 courses of 0.12 m.
    """
    u, v = _rotated(rng, grid)
    heights = np.zeros((grid.size, grid.size))
    for row, column in rng.integers(0, grid.size, (rng.poisson(per_area * grid.extent**2), 2)):
        length, width = 0.5 * np.exp(rng.uniform(np.log(sides[0]), np.log(sides[1]), 2))
        inside = (np.abs(u - u[row, column]) < length) & (np.abs(v - v[row, column]) < width)
        heights[inside] = np.maximum(heights[inside], 0.12 * rng.integers(1, 4))
    return heights


def symmetric_figure(rng: Generator, grid: Grid, *, height: float) -> Array:
    """A figure in the middle of the grid that a rotation, or a shift, maps onto itself.

    It is one of: two to six equal mounds on a circle, one to three straight walls that cross at equal angles,
    concentric rings.
    """
    heading, offset = rng.uniform(0, np.pi), rng.uniform(-1, 1, 2)
    x = np.arange(grid.size) * grid.resolution - 0.5 * grid.extent
    z = (x - offset[0] + 1j * (x - offset[1])[:, None]) * np.exp(1j * heading)
    kind, order = rng.integers(3), rng.integers(2, 7)
    if kind == 0:
        nodes = 1.3 * np.exp(2j * np.pi * np.arange(order) / order)
        figure = sum(np.exp(-0.5 * (np.abs(z - node) / 0.25) ** 2) for node in nodes)
    elif kind == 1:
        walls = np.exp(1j * np.pi * np.arange(order // 2) / (order // 2))
        figure = np.max([np.exp(-0.5 * ((z * wall).imag / 0.2) ** 2) for wall in walls], axis=0)
    else:
        figure = np.cos(2 * np.pi * np.abs(z) / 1.2) * np.exp(-((np.abs(z) / 3) ** 4))
    return np.asarray(height * figure)


def _around(grid: Grid, centre: Array, reach: float) -> tuple[tuple[slice, slice], Array, Array]:
    """The nodes within ``reach`` of a centre along x and y, and their offsets from it along x and along y."""
    x = np.arange(grid.size) * grid.resolution
    columns, rows = (slice(*np.searchsorted(x, [c - reach, c + reach])) for c in centre)
    return (rows, columns), x[columns] - centre[0], (x[rows] - centre[1])[:, None]


def _rotated(rng: Generator, grid: Grid) -> tuple[Array, Array]:
    """Coordinates of the nodes in a frame with a random heading and a random origin on the grid."""
    heading, (x0, y0) = rng.uniform(0, 2 * np.pi), rng.uniform(0, grid.extent, 2)
    x = np.arange(grid.size) * grid.resolution
    dx, dy = x - x0, (x - y0)[:, None]
    return np.cos(heading) * dx + np.sin(heading) * dy, np.cos(heading) * dy - np.sin(heading) * dx


def _from_nearest(values: Array, period: float) -> Array:
    """Signed distance from the nearest multiple of a period."""
    return np.asarray(values - period * np.rint(values / period))


def _padded(grid: Grid) -> int:
    # An FFT field is periodic; cropping a larger one keeps opposite borders from agreeing.
    return fft.next_fast_len(int(1.25 * grid.size) + 1)


def _wave_numbers(grid: Grid) -> tuple[Array, Array]:
    """Cycles per metre along x and y of the padded grid, in FFT order."""
    k = fft.fftfreq(_padded(grid), grid.resolution)
    return k, k[:, None]


def _filtered_noise(rng: Generator, grid: Grid, amplitude: Array) -> NDArray[np.complex128]:
    """White complex noise through a filter given over the padded wave numbers, cropped to the grid."""
    shape = amplitude.shape
    spectrum = amplitude * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    return fft.ifft2(spectrum)[: grid.size, : grid.size]
