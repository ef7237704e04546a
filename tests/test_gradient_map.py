"""Gradient maps: where a pixel lies, what the contract promises, and files."""

import io
import os
import pickle
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gradient_map import GradientMap
from terrainloop.submap import Submap

UTM = np.array([5e5, 4e6, 0.0])
ARRAYS = ("elevation", "gradient_x", "gradient_y", "magnitude", "variance", "gradient_variance")
GIVEN = {"length_scale": 0.4, "variance": 0.01, "noise": 0.011}


def scatter(count=500, width=4.0, height=3.0, seed=0):
    """Positions (count, 2) whose bounding box begins at (1, -2)."""
    xy = np.random.default_rng(seed).uniform(0, 1, (count, 2)) * [width, height]
    return xy - xy.min(axis=0) + [1.0, -2.0]


def grid_of(gradient_map):
    """World position (rows, columns, 2) of every pixel, as the contract has it."""
    rows, columns = np.indices(gradient_map.mask.shape)
    return np.array(gradient_map.origin) + gradient_map.resolution * np.stack([columns, rows], axis=-1)


def same_bytes(a, b):
    return (
        all(
            np.asarray(getattr(a, f.name)).tobytes() == np.asarray(getattr(b, f.name)).tobytes()
            for f in fields(GradientMap)
            if f.name != "parameters"
        )
        and a.parameters == b.parameters
    )


@pytest.fixture(scope="module")
def cloud(world):
    xy = scatter()
    return np.c_[xy, world(2).height(xy) + np.random.default_rng(1).normal(0, 0.01, len(xy))]


@pytest.fixture(scope="module")
def bumpy(cloud):
    return GradientMap.from_points(cloud, **GIVEN, resolution=0.1)


def test_pixels_cover_the_bounding_box_from_its_corner(cloud, bumpy):
    low, high = cloud[:, :2].min(0), cloud[:, :2].max(0)
    grid = grid_of(bumpy)
    np.testing.assert_allclose(grid[0, 0], low, rtol=0, atol=1e-9)
    np.testing.assert_allclose(grid[0, 0], [1.0, -2.0], rtol=0, atol=1e-9)
    assert (grid[-1, -1] <= high + 1e-9).all()
    assert (grid[-1, -1] > high - 0.1).all()


def test_arrays_keep_the_contract(bumpy):
    columns, rows = 40, 30  # 4 x 3 m at 0.1 m, less than a pixel missing on each side
    for name in ARRAYS:
        image = getattr(bumpy, name)
        assert image.dtype == np.float32, name
        assert image.shape == bumpy.mask.shape, name
        assert np.isfinite(image).all(), name
    assert bumpy.mask.dtype == bool
    assert bumpy.mask.shape == pytest.approx((rows, columns), abs=1)
    assert bumpy.mask.shape[0] < bumpy.mask.shape[1]
    assert bumpy.resolution == 0.1
    assert len(bumpy.origin) == 2
    length = np.sqrt(bumpy.gradient_x**2 + bumpy.gradient_y**2)
    np.testing.assert_allclose(bumpy.magnitude, length, rtol=1e-6)


