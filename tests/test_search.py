"""The exhaustive search, against a loop over all poses in double precision and terrain of known truth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import with_pixels
from scipy.ndimage import map_coordinates

from terrainloop import _core
from terrainloop.config import Calibration, Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import inverse, se2, transform, yaw_of
from terrainloop.matching import search as searching
from terrainloop.matching.overlay import agreement_at
from terrainloop.matching.query import FFT_SIZES, Query, rotate, search_grid
from terrainloop.matching.register import compare, compare_many
from terrainloop.record import SubmapRecord

CALIBRATION = Calibration()
MIN_AREA = CALIBRATION.min_shared_area
ABOUT = se2(-0.8, -1.3, 0.0)  # the middle of the tiny maps
BIG = {"origin": (-4.0, -4.0), "shape": (100, 100)}


def entry(gradient_map, name="submap"):
    return MapEntry.of(SubmapRecord(name), gradient_map, Settings())


def query_of(source, target, settings):
    grid = search_grid(source, target, settings)
    return Query.of(source, grid, rotate(source.field_at(grid.spacing, settings), settings.calibration))


def search(source, target, count):
    """The `count` best places of one entry in another."""
    settings = Settings.model_validate({"calibration": {"candidates": count}})
    query = query_of(source, target, settings)
    return searching.search(query, target.field_at(query.grid.spacing, settings), settings.calibration)


def same_place(T, other, source):
    return searching.same_place(T, other, source.field, CALIBRATION)


def of_scale(gradient_map, length_scale):
    return replace(gradient_map, parameters=replace(gradient_map.parameters, length_scale=length_scale))


def misplaced(T, true, source):
    """By how much a pose errs at the middle of the source, metres, and in yaw, radians."""
    offset = transform(T, source.field.centre) - transform(true, source.field.centre)
    return np.hypot(*offset), abs(yaw_of(inverse(true) @ T))


def assert_found(places, true, source):
    """Within the search's own grid: a pixel, and half a turn to the next rotation."""
    apart, turned = misplaced(places[0], true, source)
    assert apart < source.field.spacing
    assert turned < 1.6 * source.field.spacing / source.field.radius


# --- against the naive loop


def naive(source, target, rotations):
    """Mean of r^2 times shared ground for each rotation, poses tried, and the most surprising pose."""
    f, g = target.field, source.field
    rows, columns = f.valid.shape
    null, tried, best = np.full(rotations, np.nan), 0.0, (-1.0, None)
    pixels = (source.field.length_scale / source.field.spacing) ** 2
    reach = 2 * max(g.valid.shape)
    for k in range(rotations):
        turn = se2(0.0, 0.0, 2 * np.pi * k / rotations)
        turn[:2, 2] = reach  # all of the source, turned about its pixel (0, 0), in the middle of a canvas
        at = np.stack(np.meshgrid(np.arange(2.0 * reach), np.arange(2.0 * reach)), -1)
        x, y = np.moveaxis(transform(inverse(turn), at), -1, 0)
        gx, gy, m = (map_coordinates(i.astype(float), [y, x], order=o) for i, o in
                     ((g.x, 3), (g.y, 3), (g.valid, 1)))  # fmt: skip
        m = (m > 0.5).astype(float)
        field = turn[:2, :2] @ (m * np.stack([gx, gy])).reshape(2, -1)
        padded = np.pad(
            np.stack([*field.reshape(2, *m.shape), m]), ((0, 0), (rows, rows), (columns, columns))
        )
        energy = f.x.astype(float) ** 2 + f.y.astype(float) ** 2
        evidence, shares = [], []
        for row in range(padded.shape[1] - rows + 1):
            for column in range(padded.shape[2] - columns + 1):
                u, v, known = padded[:, row : row + rows, column : column + columns]
                shared = (known * f.valid).sum()
                if shared <= MIN_AREA * pixels:
                    continue
                r = (u * f.x + v * f.y).sum() / np.sqrt(
                    (energy * known).sum() * ((u**2 + v**2) * f.valid).sum()
                )
                shift = se2(columns - column, rows - row, 0.0)  # of the canvas, to the target's pixels
                evidence.append((r, shared, shift @ turn))
                shares.append(r**2 * shared)
        if not shares:
            continue
        null[k], tried = np.mean(shares), tried + len(shares) / pixels
        for r, shared, T in evidence:
            surprise = -0.5 * (shared / null[k] - 1) * np.log(1 - r**2)
            if r > 0 and surprise > best[0]:
                best = (surprise, f.metres_from_pixels @ T @ np.linalg.inv(g.metres_from_pixels))
    return null * source.field.spacing**2, tried, best[1]


