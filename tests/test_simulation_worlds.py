"""Worlds on which unrelated places look alike: each has the property it is named for."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from terrainloop.simulation import relief
from terrainloop.simulation.names import WORLDS
from terrainloop.simulation.relief import Grid
from terrainloop.simulation.terrain import make_terrain

GRID = Grid(501, 0.05)


def _rng(seed=0):
    return np.random.default_rng(seed)


def _positions(heights, threshold):
    """Centroids (N, 2) in metres, areas (N,) and bounding slices of what is higher than a threshold."""
    labels, count = ndimage.label(heights > threshold)
    index = np.arange(1, count + 1)
    centres = np.array(ndimage.center_of_mass(labels > 0, labels, index))[:, ::-1] * GRID.resolution
    return centres, ndimage.sum_labels(labels > 0, labels, index) * GRID.resolution**2


def _inside(centres, margin):
    return ((centres > margin) & (centres < GRID.extent - margin)).all(axis=1)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("size", [1.0, 12.0])
def test_every_world_is_finite_at_any_size(world, size):
    height = make_terrain(world, 1, size, 0.05).height
    assert np.isfinite(height).all()
    assert 1e-3 < np.std(height) < 2.0


def test_craters_are_round_and_of_different_sizes():
    sizes, angle = [], np.linspace(0, 2 * np.pi, 40, endpoint=False)
    for seed in range(4):
        heights = relief.craters(_rng(seed), GRID, per_area=0.012, diameters=(1.6, 4.0))
        centres, areas = _positions(-heights, 0.02)
        apart = KDTree(centres).query(centres, k=2)[0][:, 1] > 4.5
        for (x, y), area in zip(centres[apart], areas[apart], strict=True):
            if _inside(np.array([[x, y]]), 2.0) and area > 0.5:
                at = np.stack([y + 0.5 * np.sin(angle), x + 0.5 * np.cos(angle)]) / GRID.resolution
                profile = ndimage.map_coordinates(heights, at, order=1)
                assert np.ptp(profile) < -0.25 * heights[round(y / 0.05), round(x / 0.05)]
                sizes.append(area)
    assert len(sizes) >= 8
    assert max(sizes) > 2 * min(sizes)


def test_sparse_rocks_are_few_and_different():
    heights = make_terrain("sparse_rocks", 3, GRID.extent, GRID.resolution).height
    narrow = ndimage.white_tophat(heights, 41)  # what is narrower than 2 m
    _, areas = _positions(narrow, 0.05)
    assert 0.01 < len(areas) / GRID.extent**2 < 0.15
    assert areas.std() > 0.3 * areas.mean()
    assert (narrow < 0.05).mean() > 0.95


def test_boulders_are_equal_and_anywhere():
    centres = relief.scattered(_rng(), GRID, per_area=0.05)
    heights = relief.equal_rocks(GRID, centres, diameter=0.7)
    alone = _inside(centres, 1.0) & (KDTree(centres).query(centres, k=2)[0][:, 1] > 1.0)
    found, areas = _positions(heights, 0.05)
    distance, nearest = KDTree(found).query(centres[alone])
    assert distance.max() < 0.03
    assert np.ptp(areas[nearest]) < 0.1 * areas[nearest].mean()
    assert heights.max() == pytest.approx(0.8 * 0.35, rel=0.02)
    assert len(centres) / GRID.extent**2 == pytest.approx(0.05, rel=0.5)


def test_equal_rocks_always_form_the_same_triangle():
    triangle = np.array([[-0.9, -0.5], [0.9, -0.5], [0.4, 0.9]])
    centres = relief.copies(_rng(1), GRID, pattern=triangle, spacing=8.0).reshape(-1, 3, 2)
    sides = np.linalg.norm(centres - np.roll(centres, 1, axis=1), axis=2)
    np.testing.assert_allclose(
        sides, np.broadcast_to(np.linalg.norm(triangle - np.roll(triangle, 1, 0), axis=1), sides.shape)
    )
    assert (np.linalg.det(np.diff(centres, axis=1)) > 0).all()  # none is a mirror image
    heading = np.arctan2(*(centres[:, 1] - centres[:, 0]).T)
    assert np.abs(np.exp(1j * heading).mean()) < 0.6
    middles = centres.mean(axis=1)
    assert _inside(middles, 0.0).sum() >= 9
    assert KDTree(middles).query(middles, k=2)[0][:, 1].min() > 3.5


@pytest.mark.parametrize("seed", range(3))
def test_a_lattice_repeats_at_its_spacing_in_two_directions(seed):
    heights = relief.mounds(_rng(seed), GRID, height=0.08, spacing=1.1, radius=0.17)
    peaks = np.argwhere(heights == ndimage.maximum_filter(heights, 9)) * GRID.resolution
    distance, member = KDTree(peaks).query(peaks[_inside(peaks, 2.0)], k=5)
    np.testing.assert_allclose(distance[:, 1:], 1.1, atol=0.08)
    step = peaks[member[:, 1]] - peaks[member[:, 0]]
    shift = np.rint(step[0] / GRID.resolution).astype(int)
    moved = np.roll(heights, shift, axis=(0, 1))[100:-100, 100:-100]
    assert np.corrcoef(moved.ravel(), heights[100:-100, 100:-100].ravel())[0, 1] > 0.9
    half = np.roll(heights, shift // 2, axis=(0, 1))[100:-100, 100:-100]
    assert np.corrcoef(half.ravel(), heights[100:-100, 100:-100].ravel())[0, 1] < 0.2


@pytest.mark.parametrize(("seed", "radius"), [(0, 5.0), (1, 5.0), (2, 3.5)])
def test_ruts_follow_circles_of_one_radius(seed, radius):
    grid = Grid(1001, 0.02)
    heights = relief.ruts(_rng(seed), grid, turning_radius=radius, gauge=1.0, depth=0.06)
    slope_y, slope_x = np.gradient(heights, grid.resolution)
    steep = np.hypot(slope_x, slope_y)
    along_x = np.gradient(slope_x / (steep + 1e-9), grid.resolution, axis=1)
    along_y = np.gradient(slope_y / (steep + 1e-9), grid.resolution, axis=0)
    curvature = np.abs(along_x + along_y)[steep > 0.5 * steep.max()]  # of the contour lines
    assert 1 / np.median(curvature) == pytest.approx(radius, rel=0.1)
    outer, inner = 1 / (radius + 0.75), 1 / (radius - 0.75)
    assert ((curvature > outer) & (curvature < inner)).mean() > 0.6


def test_polygons_are_cells_of_similar_size_between_troughs():
    heights = relief.polygons(_rng(), GRID, diameter=2.5, depth=0.08, width=0.25)
    centres, areas = _positions(heights, -0.01)
    areas = areas[_inside(centres, 2.5) & (areas > 0.1)]
    assert 40 < len(areas) < 90
    assert 0.4 * 2.5**2 < np.median(areas) < 2.5**2
    assert heights.min() == pytest.approx(-0.08, abs=0.002)
    assert heights.max() == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_terraces_rise_by_equal_steps(seed):
    heights = relief.terraces(_rng(seed), GRID, riser=0.12, tread=1.2)
    steps = heights / 0.12
    level = np.abs(steps - np.rint(steps)) < 1e-9
    assert level.mean() == pytest.approx(0.9, abs=0.03)
    counts = np.unique(np.rint(steps[level]), return_counts=True)[1]
    assert len(counts) >= np.floor(GRID.extent / 1.2)


def test_what_is_built_has_level_tops_and_straight_parallel_edges():
    heights = relief.boxes(_rng(4), GRID, per_area=0.05, sides=(0.3, 5.0))
    np.testing.assert_allclose(np.unique(heights), [0.0, 0.12, 0.24, 0.36])
    smooth = ndimage.gaussian_filter(heights, 2.0)
    slope_y, slope_x = np.gradient(smooth, GRID.resolution)
    steep = np.hypot(slope_x, slope_y) > 0.5
    heading = np.arctan2(slope_y, slope_x)[steep]
    assert np.abs(np.exp(4j * heading).mean()) > 0.6  # at right angles to one another


def test_a_symmetric_figure_is_mapped_onto_itself_by_a_turn_about_its_middle():
    orders = set()
    for seed in range(60):
        heights = relief.symmetric_figure(_rng(seed), GRID, height=0.15)
        assert 0.14 < heights.max() < 0.16
        middle = 250 + _rng(seed).uniform([0, -1, -1], [np.pi, 1, 1])[1:] / GRID.resolution  # as it is drawn
        orders.add(_order_of_symmetry(heights, middle[::-1]))
    assert orders == {2, 3, 4, 5, 6, np.inf}


def _order_of_symmetry(heights, middle):
    """How often a turn about a (row, column) maps a figure onto itself; infinite for rings."""
    angle, radius = np.meshgrid(np.arange(720) * np.pi / 360, np.linspace(0.2, 3.5, 60) / GRID.resolution)
    rows, columns = middle[0] + radius * np.sin(angle), middle[1] + radius * np.cos(angle)
    polar = ndimage.map_coordinates(heights, [rows, columns], order=1)
    harmonics = np.abs(np.fft.rfft(polar, axis=1)[:, 1:40]).sum(axis=0)
    if harmonics.max() < 0.05 * np.abs(polar).sum():
        return np.inf
    return 1 + int(np.flatnonzero(harmonics > 0.2 * harmonics.max())[0])