def test_map_shows_the_ground_it_was_made_of(world, bumpy):
    inner = np.s_[5:-5, 5:-5]
    grid = grid_of(bumpy)[inner]
    height = world(2).height(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    slope = world(2).slope(grid.reshape(-1, 2)).reshape(grid.shape)
    assert np.sqrt(np.mean((bumpy.elevation[inner] - height) ** 2)) < 0.15 * height.std()
    for estimate, truth in ((bumpy.gradient_x, slope[..., 0]), (bumpy.gradient_y, slope[..., 1])):
        assert np.corrcoef(estimate[inner].ravel(), truth.ravel())[0, 1] > 0.95
        assert np.sqrt(np.mean((estimate[inner] - truth) ** 2)) < 0.3 * truth.std()


def test_variances_are_those_of_the_errors(world, bumpy):
    """Normalised errors against the known ground average near one (the ground is no draw of the prior)."""
    inner = np.s_[5:-5, 5:-5]
    grid = grid_of(bumpy)[inner].reshape(-1, 2)
    height = world(2).height(grid)
    error = bumpy.elevation[inner].ravel() - height
    assert 0.2 < np.mean(error**2 / bumpy.variance[inner].ravel()) < 5.0
    slope = world(2).slope(grid)
    squared = (bumpy.gradient_x[inner].ravel() - slope[:, 0]) ** 2
    squared += (bumpy.gradient_y[inner].ravel() - slope[:, 1]) ** 2
    assert 0.2 < np.mean(squared / 2 / bumpy.gradient_variance[inner].ravel()) < 5.0


@pytest.mark.parametrize("offset", [np.zeros(3), UTM, -UTM], ids=["local", "utm", "negative utm"])
@pytest.mark.parametrize("remove_plane", [True, False])
def test_tilted_plane(offset, remove_plane):
    xy = scatter()
    a, b, c = 0.12, -0.07, 25.0
    points = np.c_[xy, a * xy[:, 0] + b * xy[:, 1] + c] + offset
    options = {"length_scale": 2.0, "variance": 0.5, "noise": 1e-3}
    plane = GradientMap.from_points(points, **options, resolution=0.25, remove_plane=remove_plane)
    grid = grid_of(plane) - offset[:2]
    tolerance = 2e-6 if remove_plane else 2e-2
    height = a * grid[..., 0] + b * grid[..., 1] + c
    np.testing.assert_allclose(plane.elevation, height, rtol=0, atol=max(tolerance / 10, 4e-6))
    np.testing.assert_allclose(plane.gradient_x, a, rtol=0, atol=tolerance)
    np.testing.assert_allclose(plane.gradient_y, b, rtol=0, atol=tolerance)


def test_utm_coordinates_lose_nothing(cloud, bumpy):
    far = GradientMap.from_points(cloud + UTM, **GIVEN, resolution=0.1)
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(far, name), getattr(bumpy, name), rtol=0, atol=1e-5, err_msg=name)
    assert (far.mask == bumpy.mask).mean() > 0.999
    np.testing.assert_allclose(np.subtract(far.origin, UTM[:2]), bumpy.origin, rtol=0, atol=1e-6)


def test_mask_is_false_in_a_hole_and_true_on_data(world):
    xy = scatter(900)
    centre = np.array([3.0, -0.5])
    xy = xy[np.linalg.norm(xy - centre, axis=1) > 1.0]
    holed = GradientMap.from_points(np.c_[xy, world(2).height(xy)], **GIVEN, resolution=0.1)
    from_centre = np.linalg.norm(grid_of(holed) - centre, axis=-1)
    assert not holed.mask[from_centre < 0.4].any()
    assert holed.mask[from_centre > 1.0].mean() > 0.98
    known = holed.variance < 0.25 * GIVEN["variance"]
    np.testing.assert_array_equal(holed.mask, known)


def test_mask_follows_its_threshold(cloud):
    shares = [
        GradientMap.from_points(cloud, **GIVEN, resolution=0.2, max_variance_ratio=ratio).mask.mean()
        for ratio in (0.005, 0.02, 0.9)
    ]
    assert shares[0] < shares[1] < shares[2] == 1.0


@pytest.mark.parametrize("name", GIVEN)
def test_given_hyperparameters_are_kept_and_the_others_fitted(cloud, name):
    gradient_map = GradientMap.from_points(cloud, **{name: GIVEN[name]}, resolution=0.3)
    for other, start in GIVEN.items():
        value = getattr(gradient_map.parameters, other)
        if other == name:
            assert value == pytest.approx(start, rel=1e-12)
        else:
            assert 0 < value < np.inf
    assert gradient_map.parameters.noise == pytest.approx(0.01, rel=0.35)  # what the cloud was made with


def test_all_given_are_kept_exactly(bumpy):
    assert vars(bumpy.parameters) == GIVEN


def test_resolution_follows_the_length_scale(cloud):
    fine, coarse = (GradientMap.from_points(cloud, length_scale, 0.01, 0.011) for length_scale in (0.6, 1.2))
    assert coarse.resolution == pytest.approx(2 * fine.resolution)
    assert 0.02 < fine.resolution < 0.6


def test_too_many_points_are_thinned_by_the_seed(cloud):
    options = {**GIVEN, "resolution": 0.3, "max_points": 200}
    one, again, other = (GradientMap.from_points(cloud, **options, seed=seed) for seed in (3, 3, 4))
    assert same_bytes(one, again)
    assert not np.array_equal(one.elevation, other.elevation)
    whole = GradientMap.from_points(cloud, **GIVEN, resolution=0.3)
    assert np.median(one.variance) > 1.2 * np.median(whole.variance)  # fewer points know less


def test_few_enough_points_are_all_kept(cloud):
    one, other = (
        GradientMap.from_points(cloud, **GIVEN, resolution=0.3, max_points=len(cloud), seed=seed)
        for seed in (3, 4)
    )
    assert same_bytes(one, other)


@pytest.mark.parametrize("given", [GIVEN, {}], ids=["given", "fitted"])
def test_workers_do_not_change_a_byte(cloud, given):
    one, three = (GradientMap.from_points(cloud, **given, resolution=0.1, workers=w) for w in (1, 3))
    assert same_bytes(one, three)


