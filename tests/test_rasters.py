"""GeoTIFF files as other programs read them."""

from xml.etree import ElementTree as ET
from xml.sax.saxutils import unescape

import numpy as np
import pytest
import tifffile

from terrainloop.errors import TerrainLoopError
from terrainloop.io.rasters import write_geotiff

ORIGIN, RESOLUTION = (431234.5, 3761234.25), 0.25
SHAPE = (7, 5)  # rows along y, columns along x


@pytest.fixture
def bands():
    """Bands that tell of each pixel where it lies."""
    rows, columns = np.indices(SHAPE)
    x, y = ORIGIN[0] + RESOLUTION * columns, ORIGIN[1] + RESOLUTION * rows
    return {
        "x": (x - 431000).astype(np.float32),
        "y": (y - 3761000).astype(np.float32),
        "number": (10 * rows + columns).astype(np.float32),
    }


@pytest.fixture
def file(tmp_path, bands):
    path = tmp_path / "map.tif"
    write_geotiff(path, bands, ORIGIN, RESOLUTION)
    return path


def test_bands_come_back_in_order_and_north_up(file, bands):
    image = tifffile.imread(file)
    assert image.shape == (3, *SHAPE)
    assert image.dtype == np.float32
    for read, written in zip(image, bands.values(), strict=True):
        np.testing.assert_array_equal(read, written[::-1])


def test_georeferencing_puts_each_pixel_where_it_lies(file):
    with tifffile.TiffFile(file) as tiff:
        tags = tiff.pages[0].tags
        scale, tie = tags["ModelPixelScaleTag"].value, tags["ModelTiepointTag"].value
        image = tiff.asarray()
    column0, row0, _, x0, y0, _ = tie
    assert scale[:2] == (RESOLUTION, RESOLUTION)
    for row, column in [(0, 0), (6, 4), (2, 3)]:
        # OGC GeoTIFF 1.1, 7.4: rows go down; with RasterPixelIsPoint these are the points themselves.
        x, y = x0 + (column - column0) * scale[0], y0 - (row - row0) * scale[1]
        assert image[0, row, column] == pytest.approx(x - 431000, abs=1e-6)
        assert image[1, row, column] == pytest.approx(y - 3761000, abs=1e-6)


def test_pixels_are_points(file):
    with tifffile.TiffFile(file) as tiff:
        keys = tiff.pages[0].tags["GeoKeyDirectoryTag"].value
        meaning = tiff.geotiff_metadata["GTRasterTypeGeoKey"]
    assert keys[:2] == (1, 1)  # version and revision of OGC GeoTIFF 1.1
    assert keys[3] * 4 + 4 == len(keys)
    assert meaning.name.endswith("IsPoint")


def test_bands_are_named(file, bands):
    with tifffile.TiffFile(file) as tiff:
        assert tiff.pages[0].description == ", ".join(bands)
        assert tiff.pages[0].tags["SamplesPerPixel"].value == len(bands)


def test_one_band(tmp_path, bands):
    write_geotiff(str(tmp_path / "one.tif"), {"number": bands["number"]}, ORIGIN, RESOLUTION)
    np.testing.assert_array_equal(np.squeeze(tifffile.imread(tmp_path / "one.tif")), bands["number"][::-1])


def test_file_is_the_same_each_time(file, bands, tmp_path):
    write_geotiff(tmp_path / "again.tif", bands, ORIGIN, RESOLUTION)
    assert file.read_bytes() == (tmp_path / "again.tif").read_bytes()


def _tags(path):
    with tifffile.TiffFile(path) as tiff:
        return {tag.code: tag.value for tag in tiff.pages[0].tags}


def test_no_value_where_ground_is_not_known(tmp_path, bands):
    mask = np.arange(35).reshape(SHAPE) % 3 > 0
    kept = {name: band.copy() for name, band in bands.items()}
    write_geotiff(tmp_path / "a.tif", bands, ORIGIN, RESOLUTION, mask=mask)
    for read, written in zip(tifffile.imread(tmp_path / "a.tif"), kept.values(), strict=True):
        np.testing.assert_array_equal(np.isnan(read), ~mask[::-1])
        np.testing.assert_array_equal(read[mask[::-1]], written[::-1][mask[::-1]])
    assert _tags(tmp_path / "a.tif")[42113] == "nan"
    assert all(np.array_equal(bands[name], kept[name]) for name in bands)


