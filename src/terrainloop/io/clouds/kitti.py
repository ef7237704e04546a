"""Scans of KITTI: four little-endian floats per point."""

from pathlib import Path

import numpy as np

from terrainloop.io.clouds.table import Table

_COLUMNS = ("x", "y", "z", "intensity")


def read_kitti(path: Path) -> Table:
    """Read x, y, z and intensity in single precision, without a header."""
    values = np.fromfile(path, dtype="<f4")
    if path.stat().st_size % (4 * len(_COLUMNS)):
        raise ValueError(f"{path.stat().st_size} bytes, not a multiple of {4 * len(_COLUMNS)}")
    return Table(dict(zip(_COLUMNS, values.reshape(-1, len(_COLUMNS)).T, strict=True)))
