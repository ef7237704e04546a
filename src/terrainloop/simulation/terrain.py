"""Bare terrain as a height field."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from terrainloop.errors import TerrainLoopError
from terrainloop.resources import check_memory
from terrainloop.simulation import worlds
from terrainloop.simulation.names import WORLDS
from terrainloop.simulation.relief import Grid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """A height field.

    Attributes
    ----------
    height : array, (rows, columns), float32
        Height in metres; rows run along y, columns along x.
    resolution : float
        Distance between neighbouring nodes, in metres.
    origin : (float, float)
        World x and y of node (0, 0), in metres.
    """

    height: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float]

    def height_at(self, xy: ArrayLike) -> Array:
        """Bilinear height in metres at world points (..., 2); outside, that of the nearest border."""
        (corner, x, y), columns, nodes = self.cell_at(xy), self.height.shape[1], self.height.ravel()
        lower = nodes[corner] * (1 - x) + nodes[corner + 1] * x
        upper = nodes[corner + columns] * (1 - x) + nodes[corner + columns + 1] * x
        return np.asarray(lower * (1 - y) + upper * y)

    def cell_at(self, xy: ArrayLike) -> tuple[NDArray[np.int64], Array, Array]:
        """The cell between four nodes that contains world points (..., 2), or the nearest one.

        Returns the node of its low corner, counted along the rows, and how far beyond it along x and y the
        points are, 0 to 1.
        """
        xy = np.asarray(xy, dtype=float)
        rows, columns = self.height.shape
        x = np.clip((xy[..., 0] - self.origin[0]) / self.resolution, 0, columns - 1)
        y = np.clip((xy[..., 1] - self.origin[1]) / self.resolution, 0, rows - 1)
        column = np.minimum(x.astype(np.int64), columns - 2)
        row = np.minimum(y.astype(np.int64), rows - 2)
        return row * columns + column, x - column, y - row

    def slope_at(self, xy: ArrayLike) -> Array:
        """Gradient (..., 2) of the height at world points (..., 2), by central differences."""
        xy, step = np.asarray(xy, dtype=float), np.array([self.resolution, 0.0])
        along_x = self.height_at(xy + step) - self.height_at(xy - step)
        along_y = self.height_at(xy + step[::-1]) - self.height_at(xy - step[::-1])
        return np.stack([along_x, along_y], axis=-1) / (2 * self.resolution)

    def contains(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether world points (..., 2) are within the height field."""
        pixels = (np.asarray(xy, dtype=float) - self.origin) / self.resolution
        upper = np.array(self.height.shape[::-1]) - 1
        return np.asarray(((pixels >= 0) & (pixels <= upper)).all(axis=-1))

    @cached_property
    def ceiling(self) -> NDArray[np.float32]:
        """Greatest height within `CEILING_PIXELS` of each node: where a ray above it may stride."""
        return np.asarray(ndimage.maximum_filter(self.height, 2 * CEILING_PIXELS + 1, mode="nearest"))


CEILING_PIXELS = 10


_BYTES_PER_NODE = 130  # at the peak


def make_terrain(world: str, seed: int | SeedSequence, size_m: float, resolution: float) -> Terrain:
    """A square terrain about the world origin.

    Parameters
    ----------
    world : str
        One of `WORLDS`.
    seed : int or numpy.random.SeedSequence
        The same seed, world, size and resolution make the same terrain.
    size_m, resolution : float
        Side and node distance, in metres.

    Returns
    -------
    Terrain
        Not periodic within its extent, unless the world is one that repeats.

    Raises
    ------
    TerrainLoopError
        Unknown world, a size or resolution that is not positive, or more nodes than fit into the memory.
    """
    if world not in WORLDS:
        raise TerrainLoopError(
            expected="a world out of " + ", ".join(WORLDS), found=repr(world), mend="choose one of these"
        )
    if not (0 < resolution < size_m < np.inf):
        raise TerrainLoopError(
            expected="0 < resolution < size, in metres",
            found=f"resolution {resolution}, size {size_m}",
            mend="give a size of tens of metres and a resolution of centimetres",
        )
    grid = Grid(size=int(np.ceil(size_m / resolution)) + 1, resolution=resolution)
    check_memory(
        _BYTES_PER_NODE * grid.size**2,
        f"a terrain of {grid.size} x {grid.size} nodes",
        mend="simulate a shorter drive or a coarser terrain",
    )
    height = getattr(worlds, world)(np.random.default_rng(seed), grid)
    corner = -0.5 * grid.extent
    return Terrain((height - height.mean()).astype(np.float32), resolution, (corner, corner))