@pytest.mark.parametrize("names", [("elevation", "slope"), ("a & b <c>", 'h\u00f6he "m"')])
def test_gdal_has_the_names_of_bands(tmp_path, names):
    write_geotiff(tmp_path / "a.tif", dict.fromkeys(names, np.zeros(SHAPE)), ORIGIN, RESOLUTION)
    items = ET.fromstring(_tags(tmp_path / "a.tif")[42112])
    assert items.tag == "GDALMetadata"
    assert [(item.get("name"), item.get("role"), item.get("sample")) for item in items] == [
        ("DESCRIPTION", "description", "0"),
        ("DESCRIPTION", "description", "1"),
    ]
    assert tuple(unescape(item.text) for item in items) == names  # GDAL escapes twice


def test_projected_system_by_its_code(tmp_path, bands):
    write_geotiff(tmp_path / "a.tif", bands, ORIGIN, RESOLUTION, crs=32611)
    keys = np.reshape(_tags(tmp_path / "a.tif")[34735], (-1, 4)).tolist()
    assert keys == [[1, 1, 0, 3], [1024, 0, 1, 1], [1025, 0, 1, 2], [3072, 0, 1, 32611]]


def test_projected_system_as_text(tmp_path, bands):
    wkt = 'PROJCS["caf\u00e9|","b"]'
    write_geotiff(tmp_path / "a.tif", bands, ORIGIN, RESOLUTION, crs=wkt)
    tags = _tags(tmp_path / "a.tif")
    version, raster_type, citation = np.reshape(tags[34735], (-1, 4)).tolist()
    assert (version, raster_type) == ([1, 1, 0, 2], [1025, 0, 1, 2])
    assert tags[34737] == 'PROJCS["caf&#233; ","b"]|'
    assert citation == [1026, 34737, len(tags[34737]), 0]


@pytest.mark.parametrize("crs", [0, -1, 32767, 70000])
def test_codes_that_name_no_projected_system(tmp_path, bands, crs):
    with pytest.raises(TerrainLoopError, match=f"EPSG.*{crs}"):
        write_geotiff(tmp_path / "a.tif", bands, ORIGIN, RESOLUTION, crs=crs)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("shapes", "mask"),
    [([], None), ([(3, 4), (4, 3)], None), ([(3, 4)], (4, 3)), ([(12,)], None), ([(0, 4)], None)],
)
def test_bands_that_do_not_fit(tmp_path, shapes, mask):
    bands = {str(i): np.zeros(shape) for i, shape in enumerate(shapes)}
    with pytest.raises(TerrainLoopError, match="shape"):
        write_geotiff(
            tmp_path / "a.tif", bands, ORIGIN, 0.1, mask=None if mask is None else np.ones(mask, bool)
        )


@pytest.mark.parametrize(("origin", "resolution"), [((0, 0), 0), ((0, 0), np.nan), ((np.inf, 0), 1)])
def test_places_that_are_none(tmp_path, bands, origin, resolution):
    with pytest.raises(TerrainLoopError, match="finite origin"):
        write_geotiff(tmp_path / "a.tif", bands, origin, resolution)


def test_rasterio_agrees_on_what_is_beside_the_bands(tmp_path, bands):
    rasterio = pytest.importorskip("rasterio")
    mask = np.ones(SHAPE, bool)
    mask[0, 0] = False
    bands = {"a & b <c>": bands["x"], 'h\u00f6he "m"': bands["y"]}
    write_geotiff(tmp_path / "a.tif", bands, ORIGIN, RESOLUTION, mask=mask, crs=32611)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.to_epsg() == 32611
        assert raster.descriptions == tuple(bands)
        assert np.isnan(raster.nodata)
        np.testing.assert_array_equal(raster.read(1, masked=True).mask, ~mask[::-1])


def test_rasterio_agrees(file, bands):
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(file) as raster:
        assert raster.count == len(bands)
        # GDAL's transform is that of pixel corners, half a pixel out.
        row, column = 4, 1
        x, y = raster.xy(SHAPE[0] - 1 - row, column)
        assert (x, y) == pytest.approx((ORIGIN[0] + RESOLUTION * column, ORIGIN[1] + RESOLUTION * row))
        np.testing.assert_array_equal(raster.read(3), bands["number"][::-1])
