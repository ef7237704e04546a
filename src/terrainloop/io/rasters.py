"""Maps as GeoTIFF, for GIS programs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

# Tags and keys of OGC GeoTIFF 1.1: a plain Cartesian grid whose pixels are points, in metres.
_PIXEL_SCALE, _TIE_POINT, _GEO_KEYS = 33550, 33922, 34735
_RASTER_IS_POINT = (1, 1, 0, 1, 1025, 0, 1, 2)


def write_geotiff(
    path: Path | str,
    bands: Mapping[str, NDArray[np.float32]],
    origin: tuple[float, float],
    resolution: float,
) -> None:
    """Write named bands (rows = y upwards, columns = x) as one float32 GeoTIFF.

    Parameters
    ----------
    path : Path or str
    bands : mapping of str to array, (H, W)
        In the order of the file; the names become the image description.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    """
    stack = np.stack([np.flipud(band) for band in bands.values()]).astype(np.float32)  # TIFF rows go down
    top = origin[1] + resolution * (stack.shape[1] - 1)
    tifffile.imwrite(
        path,
        stack,
        photometric="minisblack",
        planarconfig="separate" if len(stack) > 1 else None,
        compression="zlib",
        description=", ".join(bands),
        metadata=None,
        extratags=[
            (_PIXEL_SCALE, "d", 3, (resolution, resolution, 0.0), True),
            (_TIE_POINT, "d", 6, (0.0, 0.0, 0.0, origin[0], top, 0.0), True),
            (_GEO_KEYS, "H", len(_RASTER_IS_POINT), _RASTER_IS_POINT, True),
        ],
    )