def test_submap_and_its_points_make_the_same_map(cloud, bumpy):
    assert same_bytes(GradientMap.from_points(Submap(cloud, "a"), **GIVEN, resolution=0.1), bumpy)
    assert same_bytes(GradientMap.from_points(cloud.tolist(), **GIVEN, resolution=0.1), bumpy)


def test_absurd_grid_is_an_error(cloud):
    with pytest.raises(TerrainLoopError, match=r"pixels.*coarser"):
        GradientMap.from_points(cloud, **GIVEN, resolution=1e-5)


def test_pixel_larger_than_the_cloud_is_one_pixel(cloud):
    assert GradientMap.from_points(cloud, **GIVEN, resolution=50.0).mask.shape == (1, 1)


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.zeros((200, 2)), "words", np.full((300, 3), np.nan)])
def test_no_submap_is_an_error(points):
    with pytest.raises(TerrainLoopError):
        GradientMap.from_points(points)


@pytest.mark.parametrize(
    "impossible",
    [
        {"resolution": -0.1},
        {"resolution": 0.0},
        {"length_scale": 0.0},
        {"length_scale": -0.4},
        {"noise": -0.1},
    ],
)
def test_impossible_numbers_are_an_error(cloud, impossible):
    with pytest.raises(TerrainLoopError):
        GradientMap.from_points(cloud, **{**GIVEN, "resolution": 0.3, **impossible})


def test_map_survives_its_file(tmp_path, bumpy):
    bumpy.save(tmp_path / "map.npz")
    again = GradientMap.load(str(tmp_path / "map.npz"))
    assert same_bytes(again, bumpy)
    assert type(again.origin) is tuple
    assert type(again.resolution) is float
    assert again.mask.dtype == bool


def test_file_is_the_same_each_time_and_read_by_plain_numpy(tmp_path, bumpy):
    bumpy.save(tmp_path / "a.npz")
    bumpy.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["magnitude"], bumpy.magnitude)
        assert {*ARRAYS, "mask", "origin", "resolution"} <= set(file)


def other_archive(path):
    np.savez(path, points=np.zeros((10, 3)))


def spoilt(**changes):
    """A file in which some arrays are others."""

    def spoil(path):
        with np.load(path) as file:
            content = dict(file)
        np.savez(path, **content | {name: make(content[name]) for name, make in changes.items()})

    return spoil


