"""Maps as GeoTIFF, for GIS programs."""

import io
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import tifffile
from numpy.typing import NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.io.files import write_whole

# Tags of OGC GeoTIFF 1.1 and of GDAL
_PIXEL_SCALE, _TIE_POINT, _GEO_KEYS, _GEO_ASCII = 33550, 33922, 34735, 34737
_GDAL_METADATA, _GDAL_NODATA = 42112, 42113

# Keys of OGC GeoTIFF 1.1 and their values: a Cartesian grid whose pixels are points, in metres
_MODEL_TYPE, _RASTER_TYPE, _CITATION, _PROJECTED = 1024, 1025, 1026, 3072
_IS_PROJECTED, _IS_POINT, _USER_DEFINED = 1, 2, 32767


def write_geotiff(
    path: Path | str,
    bands: Mapping[str, NDArray[np.float32]],
    origin: tuple[float, float],
    resolution: float,
    *,
    mask: NDArray[np.bool_] | None = None,
    crs: int | str | None = None,
) -> None:
    """Write named bands (rows = y upwards, columns = x) as one float32 GeoTIFF, completely or not at all.

    The bands are named in GDAL's metadata, and NaN is declared as GDAL's nodata value.

    Parameters
    ----------
    path : Path or str
    bands : mapping of str to array, (H, W)
        In the order of the file.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    mask : array of bool, (H, W), optional
        Valid pixels; the others become NaN in every band.
    crs : int or str, optional
        Projected coordinate reference system of `origin`: an EPSG code, or WKT. GeoTIFF has no key for
        WKT, so that it is kept as the citation, which people can read, but programs will not apply.

    Raises
    ------
    TerrainLoopError
        Where the bands, the mask, the resolution or the code do not fit.
    OSError
        Naming `path`, where it cannot be written.
    """
    stack = _stack(bands, mask)
    if not (0 < resolution < np.inf and np.isfinite(origin).all()):
        raise TerrainLoopError(
            expected="a finite origin and a resolution above 0, in metres",
            found=f"{origin} and {resolution}",
            mend="give those of the map",
        )
    top = origin[1] + resolution * (stack.shape[1] - 1)
    keys, text = _geo_keys(crs)
    # GDAL escapes descriptions twice, and undoes it twice.
    items = "".join(
        f'<Item name="DESCRIPTION" sample="{i}" role="description">{escape(escape(name))}</Item>'
        for i, name in enumerate(bands)
    )
    file = io.BytesIO()  # TIFF needs to seek, which a pipe cannot
    tifffile.imwrite(
        file,
        stack,
        photometric="minisblack",
        planarconfig="separate" if len(stack) > 1 else None,
        compression="zlib",
        description=_ascii(", ".join(bands)),
        metadata=None,
        extratags=[
            (_PIXEL_SCALE, "d", 3, (resolution, resolution, 0.0), True),
            (_TIE_POINT, "d", 6, (0.0, 0.0, 0.0, origin[0], top, 0.0), True),
            (_GEO_KEYS, "H", len(keys), keys, True),
            *([(_GEO_ASCII, "s", 0, text, True)] if text else []),
            (_GDAL_METADATA, "s", 0, _ascii(f"<GDALMetadata>{items}</GDALMetadata>"), True),
            (_GDAL_NODATA, "s", 0, "nan", True),
        ],
    )
    write_whole(path, lambda output: output.write(file.getbuffer()))


def _stack(bands: Mapping[str, NDArray[np.float32]], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """Bands as TIFF has them: float32 (B, H, W) with rows going down, NaN outside the mask."""
    shapes = {np.shape(band) for band in bands.values()} | ({np.shape(mask)} if mask is not None else set())
    if not bands or len(shapes) > 1 or len(min(shapes)) != 2 or 0 in min(shapes):
        raise TerrainLoopError(
            expected="one band or more of one shape (H, W), and a mask of that shape",
            found=f"{len(bands)} bands, shapes {sorted(shapes)}",
            mend="give the images of one map",
        )
    stack = np.array(list(bands.values()), dtype=np.float32)
    if mask is not None:
        stack[:, ~np.asarray(mask, dtype=bool)] = np.nan
    return np.ascontiguousarray(stack[:, ::-1])


def _geo_keys(crs: int | str | None) -> tuple[list[int], str]:
    """The directory of keys, and the text that it refers to."""
    entries = [(_RASTER_TYPE, 0, 1, _IS_POINT)]
    text = ""
    if isinstance(crs, int):
        if not 1024 <= crs < _USER_DEFINED:  # OGC GeoTIFF 1.1, requirements class ProjectedCRSGeoKey
            raise TerrainLoopError(
                expected=f"the EPSG code of a projected system, 1024 to {_USER_DEFINED - 1}",
                found=str(crs),
                mend="leave the coordinate reference system out",
            )
        entries += [(_MODEL_TYPE, 0, 1, _IS_PROJECTED), (_PROJECTED, 0, 1, crs)]
    elif crs:
        text = _ascii(crs.replace("|", " ")) + "|"  # the end of a string
        entries += [(_CITATION, _GEO_ASCII, len(text), 0)]
    entries.sort()
    return [1, 1, 0, len(entries), *(number for entry in entries for number in entry)], text


def _ascii(text: str) -> str:
    """Text as TIFF holds it, other characters as XML has them."""
    return text.encode("ascii", "xmlcharrefreplace").decode()