@pytest.mark.parametrize("ground", ["same", "other", "half flat"])
def test_search_is_the_naive_loop(world, ground):
    """But for pixels of the border, which a turn about another point takes in or leaves out."""
    T = ABOUT @ se2(0.2, -0.1, 2.0) @ inverse(ABOUT)
    source, target = world(3 if ground == "other" else 0).map(T, shape=(30, 30)), world(0).map(shape=(34, 28))
    if ground == "half flat":
        target = with_pixels(target, np.s_[:, :14], gradient_x=0.0, gradient_y=0.0)
    source, target = entry(source), entry(target)
    found = search(source, target, 4)
    null, tried, best = naive(source, target, len(found.null_area))
    ratio = found.null_area / null
    assert len(ratio) >= 12
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert ratio.min() > 0.75
    assert ratio.max() < 1.35
    turns = 2 * np.pi * source.field.radius / source.field.spacing  # that move the ground by a pixel
    assert found.tried == pytest.approx(tried * turns / len(null), rel=0.2)
    if ground != "other":  # there no place stands out
        assert_found([best], T, source)
        assert_found(found.poses, T, source)


def test_the_null_at_a_yaw_is_that_of_the_nearest_rotation(world):
    found = search(entry(world(0).map()), entry(world(3).map()), 1)
    count = len(found.null_area)
    assert len(set(found.null_area.tolist())) == count
    for k in (0, 1, count // 2, count - 1):
        for off in (-0.4, 0.0, 0.4):
            for turns in (-1, 0, 1):
                yaw = 2 * np.pi * ((k + off) / count + turns)
                assert found.null_area_at(yaw) == found.null_area[k]


# --- what it finds


@pytest.mark.parametrize(
    "T",
    [se2(0.4, -0.3, 0.7), se2(2.0, 0.5, 2.0), se2(0.0, 0.0, 0.0), se2(-0.7, 1.0, -1.2), se2(0.3, 0.0, np.pi)],
)
def test_the_true_pose_is_the_first_place(world, T):
    """Maps of other size and shape, either way round; the second shares less than a third."""
    source = entry(world(0).map(T, origin=(-1.5, -3.0), shape=(70, 40), resolution=0.09))
    target = entry(world(0).map(shape=(55, 64)))
    assert_found(search(source, target, 4).poses, T, source)
    assert_found(search(target, source, 4).poses, inverse(T), target)


def test_the_true_pose_of_utm_maps(world):
    T, moved = se2(0.4, -0.3, 0.7), se2(5e5, 4e6, 0.0)
    maps = world(0).map(T), world(0).map()
    source, target = (entry(m) for m in maps)
    far_source, far_target = (entry(replace(m, origin=(m.origin[0] + 5e5, m.origin[1] + 4e6))) for m in maps)
    near, far = search(source, target, 4), search(far_source, far_target, 4)
    assert_found(far.poses, moved @ T @ inverse(moved), far_source)
    np.testing.assert_allclose(far.null_area, near.null_area, rtol=0.05)


@pytest.mark.parametrize(("length_scale", "other"), [(0.4, 0.6), (0.6, 0.4), (0.3, 0.3), (0.8, 0.5)])
def test_resolutions_and_length_scales_may_differ(world, length_scale, other):
    T = se2(0.5, -0.8, 2.5)
    source = entry(of_scale(world(0).map(T, **BIG), length_scale))
    target = entry(of_scale(world(0).map(origin=(-4, -3.5), shape=(140, 150), resolution=0.05), other))
    apart, turned = misplaced(search(source, target, 4).poses[0], T, source)
    assert apart < max(source.field.spacing, target.field.spacing)
    assert turned < 1.6 * max(source.field.spacing, target.field.spacing) / source.field.radius


def test_a_large_map_is_searched_on_fewer_pixels(world):
    large = entry(of_scale(world(0).map(**BIG), 0.1))
    assert max(large.field.valid.shape) <= CALIBRATION.max_pixels + 1
    assert large.field.spacing > 0.1 / CALIBRATION.pixels_per_length_scale
    T = se2(0.4, 0.2, 2.0)
    source = entry(of_scale(world(0).map(T, **BIG), 0.1))
    assert_found(search(source, large, 1).poses, T, source)


def test_the_middle_and_the_radius_are_those_of_the_known_ground(world):
    """Known is a square of 2.4 m: radius the root of a sixth of its side."""
    gradient_map = world(0).map()
    mask = np.zeros(gradient_map.mask.shape, bool)
    mask[10:40, 15:45] = True
    known = entry(replace(gradient_map, mask=mask))
    middle = np.array(gradient_map.origin) + 0.08 * np.array([29.5, 24.5])
    np.testing.assert_allclose(known.field.centre, middle, rtol=0, atol=0.06)
    assert known.field.radius == pytest.approx(2.4 / np.sqrt(6), rel=0.1)


def test_places_differ_and_the_best_comes_first(world):
    source, target = entry(world(0).map()), entry(world(3).map())
    found = search(source, target, 12)
    assert len(found.poses) == 12
    for i, T in enumerate(found.poses):
        assert not any(same_place(T, other, source) for other in found.poses[:i])
        np.testing.assert_allclose(T @ inverse(T), np.eye(3), rtol=0, atol=1e-9)
    few = search(source, target, 3)
    np.testing.assert_array_equal(few.poses, found.poses[:3])
    fields = source.field, target.field
    agreements = [agreement_at(*fields, T) for T in found.poses]
    samples = [a.area / found.null_area_at(yaw_of(T)) for a, T in zip(agreements, found.poses, strict=True)]
    surprises = [
        -0.5 * (n - 1) * np.log(1 - a.correlation**2) for a, n in zip(agreements, samples, strict=True)
    ]
    assert min(a.correlation for a in agreements) > 0
    assert np.corrcoef(surprises, np.arange(12))[0, 1] < -0.5  # off the search's pixels a little changes
    assert max(surprises[:4]) > max(surprises[4:])


def test_same_place_is_measured_where_the_ground_is(world):
    """A turn about a far origin moves the ground; one about its own middle does not."""
    source = entry(replace(world(0).map(), origin=(5e5, 4e6)))
    middle = se2(*source.field.centre, 0.0)
    apart = 1.5 * source.field.length_scale
    turned = apart / source.field.radius

    def same(move):
        return same_place(middle @ move @ inverse(middle), np.eye(3), source)

    assert same(se2(0.9 * apart, 0.0, 0.0))
    assert same(se2(0.0, 0.0, 0.9 * turned))
    assert same(se2(0.0, 0.0, -0.9 * turned))
    assert not same(se2(0.0, 1.1 * apart, 0.0))
    assert not same(se2(0.0, 0.0, 1.1 * turned))
    assert not same(se2(0.0, 0.0, np.pi))
    assert not same_place(se2(0.0, 0.0, 0.9 * turned), np.eye(3), source)


# --- nothing to find


def unknown(gradient_map):
    return replace(gradient_map, mask=np.zeros_like(gradient_map.mask))


def test_where_nothing_is_known_there_is_no_place(world):
    nothing, something = entry(unknown(world(0).map())), entry(world(0).map())
    for source, target in ((nothing, something), (something, nothing), (nothing, nothing)):
        found = search(source, target, 4)
        assert found.poses == []
        assert found.tried == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (8, 8), (18, 18)])
