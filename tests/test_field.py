"""The gradient field of a map and the agreement of two, against closed forms and invariances."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import with_pixels

from terrainloop import field as fields_module
from terrainloop.config import Calibration
from terrainloop.field import Field, rotate_field
from terrainloop.geometry import inverse, se2
from terrainloop.matching.overlay import agreement_at, participation_at, pixel_lookup

SPACING = 0.2


def field_of(gradient_map, spacing):
    return fields_module.field_of(gradient_map, spacing, Calibration())


BIG = {"origin": (-4.0, -4.0), "shape": (100, 100)}
HALF_TURNED = se2(1.5, -0.6, 2.3)  # shares most of the ground


def images_of(field):
    return np.stack([field.x, field.y, field.valid])


def assert_same_field(a, b, atol=2e-4):
    """Up to rounding; the images are of the order of one."""
    assert a.valid.sum() > 100
    assert np.abs(a.x).max() > 0.01
    np.testing.assert_allclose(images_of(a), images_of(b), rtol=0, atol=atol * np.abs(a.x).max())


def scaled(gradient_map, *, heights=1.0, metres=1.0):
    """The map of ground that is steeper, and of ground that is larger altogether."""
    parameters = replace(gradient_map.parameters, length_scale=metres * gradient_map.parameters.length_scale)
    return replace(
        gradient_map,
        gradient_x=np.float32(heights) * gradient_map.gradient_x,
        gradient_y=np.float32(heights) * gradient_map.gradient_y,
        gradient_variance=np.float32(heights**2 or 1e-12) * gradient_map.gradient_variance,
        origin=tuple(metres * c for c in gradient_map.origin),
        resolution=metres * gradient_map.resolution,
        parameters=parameters,
    )


@pytest.fixture
def terrain(world):
    return world(0).map()


# --- the field of a map


def test_a_mean_slope_changes_nothing(terrain):
    tilted = replace(
        terrain,
        gradient_x=terrain.gradient_x + np.float32(0.3),
        gradient_y=terrain.gradient_y - np.float32(0.1),
    )
    assert_same_field(field_of(tilted, SPACING), field_of(terrain, SPACING))


@pytest.mark.parametrize("factor", [1e-3, 7.0, 1e3])
def test_the_steepness_of_the_terrain_changes_nothing(terrain, factor):
    assert_same_field(field_of(scaled(terrain, heights=factor), SPACING), field_of(terrain, SPACING))


@pytest.mark.parametrize("factor", [1e-2, 3.0, 1e3])
def test_the_unit_of_length_changes_nothing(terrain, factor):
    field = field_of(scaled(terrain, metres=factor), factor * SPACING)
    assert_same_field(field, field_of(terrain, SPACING))
    assert field.spacing == factor * SPACING
    assert field.origin == tuple(factor * c for c in terrain.origin)


def test_unknown_ground_is_zero_whatever_the_map_says_there(terrain):
    mask = terrain.mask.copy()
    mask[20:35, 10:25] = mask[:, 40:] = False
    holed = replace(terrain, mask=mask)
    garbage = np.random.default_rng(0).normal(0, 50, mask.shape).astype(np.float32) * ~mask
    field = field_of(holed, SPACING)
    unknown = field.valid == 0
    assert 0.2 < unknown.mean() < 0.6
    assert not field.x[unknown].any()
    assert not field.y[unknown].any()
    other = replace(
        holed,
        gradient_x=holed.gradient_x + garbage,
        gradient_y=holed.gradient_y - garbage,
        gradient_variance=holed.gradient_variance + np.abs(garbage),
    )
    assert_same_field(field_of(other, SPACING), field)


def test_known_ground_is_where_the_mask_is(terrain):
    """By the middles of the pixels in metres, half a pixel's width aside."""
    mask = np.zeros(terrain.mask.shape, bool)
    mask[13:41, 20:44] = True
    field = field_of(replace(terrain, mask=mask), SPACING)
    rows, columns = np.indices(field.valid.shape)
    x, y, _ = field.metres_from_pixels @ np.stack([columns, rows, np.ones_like(rows)]).reshape(3, -1)
    (x0, y0), r = terrain.origin, terrain.resolution
    inside = (abs(x - x0 - 31.5 * r) < 12 * r) & (abs(y - y0 - 26.5 * r) < 14 * r)
    border = (abs(abs(x - x0 - 31.5 * r) - 12 * r) < 0.06) | (abs(abs(y - y0 - 26.5 * r) - 14 * r) < 0.06)
    sure = ~border
    assert sure.sum() > 250
    np.testing.assert_array_equal(field.valid.ravel()[sure] > 0, inside[sure])


