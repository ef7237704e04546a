"""The gradient map: elevation, gradient and uncertainty of a submap, sampled as images."""

import io
import zipfile
import zlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.checks import check_positive
from terrainloop.gp.grid import Grid
from terrainloop.gp.hyperparameters import FIT_POINTS
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.process import ElevationProcess, Solver
from terrainloop.gp.training import TrainingData
from terrainloop.resources import check_memory, memory_errors
from terrainloop.submap import Submap

Image = NDArray[np.float32]

PIXELS_PER_LENGTH_SCALE = 6  # keeps the field's interpolation error below its noise
MAX_PIXELS = 20_000_000
BYTES_PER_PIXEL = 32  # at the peak, with the magnitude and temporary arrays (tests/test_memory.py)
_BAD_ZIP = (zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, eq=False)
class GradientMap:
    """A submap's terrain on a regular grid.

    All arrays are (rows, columns) float32 with rows along y and columns along x; pixel
    (row, column) is at ``origin + resolution * (column, row)`` in the frame of the cloud.

    Attributes
    ----------
    elevation : array
        Metres.
    gradient_x, gradient_y : array
        Slope along x and y, dimensionless.
    variance : array
        Of the elevation (I_v of the paper), metres squared.
    gradient_variance : array
        Of one gradient component (mean of the two), dimensionless.
    mask : array of bool
        True where the ground is known: the variance is a small part of the prior's.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    parameters : Hyperparameters
        Of the Gaussian process that made the map.
    """

    elevation: Image
    gradient_x: Image
    gradient_y: Image
    variance: Image
    gradient_variance: Image
    mask: NDArray[np.bool_]
    origin: tuple[float, float]
    resolution: float
    parameters: Hyperparameters

    @cached_property
    def magnitude(self) -> Image:
        """Length of the gradient (I_g of the paper), dimensionless."""
        return np.hypot(self.gradient_x, self.gradient_y)

    @classmethod
    def from_points(
        cls,
        points: ArrayLike | Submap,
        length_scale: float | None = None,
        variance: float | None = None,
        noise: float | ArrayLike | None = None,
        resolution: float | None = None,
        *,
        origin: tuple[float, float] | None = None,
        shape: tuple[int, int] | None = None,
        max_points: int | None = None,
        fit_points: int | None = FIT_POINTS,
        remove_plane: bool = True,
        local_noise: bool = True,
        solver: Solver = "spline",
        max_variance_ratio: float = 0.25,
        seed: int = 0,
        workers: int = 1,
        max_memory: float | None = None,
    ) -> "GradientMap":
        """Gaussian-process map of a cloud, over its bounding box in x and y.

        Parameters
        ----------
        points : array_like, (N, 3), or Submap
            Gravity-aligned points, metres.
        length_scale, variance : float, optional
            Of the process (see `Hyperparameters`): metres, metres squared. What is not given is fitted
            to this cloud.
        noise : float or array_like, (N,), optional
            Standard deviation of the elevations, metres: one number, or one for each point.
        resolution : float, optional
            Metres per pixel; a sixth of the length scale if not given.
        origin : tuple of float, optional
            (x, y) of pixel (0, 0), metres; the low corner of the bounding box if not given.
        shape : tuple of int, optional
            Rows (y) and columns (x); as far as the bounding box reaches if not given.
        max_points : int, optional
            Drawn at random if the cloud has more; all are used if not given.
        fit_points : int or None
            Of these, drawn for the fit; None: all (see `fit_hyperparameters`).
        remove_plane : bool
            Subtract the best plane before and add its slope back after.
        local_noise : bool
            Scale each point's noise by the scatter and the number of the points around it (see
            `terrainloop.gp.spline.noise_ratio`); not done where noise is given for each point.
        solver : str
            "spline" takes every point; "exact" is dense, for some thousands of points.
        max_variance_ratio : float
            Ground counts as known where its variance is below this share of the prior's.
        seed : int
            Seed of the random draws.
        workers : int
            Threads; the result does not depend on it.
        max_memory : float, optional
            Bytes that the map may take while it is made; what the machine has available if not given.

        Raises
        ------
        TerrainLoopError
            If the points do not make a submap, a number is impossible, the map would not fit into memory,
            or the equations cannot be solved.
        """
        check_positive(resolution=resolution, max_memory=max_memory, max_variance_ratio=max_variance_ratio)
        process = ElevationProcess.from_points(
            points,
            length_scale,
            variance,
            noise,
            max_points=max_points,
            fit_points=fit_points,
            remove_plane=remove_plane,
            local_noise=local_noise,
            solver=solver,
            seed=seed,
            workers=workers,
        )
        parameters = process.parameters
        if resolution is None:
            resolution = parameters.length_scale / PIXELS_PER_LENGTH_SCALE
        grid = _grid(process.data, float(resolution), origin, shape)
        _check_memory(process, grid, max_memory)
        field = process.predict_grid(grid.origin, grid.resolution, grid.shape)
        with memory_errors("a gradient map"):
            images = {name: image.astype(np.float32, copy=False) for name, image in vars(field).items()}
            return cls(
                **images,
                mask=field.variance < np.float32(max_variance_ratio * parameters.variance),
                origin=grid.origin,
                resolution=grid.resolution,
                parameters=parameters,
            )

    def save(self, path: Path | str) -> None:
        """Write every array and number of the map to an ``.npz`` file."""
        content = {field.name: getattr(self, field.name) for field in fields(self)}
        content |= {"magnitude": self.magnitude, "parameters": np.array(_values(self.parameters))}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **content)
        Path(path).write_bytes(buffer.getvalue())

    @classmethod
    def load(cls, path: Path | str) -> "GradientMap":
        """Read a map that `save` wrote.

        Raises
        ------
        TerrainLoopError
            If the file is no such map.
        """
        try:
            with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
                content = {field.name: file[field.name] for field in fields(cls)}
            content["origin"] = tuple(content["origin"].tolist())
            content["resolution"] = float(content["resolution"])
            content["parameters"] = Hyperparameters(*content["parameters"].tolist())
            return cls(**content)
        except (OSError, ValueError, LookupError, EOFError, TypeError, AttributeError, *_BAD_ZIP) as error:
            raise TerrainLoopError(
                expected=f"a gradient map in {path}",
                found=" ".join(str(error).split()),
                mend="make one with 'terrainloop map CLOUD -o map.npz'",
            ) from error


