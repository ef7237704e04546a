import itertools

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.simulation.names import WORLDS
from terrainloop.simulation.relief import Grid, craters, power_law, ripples, rock_diameters, rocks
from terrainloop.simulation.terrain import CEILING_PIXELS, Terrain, make_terrain


@pytest.mark.parametrize("world", WORLDS)
def test_same_seed_same_terrain_and_another_seed_another(world):
    first, again, other = (make_terrain(world, seed, 8.0, 0.05) for seed in (3, 3, 4))
    assert first.height.dtype == np.float32
    assert first.height.tobytes() == again.height.tobytes()
    assert not np.allclose(first.height, other.height, atol=1e-4)


@pytest.mark.parametrize("world", [world for world in WORLDS if world not in ("lattice", "terraces")])
def test_opposite_borders_do_not_agree(world):
    height = make_terrain(world, 1, 30.0, 0.1).height.astype(float)
    first, second, last = np.diff(height[:, [0, 1, -1]], axis=0).T
    assert np.corrcoef(first, second)[0, 1] > 0.25
    assert abs(np.corrcoef(first, last)[0, 1]) < 0.2


def test_worlds_have_the_relief_they_are_named_for():
    rough = {w: np.std(np.diff(make_terrain(w, 2, 30.0, 0.05).height, axis=1)) / 0.05 for w in WORLDS[:4]}
    assert rough["flat"] < 0.05 < min(rough["etna"], rough["morocco"], rough["mars"])
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 601)])
    height = make_terrain("etna", 2, 30.0, 0.05).height
    slope = np.hypot((height * x).mean() / (x**2).mean(), (height * y).mean() / (y**2).mean()) / 15.0
    assert 3 < np.degrees(np.arctan(slope)) < 9


def test_height_is_bilinear():
    height = np.arange(12, dtype=np.float32).reshape(3, 4) ** 2
    terrain = Terrain(height, 0.5, (10.0, -1.0))
    np.testing.assert_allclose(terrain.height_at([[10.0, -1.0], [11.5, 0.0]]), [0.0, 121.0])
    corners = height[1, 2], height[1, 3], height[2, 2], height[2, 3]
    expected = np.dot(corners, [0.75 * 0.6, 0.25 * 0.6, 0.75 * 0.4, 0.25 * 0.4])
    assert terrain.height_at([11.125, -0.3]) == pytest.approx(expected)
    assert terrain.height_at([99.0, 99.0]) == 121.0


def test_slope_is_that_of_a_plane():
    x, y = np.meshgrid(np.arange(20), np.arange(30))
    terrain = Terrain((0.02 * x - 0.03 * y).astype(np.float32), 0.1, (0.0, 0.0))
    np.testing.assert_allclose(terrain.slope_at([[0.73, 1.21]]), [[0.2, -0.3]], atol=1e-5)


def test_ceiling_is_the_greatest_height_around():
    terrain = make_terrain("morocco", 0, 6.0, 0.1)
    row, column = 25, 31
    around = terrain.height[
        row - CEILING_PIXELS : row + CEILING_PIXELS + 1, column - CEILING_PIXELS : column + CEILING_PIXELS + 1
    ]
    assert terrain.ceiling[row, column] == around.max()


def test_power_law_has_the_spectrum_asked_for():
    field = power_law(np.random.default_rng(0), Grid(800, 0.05), rms=0.1, outer_scale=100.0, exponent=3.6)
    assert field.std() == pytest.approx(0.1)
    window = np.hanning(800)
    power = np.abs(np.fft.fft2(field * window * window[:, None])) ** 2
    k = np.fft.fftfreq(800, 0.05)
    k = np.hypot(k, k[:, None])
    edges = np.geomspace(0.5, 5.0, 9)
    density = [power[(k >= a) & (k < b)].mean() for a, b in itertools.pairwise(edges)]
    exponent, _ = np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])), np.log(density), 1)
    assert exponent == pytest.approx(-3.6, abs=0.25)


def test_ripples_repeat_at_about_their_wavelength():
    field = ripples(np.random.default_rng(5), Grid(600, 0.05), height=0.12, wavelength=1.5)
    k = np.fft.fftfreq(600, 0.05)
    k = np.hypot(k, k[:, None]).ravel()
    power = (np.abs(np.fft.fft2(field)) ** 2).ravel()
    assert 1 / k[np.argsort(power)[-50:]].mean() == pytest.approx(1.5, rel=0.15)
    assert 0.06 < np.ptp(field) < 0.16


def test_craters_are_hollows_with_a_rim():
    field = craters(np.random.default_rng(2), Grid(400, 0.1), per_area=0.003, diameters=(2.0, 6.0))
    assert -0.8 < field.min() < -0.1
    assert 0.02 < field.max() < 0.4


@pytest.mark.parametrize("abundance", [0.01, 0.05, 0.15])
def test_rocks_follow_golombek_and_rapp(abundance):
    area = 40_000.0
    diameters = rock_diameters(np.random.default_rng(0), abundance, area, (0.08, 2.0))
    q = 1.79 + 0.152 / abundance
    for d in (0.08, 0.12, 0.2, 0.3):
        areas = np.pi / 4 * diameters[diameters >= d] ** 2
        expected = abundance * (np.exp(-q * d) - np.exp(-q * 2.0))
        chance = np.sqrt((areas**2).sum())  # standard deviation of the area of a Poisson number of rocks
        assert areas.sum() == pytest.approx(area * expected, abs=4 * chance)
        assert chance < 0.3 * area * expected


def test_rocks_cover_about_their_share_and_stand_up():
    field = rocks(np.random.default_rng(0), Grid(1500, 0.02), abundance=0.1, limits=(0.1, 1.0))
    q = 1.79 + 0.152 / 0.1
    expected = 0.1 * (np.exp(-q * 0.1) - np.exp(-q * 1.0))
    assert (field > 0).mean() == pytest.approx(expected * 0.8, rel=0.2)  # mean slimness 0.8
    assert 0.1 < field.max() < 0.8


@pytest.mark.parametrize(
    ("world", "size", "resolution"),
    [("moon", 10.0, 0.1), ("etna", -1.0, 0.1), ("etna", 10.0, 0.0), ("etna", np.nan, 0.1)],
)
def test_bad_arguments_are_named(world, size, resolution):
    with pytest.raises(TerrainLoopError, match="expected"):
        make_terrain(world, 0, size, resolution)