def test_maps_too_small_to_share_enough_have_no_place(world, shape):
    """Twenty squared length scales are 3.2 m^2."""
    small, large = entry(world(0).map(shape=shape)), entry(world(0).map())
    for source, target in ((small, large), (large, small), (small, small)):
        found = search(source, target, 4)
        assert found.poses == []
        assert found.tried == 0
        assert np.isnan(found.null_area).all()


def test_flat_ground_has_no_place(world):
    flat = world(0).map()
    flat = entry(replace(flat, gradient_x=0 * flat.gradient_x, gradient_y=0 * flat.gradient_y))
    for source, target in (
        (flat, entry(world(0).map())),
        (entry(world(0).map()), flat),
        (flat, flat),
    ):
        assert search(source, target, 4).poses == []


# --- the same again


def same_search(a, b):
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.null_area, b.null_area)
    assert a.tried == b.tried
    return True


def test_search_gives_the_same_again_in_any_order(world):
    maps = [world(seed).map() for seed in range(3)]
    first = [search(entry(maps[0]), entry(m), 4) for m in maps]
    source, targets = entry(maps[0]), [entry(m) for m in maps]
    again = [search(source, t, 4) for t in targets[::-1]][::-1]
    assert all(map(same_search, first, again))


@pytest.mark.parametrize("workers", [1, 4])
def test_many_are_compared_as_one_by_one(world, workers):
    """Targets of one and of several search grids, in any order."""
    shapes = [(60, 50), (60, 50), (40, 70), (60, 50), (90, 40), (40, 70), (200, 60)]
    targets = [entry(world(seed % 3).map(shape=s), f"t{seed}") for seed, s in enumerate(shapes)]
    source = entry(world(0).map(), "source")
    assert len({search_grid(source, target, Settings()) for target in targets}) > 2
    alone = [compare(source, target, Settings(), pairs=7) for target in targets]
    together = compare_many(source, targets, Settings(), pairs=7, workers=workers)
    for one, many in zip(alone, together, strict=True):
        assert (one.target, one.score, one.reason) == (many.target, many.score, many.reason)
        assert one.T_target_source.tobytes() == many.T_target_source.tobytes()
    assert compare_many(source, [], Settings()) == []