def test_the_last_row_and_column_are_covered(terrain):
    for spacing in (0.08, 0.15, 0.2, 0.33):
        rows, columns = field_of(terrain, spacing).valid.shape
        for count, pixels in ((rows, 60), (columns, 50)):
            assert 0 <= (count - 1) * spacing - (pixels - 1) * terrain.resolution + 1e-9 < spacing + 1e-9


def nothing_in(field):
    return not np.isnan(images_of(field)).any() and not field.x.any() and not field.y.any()


@pytest.mark.parametrize("shape", [(60, 50), (1, 1), (1, 40), (3, 3)])
def test_flat_ground_has_no_field(world, shape):
    """Pytest makes an error of every warning."""
    flat = scaled(world(0).map(shape=shape), heights=0.0)
    assert nothing_in(field_of(flat, SPACING))
    assert nothing_in(field_of(replace(flat, gradient_x=flat.gradient_x + np.float32(0.5)), SPACING))


@pytest.mark.parametrize("shape", [(60, 50), (1, 1), (1, 40), (3, 3)])
def test_a_map_that_knows_nothing_has_no_field(world, shape):
    unknown = world(0).map(shape=shape)
    field = field_of(replace(unknown, mask=np.zeros(shape, bool)), SPACING)
    assert nothing_in(field)
    assert not field.valid.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 2), (3, 3)])
def test_tiny_maps_have_a_field(world, shape):
    field = field_of(world(0).map(shape=shape), SPACING)
    assert np.isfinite(images_of(field)).all()
    assert field.valid.shape == field.x.shape == field.y.shape


def test_flat_ground_beside_unknown_slopes_has_no_field(terrain):
    mask = np.zeros(terrain.mask.shape, bool)
    mask[:30] = True
    known_part_flat = replace(
        terrain,
        mask=mask,
        gradient_x=np.where(mask, np.float32(0), terrain.gradient_x),
        gradient_y=np.where(mask, np.float32(0), terrain.gradient_y),
    )
    assert nothing_in(field_of(known_part_flat, SPACING))


def test_a_boulder_does_not_decide(world):
    """Ground without and with one steep rock still agrees, though the rock holds nearly all the energy."""
    plain, other = world(0).map(**BIG), world(0).map(**BIG)
    rock = np.s_[40:46, 40:46]
    other = with_pixels(other, rock, gradient_x=other.gradient_x[rock] + 10.0)
    assert (plain.gradient_x**2).sum() < 0.3 * (other.gradient_x**2).sum()
    fields = field_of(plain, SPACING), field_of(other, SPACING)
    assert agreement_at(*fields, np.eye(3)).correlation > 0.85


def test_uncertain_gradients_count_less(world):
    """One half of the map is noise, and known to be."""
    plain = world(0).map(**BIG)
    noise = np.random.default_rng(0).normal(0, 1.0, (2, 50, 100)).astype(np.float32)
    half = np.s_[50:]
    slopes = {
        "gradient_x": plain.gradient_x[half] + noise[0],
        "gradient_y": plain.gradient_y[half] + noise[1],
    }
    noisy = with_pixels(plain, half, **slopes)
    told = with_pixels(noisy, half, gradient_variance=1.0)
    field = field_of(plain, SPACING)
    unaware, aware = (agreement_at(field_of(m, SPACING), field, np.eye(3)).correlation for m in (noisy, told))
    assert aware > unaware + 0.05


def test_waves_that_stand_out_are_taken_down(world):
    """Ripples ten times as steep as the ground they lie on."""
    ground = world(0).map(**BIG)
    x = ground.resolution * np.arange(100)
    ripples = np.float32(3.0) * np.cos(2 * np.pi * x / 1.3).astype(np.float32)
    rippled = replace(ground, gradient_x=ground.gradient_x + ripples)

    def peak(image):
        spectrum = np.abs(np.fft.rfft2(image - image.mean())) ** 2
        return spectrum.max() / spectrum.mean()

    field = field_of(rippled, SPACING)
    assert peak(field.x) < 0.1 * peak(rippled.gradient_x)