def _grid(
    data: TrainingData,
    resolution: float,
    origin: tuple[float, float] | None,
    shape: tuple[int, int] | None,
) -> Grid:
    """The grid of a map; by default it covers the points' bounding box."""
    low, high = data.xy.min(axis=0) + data.centre[:2], data.xy.max(axis=0) + data.centre[:2]
    corner = low if origin is None else _pair("origin", origin, np.float64)
    if shape is None:
        sizes = np.maximum(np.floor((high - corner) / resolution + 1e-9) + 1, 0)
    else:
        sizes = _pair("shape", shape, np.int64)[::-1]
    if not (sizes > 0).all() or not np.isfinite(corner).all():
        raise TerrainLoopError(
            expected="a grid of at least one pixel that begins below the points' upper corner",
            found=f"{sizes[0]:.0f} x {sizes[1]:.0f} pixels from {corner.tolist()}; the points end at "
            f"{high.tolist()}",
            mend="change origin or shape, or leave them out",
        )
    if not float(sizes[0]) * float(sizes[1]) <= MAX_PIXELS:
        raise TerrainLoopError(
            expected=f"a map of at most {MAX_PIXELS / 1e6:.0f} million pixels",
            found=f"{sizes[0]:.4g} x {sizes[1]:.4g} of {resolution:.3g} m for {data.extent_in_words}",
            mend="remove far outlier points, or make the resolution coarser",
        )
    width, height = (int(size) for size in sizes)
    return Grid((float(corner[0]), float(corner[1])), resolution, (height, width))


def _pair(name: str, value: ArrayLike, dtype: type[np.generic]) -> NDArray[Any]:
    """Two numbers of a kind."""
    try:
        given = np.asarray(value)
        pair = given.astype(dtype)
    except (ValueError, TypeError, OverflowError):
        given = pair = np.empty(0)
    if pair.shape != (2,) or given.dtype.kind not in ("iu" if dtype is np.int64 else "iuf"):
        raise TerrainLoopError(
            expected=f"an {name} of two numbers" if name == "origin" else f"a {name} of two whole numbers",
            found=f"{value!r:.80}",
            mend=f"give {'(x, y)' if name == 'origin' else '(rows, columns)'}, or leave it out",
        )
    return pair


def _check_memory(process: ElevationProcess, grid: Grid, limit: float | None) -> None:
    """Refuse a map that would not fit into memory, before it is begun."""
    pixels = grid.shape[0] * grid.shape[1]
    needed = process.memory_for(pixels) + (BYTES_PER_PIXEL - 20) * pixels
    check_memory(needed, f"a map of {grid.shape[1]} x {grid.shape[0]} pixels", limit)


def _values(parameters: Hyperparameters) -> list[float]:
    return [parameters.length_scale, parameters.variance, parameters.noise]