def test_sizes_are_few_and_what_the_core_takes():
    """Multiples of 4 without prime factors beyond 5, no more than a quarter apart, beyond any search."""
    for size in FFT_SIZES:
        rest = size
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        assert (rest, size % 4) == (1, 0)
    assert max(b / a for a, b in pairwise(FFT_SIZES)) <= 1.25
    longest = int(np.hypot(*[CALIBRATION.max_pixels + 1] * 2)) + 4  # the diagonal of the largest field
    assert FFT_SIZES[-1] > longest + CALIBRATION.max_pixels + 1


def test_rotated_fields_are_the_field_at_that_rotation(world):
    """Half of them are made by reversal."""
    field = entry(world(0).map()).field
    rotated = rotate(field, CALIBRATION)
    count = len(rotated.poses)
    assert count % _core.LANES == 0
    arc = 2 * np.pi * field.radius / field.spacing / count
    assert 0.5 < arc <= CALIBRATION.rotation_step
    for k in (0, 3, count // 2 + 3, count - 1):
        R = rotated.poses[k][:2, :2] * field.spacing
        assert np.arctan2(R[1, 0], R[0, 0]) % (2 * np.pi) == pytest.approx(2 * np.pi * k / count, abs=1e-9)
        at = np.rint(transform(rotated.poses[k], field.positions)).astype(int)
        vectors = rotated.vectors[k][:, at[:, 1], at[:, 0]]
        valid = field.valid > 0
        expected = R @ np.stack([field.x[valid], field.y[valid]])
        assert np.corrcoef(vectors.ravel(), expected.ravel())[0, 1] > 0.8