# --- turning


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, -2.0, 0.7])
def test_turned_vectors_point_where_the_turn_takes_them(yaw):
    """A field that points along x everywhere points along the yaw once turned."""
    ones = np.ones((41, 41), np.float32)
    field = Field(ones, 0 * ones, ones, (0.0, 0.0), 1.0, 2.0)
    middle = se2(20.0, 20.0, 0.0)
    turn = middle @ se2(0.0, 0.0, yaw) @ inverse(middle)
    x, y, known = rotate_field(field, inverse(turn), (41, 41))
    assert known[20, 20] == 1
    assert x[20, 20] == pytest.approx(np.cos(yaw), abs=1e-6)
    assert y[20, 20] == pytest.approx(np.sin(yaw), abs=1e-6)


def test_turned_ground_lies_where_the_turn_takes_it():
    spot = np.zeros((31, 31), np.float32)
    spot[10, 25] = 1.0  # column 25, row 10
    field = Field(spot, 0 * spot, np.ones_like(spot), (0.0, 0.0), 1.0, 2.0)
    quarter = np.array([[0.0, -1.0, 30.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # to column 20, row 25
    x, y, known = rotate_field(field, np.linalg.inv(quarter), (31, 31))
    assert np.unravel_index(y.argmax(), y.shape) == (25, 20)
    assert y[25, 20] == pytest.approx(1.0)
    assert np.abs(x).max() < 1e-6
    assert known[1:-1, 1:-1].all()


# --- agreement


def test_a_map_agrees_with_itself_and_not_with_its_opposite(terrain):
    field = field_of(terrain, SPACING)
    opposite = field_of(scaled(terrain, heights=-1.0), SPACING)
    agreement = agreement_at(field, field, np.eye(3))
    assert agreement.correlation == pytest.approx(1.0, abs=1e-6)
    assert agreement.area == pytest.approx(field.valid.sum() * SPACING**2)
    assert agreement_at(field, opposite, np.eye(3)).correlation == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("T", [se2(0.5, -0.3, 0.0), HALF_TURNED, se2(-0.4, 0.9, -1.0), se2(0.0, 0.4, 2.8)])
def test_the_same_ground_agrees_in_another_frame(world, T):
    source, target = field_of(world(0).map(T, **BIG), SPACING), field_of(world(0).map(**BIG), SPACING)
    assert agreement_at(source, target, T).correlation > 0.9
    assert agreement_at(target, source, inverse(T)).correlation > 0.9
    for wrong in (inverse(T), T @ se2(0.5, 0.0, 0.0), T @ se2(0.0, 0.0, 0.4), T @ se2(0.0, 0.0, np.pi)):
        assert agreement_at(source, target, wrong).correlation < 0.5


@pytest.mark.parametrize("T", [HALF_TURNED, se2(0.03, 0.07, 0.2), se2(2.0, 1.0, -3.0)])
def test_agreement_is_the_same_either_way(world, T):
    """Also where it is none: of unrelated ground."""
    a, b = field_of(world(0).map(T), SPACING), field_of(world(0).map(), SPACING)
    c = field_of(world(3).map(), SPACING)
    for source, target in ((a, b), (c, b), (a, c)):
        forth, back = agreement_at(source, target, T), agreement_at(target, source, inverse(T))
        assert forth.correlation == pytest.approx(back.correlation, abs=0.05)
        assert forth.area == pytest.approx(back.area, rel=0.05)


def test_agreement_of_whole_pixels_is_the_naive_sum(world):
    source, target = (field_of(world(seed).map(), SPACING) for seed in (0, 3))
    agreement = agreement_at(source, target, se2(3 * SPACING, -2 * SPACING, 0.0))
    a, b = (images_of(f).astype(float) for f in (source, target))
    a, b = a[:, 2:, :-3], b[:, :-2, 3:]
    both = a[2] * b[2] > 0
    product = (a[:2] * b[:2])[:, both].sum()
    expected = product / np.sqrt((a[:2, both] ** 2).sum() * (b[:2, both] ** 2).sum())
    assert agreement.correlation == pytest.approx(expected, abs=1e-5)
    assert agreement.area == pytest.approx(both.sum() * SPACING**2)


def test_area_is_the_ground_that_is_shared(world):
    """Squares of 8 m, one turned by half a right angle about the common middle: a regular octagon."""
    square = {"origin": (-4.0, -4.0), "shape": (101, 101)}
    field = field_of(world(0).map(**square), SPACING)
    for yaw, area in ((0.0, 64.0), (np.pi / 2, 64.0), (np.pi / 4, 64 * 2 * (np.sqrt(2) - 1))):
        assert agreement_at(field, field, se2(0, 0, yaw)).area == pytest.approx(area, rel=0.06)


def test_fields_apart_share_nothing(terrain):
    agreement = agreement_at(field_of(terrain, SPACING), field_of(terrain, SPACING), se2(50.0, 0.0, 0.0))
    assert agreement.correlation == 0.0
    assert agreement.area == 0.0


def test_resolution_and_origin_do_not_matter(world):
    """Both are read in metres: a wrong half pixel would cost more than this."""
    fine = field_of(world(0).map(origin=(-3.97, -4.03), shape=(160, 160), resolution=0.05), SPACING)
    coarse = field_of(world(0).map(**BIG), SPACING)

    def at(x, y):
        return agreement_at(fine, coarse, se2(x, y, 0.0)).correlation

    assert at(0.0, 0.0) > 0.95
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        assert at(0.1 * dx, 0.1 * dy) < at(0.0, 0.0)
    steps = np.array([-0.1, 0.0, 0.1])
    for values in ([at(x, 0.0) for x in steps], [at(0.0, y) for y in steps]):
        a, b, _ = np.polyfit(steps, values, 2)
        assert abs(-b / (2 * a)) < 0.02


def test_utm_coordinates_keep_the_agreement(world):
    far, T = se2(5e5, 4e6, 0.0), HALF_TURNED
    here = agreement_at(field_of(world(0).map(T), SPACING), field_of(world(0).map(), SPACING), T)
    moved = [
        replace(m, origin=(m.origin[0] + 5e5, m.origin[1] + 4e6)) for m in (world(0).map(T), world(0).map())
    ]
    there = agreement_at(*(field_of(m, SPACING) for m in moved), far @ T @ inverse(far))
    assert there.correlation == pytest.approx(here.correlation, abs=0.01)
    assert there.area == pytest.approx(here.area, rel=0.02)


def test_participation_is_that_of_the_naive_loop_over_blocks(world):
    T, side = se2(0.9, -0.6, 0.4), 4
    source, target = (field_of(world(0).map(pose), SPACING) for pose in (T, np.eye(3)))
    sums, counts = {}, {}
    rows, columns = target.valid.shape
    x, y, valid = rotate_field(source, pixel_lookup(source, target, T), (rows, columns))
    for row in range(rows):
        for column in range(columns):
            if valid[row, column] > 0 and target.valid[row, column] > 0:
                block = row // side, column // side
                product = float(x[row, column]) * target.x[row, column]
                product += float(y[row, column]) * target.y[row, column]
                sums[block], counts[block] = sums.get(block, 0.0) + product, counts.get(block, 0) + 1
    squares = sum(sums[block] ** 2 / counts[block] for block in sums)
    expected = sum(sums.values()) ** 2 / (sum(counts.values()) * squares)
    assert participation_at(source, target, T, side * SPACING) == pytest.approx(expected)
    assert 0.5 < expected < 1.0


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_where_part_of_the_ground_agrees_that_part_takes_part(share):
    rng = np.random.default_rng(3)
    length = rng.choice([-1.0, 1.0], (2, 64, 64)).astype(np.float32)
    other = np.where(np.arange(64) < 64 * share, length, rng.permuted(length, axis=2)).astype(np.float32)
    fields = [Field(*xy, np.ones((64, 64), np.float32), (0.0, 0.0), 0.1, 0.2) for xy in (length, other)]
    assert participation_at(*fields, np.eye(3), 0.8) == pytest.approx(share, abs=0.03)


def test_fields_that_share_nothing_have_no_participation(world):
    field = field_of(world(0).map(), SPACING)
    assert participation_at(field, field, se2(50.0, 0.0, 0.0), 0.8) == 0.0