def packed_otherwise(path):
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def announced_large(path):
    """A header that announces more than there is, as in a file made to exhaust the memory."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, header.getvalue() if name == "elevation.npy" else data)


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def folder(path):
    path.unlink()
    path.mkdir()


def words(path):
    path.write_text("no map")


def nothing(path):
    path.write_bytes(b"")


def half_a_map(path):
    half = path.read_bytes()
    path.write_bytes(half[: len(half) // 2])


def plain_array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def no_file(path):
    path.unlink()


@pytest.mark.parametrize(
    "spoil",
    [
        other_archive,
        words,
        nothing,
        no_file,
        half_a_map,
        plain_array,
        packed_otherwise,
        announced_large,
        pipe,
        folder,
        spoilt(parameters=lambda p: p * [0, 1, 1]),
        spoilt(parameters=lambda p: p * [-1, 1, 1]),
        spoilt(parameters=lambda p: p * [1e-6, 1, 1]),
        spoilt(parameters=lambda p: p * [1, np.nan, 1]),
        spoilt(parameters=lambda p: p[:2]),
        spoilt(parameters=lambda p: np.array(list(p), dtype=object)),
        spoilt(resolution=lambda r: 0 * r),
        spoilt(resolution=lambda r: np.array([r, r])),
        spoilt(resolution=lambda r: np.float64(np.inf)),
        spoilt(origin=lambda o: o * np.nan),
        spoilt(origin=lambda o: o[:1]),
        spoilt(elevation=lambda e: e[:-1]),
        spoilt(elevation=lambda e: e.astype(np.float64)),
        spoilt(elevation=lambda e: e[None]),
        spoilt(gradient_x=lambda g: np.where(g == g.max(), np.float32(np.nan), g)),
        spoilt(gradient_y=lambda g: np.where(g == g.max(), np.float32(1e30), g)),
        spoilt(variance=lambda v: 0 * v),
        spoilt(gradient_variance=lambda v: -v),
        spoilt(mask=lambda m: m.astype(np.uint8)),
        spoilt(**{name: lambda a: a[:0] for name in (*(n for n in ARRAYS if n != "magnitude"), "mask")}),
    ],
)
def test_what_is_no_map_is_an_error(tmp_path, bumpy, spoil):
    path = tmp_path / "map.npz"
    bumpy.save(path)
    spoil(path)
    with pytest.raises(TerrainLoopError) as caught:
        GradientMap.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(path))


def test_a_map_is_saved_whole_or_not_at_all(tmp_path, bumpy, monkeypatch):
    bumpy.save(tmp_path / "map.npz")
    before = (tmp_path / "map.npz").read_bytes()

    def full_disk(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="space"):
        bumpy.save(tmp_path / "map.npz")
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]
    assert (tmp_path / "map.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"elevation": None}, "elevation"),
        ({"mask": np.ones((3, 3), int)}, "booleans"),
        ({"variance": np.ones((3, 3), np.float32)}, "one shape"),
        ({"gradient_x": "file.npz"}, "gradient_x"),
        ({"resolution": 0.0}, "positive"),
        ({"resolution": "0.1"}, "resolution"),
        ({"origin": (0.0, np.nan)}, "origin"),
        ({"origin": None}, "origin"),
        ({"parameters": (0.4, 0.1, 0.01)}, "Hyperparameters"),
        ({"parameters": Hyperparameters(0.4, 0.1, 0.0)}, "positive"),
        ({"parameters": Hyperparameters(1e-9, 0.1, 0.1)}, "squares of the length scale"),
        ({"parameters": Hyperparameters(1e6, 0.1, 0.1)}, "pixels within a length scale"),
        ({"resolution": 1e-9}, "pixels within a length scale"),
    ],
)
def test_maps_made_by_hand_are_checked(bumpy, changes, said):
    with pytest.raises(TerrainLoopError, match=said):
        replace(bumpy, **changes)


def test_images_of_a_map_by_hand_may_be_double(bumpy):
    again = replace(bumpy, elevation=bumpy.elevation.astype(np.float64))
    assert again.elevation.dtype == np.float32
    assert same_bytes(again, bumpy)


def test_arrays_are_read_only_and_the_callers_stay_as_they_are(tmp_path, bumpy):
    own = bumpy.elevation.copy()
    made = replace(bumpy, elevation=own)
    assert np.shares_memory(made.elevation, own)
    own[0, 0] = 1.0
    bumpy.save(tmp_path / "map.npz")
    for each in (made, GradientMap.load(tmp_path / "map.npz"), pickle.loads(pickle.dumps(bumpy))):
        for name in (*ARRAYS, "mask"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(each, name)[0, 0] = 0


def test_extent_is_that_of_the_pixels(bumpy):
    grid = grid_of(bumpy)
    low, high = grid[0, 0] - bumpy.resolution / 2, grid[-1, -1] + bumpy.resolution / 2
    np.testing.assert_allclose(bumpy.extent, [low[0], high[0], low[1], high[1]], rtol=0, atol=1e-12)
    assert [type(edge) for edge in bumpy.extent] == 4 * [float]


def test_a_map_describes_itself_in_a_line(bumpy):
    rows, columns = bumpy.mask.shape
    share = round(100 * bumpy.mask.mean())
    assert repr(bumpy) == (
        f"GradientMap({columns} x {rows} pixels of 0.1 m, {share} % observed, length scale 0.4 m)"
    )


def test_masts_and_flying_pixels_are_no_terrain(cloud, bumpy):
    """Points far off the plane leave the map of the ground as it was; the paper's map keeps them."""
    rng = np.random.default_rng(3)
    inner = rng.uniform([1.5, -1.5], [4.5, 0.5], (12, 2))
    dirty = np.vstack([cloud, np.c_[inner, rng.uniform(2.0, 5.0, 12) * rng.choice([-1, 1], 12)]])
    np.testing.assert_allclose(
        GradientMap.from_points(dirty, **GIVEN, resolution=0.1).elevation, bumpy.elevation, rtol=0, atol=1e-6
    )
    kept = GradientMap.from_points(dirty, **GIVEN, resolution=0.1, remove_plane=False)
    assert np.abs(kept.elevation - bumpy.elevation).max() > 0.3


def test_a_rock_is_terrain(cloud):
    rock = np.hypot(cloud[:, 0] - 3.0, cloud[:, 1] + 0.5) < 0.3
    with_rock = cloud + np.outer(rock, [0, 0, 0.15])
    difference = (
        GradientMap.from_points(with_rock, **GIVEN, resolution=0.1).elevation
        - GradientMap.from_points(cloud, **GIVEN, resolution=0.1).elevation
    )
    assert difference.max() > 0.1
