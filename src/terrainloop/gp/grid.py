"""Regular grids of query points."""

from dataclasses import dataclass

import numpy as np

from terrainloop.gp.kernel import Array


@dataclass(frozen=True)
class Grid:
    """A grid whose pixel (row, column) is at origin + resolution * (column, row).

    Attributes
    ----------
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    shape : tuple of int
        Rows (y) and columns (x).
    """

    origin: tuple[float, float]
    resolution: float
    shape: tuple[int, int]

    @property
    def x(self) -> Array:
        """Coordinates of the columns, metres."""
        return self.origin[0] + self.resolution * np.arange(self.shape[1], dtype=np.float64)

    @property
    def y(self) -> Array:
        """Coordinates of the rows, metres."""
        return self.origin[1] + self.resolution * np.arange(self.shape[0], dtype=np.float64)
