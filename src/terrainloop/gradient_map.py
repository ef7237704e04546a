"""The gradient map: elevation, gradient and uncertainty of a submap, sampled as images."""

import io
import zipfile
import zlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.hyperparameters import FIT_POINTS
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.process import ElevationProcess, Solver, check_positive
from terrainloop.gp.surface import Surface
from terrainloop.submap import Submap

Image = NDArray[np.float32]

PIXELS_PER_LENGTH_SCALE = 6  # keeps the field's interpolation error below its noise
MAX_PIXELS = 20_000_000
FAR = 10.0  # radii of the map, from which its frame's origin is no longer near it
_BAD_ZIP = (zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, eq=False)
class GradientMap:
    """A submap's terrain on a regular grid.

    All arrays are (rows, columns) float32 with rows along y and columns along x; pixel
    (row, column) lies at ``origin + resolution * (column, row)`` in the frame of the cloud.

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

    @property
    def metres_from_pixels(self) -> Array:
        """Affine map (3, 3) from (column, row) to metres."""
        (x, y), r = self.origin, self.resolution
        return np.array([[r, 0.0, x], [0.0, r, y], [0.0, 0.0, 1.0]])

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
            Take the best plane out before and give its slope back after.
        local_noise : bool
            Scale each point's noise by the scatter and the number of the points around it (see
            `terrainloop.gp.spline.noise_ratio`); not done where noise is given for each point.
        solver : str
            "spline" takes every point; "exact" is dense, for some thousands of points.
        max_variance_ratio : float
            Ground counts as known where its variance is below this share of the prior's.
        seed : int
            Of the draw.
        workers : int
            Threads; the result does not depend on it.

        Raises
        ------
        TerrainLoopError
            If the points make no submap, a number is impossible, the grid would be absurdly large, or
            the equations cannot be solved.
        """
        check_positive(resolution=resolution)
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
        origin, shape = _grid(process.surface, resolution, origin, shape)
        field = process.predict_grid(origin, resolution, shape)
        images = {name: image.astype(np.float32, copy=False) for name, image in vars(field).items()}
        return cls(
            **images,
            mask=field.variance < np.float32(max_variance_ratio * parameters.variance),
            origin=origin,
            resolution=float(resolution),
            parameters=parameters,
        )

    @property
    def local_origin(self) -> Array:
        """Point (3,) near the map that its loops' covariances refer to, metres.

        It is zero, the origin of the submap's frame, unless that is more than `FAR` times the map's radius
        away (UTM): there a rotation of a microradian moves the origin by metres, and a covariance of the
        transform cannot be inverted. Then it is the middle of the map, in whole metres.
        """
        rows, columns = self.mask.shape
        half = self.resolution * np.array([columns - 1, rows - 1]) / 2
        height = float(np.median(self.elevation[self.mask])) if self.mask.any() else 0.0
        middle = np.array([*(np.array(self.origin) + half), height])
        return np.round(middle) if np.hypot(*middle[:2]) > FAR * np.hypot(*half) else np.zeros(3)

    def to_bytes(self) -> bytes:
        """The map as the bytes of an ``.npz`` file."""
        content = {field.name: getattr(self, field.name) for field in fields(self)}
        content |= {"magnitude": self.magnitude, "parameters": np.array(_values(self.parameters))}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **content)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> "GradientMap":
        """The map that `to_bytes` wrote.

        Raises
        ------
        TerrainLoopError
            If the bytes are no such map.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                content = {field.name: file[field.name] for field in fields(cls)}
            content["origin"] = tuple(content["origin"].tolist())
            content["resolution"] = float(content["resolution"])
            content["parameters"] = Hyperparameters(*content["parameters"].tolist())
            return cls(**content)
        except (ValueError, LookupError, EOFError, TypeError, AttributeError, OSError, *_BAD_ZIP) as error:
            raise TerrainLoopError(
                expected="a gradient map",
                found=" ".join(str(error).split()),
                mend="make one with 'terrainloop map CLOUD -o map.npz'",
            ) from error

    def save(self, path: Path | str) -> None:
        """Write every array and number of the map to an ``.npz`` file."""
        Path(path).write_bytes(self.to_bytes())

    @classmethod
    def load(cls, path: Path | str) -> "GradientMap":
        """Read a map that `save` wrote.

        Raises
        ------
        TerrainLoopError
            If the file is no such map.
        """
        try:
            return cls.from_bytes(Path(path).read_bytes())
        except (OSError, TerrainLoopError) as error:
            raise TerrainLoopError(
                expected=f"a gradient map in {path}",
                found=getattr(error, "found", " ".join(str(error).split())),
                mend="make one with 'terrainloop map CLOUD -o map.npz'",
            ) from error


def _grid(
    surface: Surface,
    resolution: float,
    origin: tuple[float, float] | None,
    shape: tuple[int, int] | None,
) -> tuple[tuple[float, float], tuple[int, int]]:
    """Origin and shape of the grid; by default it covers the points' bounding box."""
    low, high = surface.xy.min(axis=0) + surface.centre[:2], surface.xy.max(axis=0) + surface.centre[:2]
    corner = low if origin is None else np.asarray(origin, dtype=np.float64)
    if shape is None:
        width, height = (int(n) for n in np.maximum(np.floor((high - corner) / resolution + 1e-9) + 1, 0))
    else:
        height, width = shape
    if width <= 0 or height <= 0 or not np.isfinite(corner).all():
        raise TerrainLoopError(
            expected="a grid of at least one pixel that begins below the points' upper corner",
            found=f"{width} x {height} pixels from {corner.tolist()}; the points end at {high.tolist()}",
            mend="change origin or shape, or leave them out",
        )
    if width * height > MAX_PIXELS:
        raise TerrainLoopError(
            expected=f"a map of at most {MAX_PIXELS / 1e6:.0f} million pixels",
            found=f"{width} x {height} of {resolution:.3g} m ({21e-9 * width * height:.1f} GB) for "
            f"{surface.extent_in_words}",
            mend="remove far outlier points, or make the resolution coarser",
        )
    return (float(corner[0]), float(corner[1])), (height, width)


def _values(parameters: Hyperparameters) -> list[float]:
    return [parameters.length_scale, parameters.variance, parameters.noise]
