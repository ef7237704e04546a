"""GeoTIFF files as other programs read them."""

import numpy as np
import pytest
import tifffile

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


def test_rasterio_agrees(file, bands):
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(file) as raster:
        assert raster.count == len(bands)
        # GDAL's transform is that of pixel corners, half a pixel out.
        row, column = 4, 1
        x, y = raster.xy(SHAPE[0] - 1 - row, column)
        assert (x, y) == pytest.approx((ORIGIN[0] + RESOLUTION * column, ORIGIN[1] + RESOLUTION * row))
        np.testing.assert_array_equal(raster.read(3), bands["number"][::-1])
