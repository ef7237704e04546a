"""One map of a drive: the gradient maps of its submaps at their corrected poses, averaged."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from terrainloop.geometry import Array, transform
from terrainloop.gradient_map import GradientMap
from terrainloop.io.rasters import write_geotiff

MAX_PIXELS = 20_000_000  # of the mosaic; a larger one is made coarser


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Elevation and gradient in the world of the trajectory, rows along y and columns along x.

    Attributes
    ----------
    elevation, gradient_x, gradient_y : array, (rows, columns)
        Metres, and slopes along the axes of the world; NaN where no ground was observed.
    variance : array, (rows, columns)
        Of the elevation as each map states it, metres squared; not that of the poses.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    """

    elevation: NDArray[np.float32]
    gradient_x: NDArray[np.float32]
    gradient_y: NDArray[np.float32]
    variance: NDArray[np.float32]
    origin: tuple[float, float]
    resolution: float

    @property
    def mask(self) -> NDArray[np.bool_]:
        """True where ground was observed."""
        return np.isfinite(self.elevation)

    def write(self, path: Path | str) -> None:
        """Write a GeoTIFF with one band for each image."""
        bands = {name: getattr(self, name) for name in ("elevation", "gradient_x", "gradient_y", "variance")}
        write_geotiff(path, bands, self.origin, self.resolution, mask=self.mask)


def mosaic(maps: Sequence[GradientMap], poses: Array) -> Mosaic:
    """Average maps where they overlap, each weighted by the inverse of its variance.

    Parameters
    ----------
    maps : sequence of GradientMap
        At least one, M in all.
    poses : array, (M, 4, 4)
        T_world_submap; nearly upright, as submaps are.
    """
    outlines = [_outline(g, pose) for g, pose in zip(maps, poses, strict=True)]
    corners = np.concatenate(outlines)
    low, high = corners.min(axis=0), corners.max(axis=0)
    finest = float(np.median([g.resolution for g in maps]))
    resolution = max(finest, float(np.sqrt(np.prod(high - low + finest) / MAX_PIXELS)))
    columns, rows = np.ceil((high - low) / resolution).astype(int) + 1
    sums = np.zeros((4, rows, columns), dtype=np.float32)  # of the weights, and of what they weigh
    height = float(np.median([pose[2, 3] for pose in poses]))  # single precision is enough about it
    for g, pose, outline in zip(maps, poses, outlines, strict=True):
        first = np.floor((outline.min(axis=0) - low) / resolution).astype(int)
        last = np.minimum(np.ceil((outline.max(axis=0) - low) / resolution).astype(int) + 1, (columns, rows))
        window = (slice(first[1], last[1]), slice(first[0], last[0]))
        sums[(slice(None), *window)] += _weighted(
            g, pose, low + first * resolution, last - first, resolution, height
        )
    weight = np.where(sums[0] > 0, sums[0], np.nan)
    elevation, gradient_x, gradient_y = sums[1:] / weight
    return Mosaic(
        elevation + np.float32(height),
        gradient_x,
        gradient_y,
        np.asarray(1.0 / weight, dtype=np.float32),
        (float(low[0]), float(low[1])),
        resolution,
    )


def _outline(g: GradientMap, pose: Array) -> Array:
    """Corners (4, 2) of a map in the world."""
    rows, columns = g.mask.shape
    pixels = np.array([(0, 0), (columns - 1, 0), (columns - 1, rows - 1), (0, rows - 1)], dtype=float)
    xy = transform(g.metres_from_pixels, pixels)
    height = float(np.median(g.elevation[g.mask])) if g.mask.any() else 0.0
    return transform(pose, np.column_stack([xy, np.full(4, height)]))[:, :2]


def _weighted(
    g: GradientMap, pose: Array, origin: Array, size: Array, resolution: float, height: float
) -> NDArray[np.float32]:
    """Weight, and weight times elevation and gradient (4, rows, columns), on a window of the mosaic."""
    R, rows_columns = pose[:3, :3], np.indices(g.mask.shape)[::-1].astype(np.float32)
    x, y = (rows_columns.T * g.resolution + g.origin).T
    mean = float(np.median(g.elevation[g.mask])) if g.mask.any() else 0.0
    elevation = R[2, 0] * x + R[2, 1] * y + R[2, 2] * g.elevation + (pose[2, 3] - height)
    # A submap is upright but for a small tilt, which adds to its slopes.
    slopes = np.stack([g.gradient_x + R[2, 0], g.gradient_y + R[2, 1]])
    gradient_x, gradient_y = np.einsum("ij,jkl->ikl", R[:2, :2], slopes)
    weight = np.where(g.mask, 1.0 / np.where(g.mask, g.variance, 1.0), 0.0)
    planar = np.eye(3)
    planar[:2, :2], planar[:2, 2] = R[:2, :2], pose[:2, 3] + R[:2, 2] * mean
    from_world = np.linalg.inv(planar @ g.metres_from_pixels)
    lookup = from_world @ np.array([[resolution, 0, origin[0]], [0, resolution, origin[1]], [0, 0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    layers = [weight, *(weight * image for image in (elevation, gradient_x, gradient_y))]
    return np.stack(
        [
            cv2.warpAffine(layer.astype(np.float32), lookup[:2], tuple(int(n) for n in size), flags=flags)
            for layer in layers
        ]
    )
