"""The gradient map: elevation, gradient and uncertainty of a submap, sampled as images."""

import io
import math
import zipfile
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.arrays import ReadOnlyArrays, read_only
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.checks import check_positive
from terrainloop.gp.grid import Grid
from terrainloop.gp.hyperparameters import FIT_POINTS
from terrainloop.gp.kernel import Array, Hyperparameters
from terrainloop.gp.process import MAX_LENGTH_SCALES, ElevationProcess, Solver
from terrainloop.gp.training import Points, TrainingData
from terrainloop.io.files import as_path, write_whole
from terrainloop.io.npz import pack, read_member
from terrainloop.resources import check_memory, memory_errors

Image = NDArray[np.float32]

PIXELS_PER_LENGTH_SCALE = 6  # keeps the field's interpolation error below its noise
MAX_PIXELS = 20_000_000
MAX_BYTES = 4 * MAX_PIXELS + 4096  # of one image as a file holds it
BYTES_PER_PIXEL = 32  # at the peak, with the magnitude and temporary arrays (tests/test_memory.py)
FAR = 10.0  # radii of the map, from which its frame's origin is no longer near it

_IMAGES = ("elevation", "gradient_x", "gradient_y", "variance", "gradient_variance")
_LARGEST = 1e12  # of any number of a map: its square is far from the end of single precision
_FINEST = 1e4  # pixels per length scale; filters of that width are slow, and have no use
_MAKE_ONE = "make one with 'terrainloop map CLOUD -o map.npz'"
_LITTLE = 0.05  # share of observed pixels below which something is wrong with the points


@dataclass(frozen=True, eq=False, repr=False)
class GradientMap(ReadOnlyArrays):
    """A submap's terrain on a regular grid.

    All arrays are read-only (rows, columns) float32 with rows along y and columns along x; pixel
    (row, column) is at ``origin + resolution * (column, row)`` in the frame of the cloud.

    Attributes
    ----------
    elevation : array
        Metres.
    gradient_x, gradient_y : array
        Slope along x and y, dimensionless.
    variance : array
        Variance of the elevation (I_v of the paper), metres squared.
    gradient_variance : array
        Variance of one gradient component (mean of the two), dimensionless.
    mask : array of bool
        True where the ground is known: the variance is a small part of the prior's.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    resolution : float
        Metres per pixel.
    parameters : Hyperparameters
        Hyperparameters of the Gaussian process that made the map.

    Raises
    ------
    TerrainLoopError
        If these do not make a map: shapes or types that differ, numbers that are not finite, variances that
        are not positive where the mask is true, or a length scale, resolution or origin that is impossible.
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

    def __post_init__(self) -> None:
        for name in _IMAGES:
            object.__setattr__(self, name, read_only(_image(name, getattr(self, name))))
        mask = np.asarray(self.mask)
        _require(mask.dtype == bool, "a mask of booleans", str(mask.dtype))
        shapes = {getattr(self, name).shape for name in _IMAGES} | {mask.shape}
        _require(len(shapes) == 1, "arrays of one shape", ", ".join(sorted(map(str, shapes))))
        _require(mask.ndim == 2 and 0 < mask.size <= MAX_PIXELS, "arrays (rows, columns)", str(mask.shape))
        for name in ("variance", "gradient_variance"):
            lowest = np.min(getattr(self, name), where=mask, initial=1.0)
            _require(lowest > 0, f"a positive {name} where the mask is true", f"{lowest:.3g}")
        origin = tuple(_number("origin", value) for value in np.ravel(self.origin))
        _require(len(origin) == 2, "an origin (x, y)", f"{len(origin)} numbers")
        resolution = _number("resolution", self.resolution)
        _require(isinstance(self.parameters, Hyperparameters), "Hyperparameters", repr(self.parameters)[:60])
        length_scale = _number("length_scale", self.parameters.length_scale)
        positive = [resolution, *(_number(name, value) for name, value in vars(self.parameters).items())]
        _require(min(positive) > 0, "positive parameters and resolution", f"{min(positive):.3g}")
        area = mask.size * (resolution / length_scale) ** 2
        limit = f"at most {MAX_LENGTH_SCALES:.0e} squares of the length scale"
        _require(area <= MAX_LENGTH_SCALES, limit, f"{area:.3g}")
        pixels = length_scale / resolution
        _require(pixels <= _FINEST, f"at most {_FINEST:.0e} pixels within a length scale", f"{pixels:.3g}")
        object.__setattr__(self, "mask", read_only(mask))
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "resolution", resolution)

    def __repr__(self) -> str:
        rows, columns = self.mask.shape
        return (
            f"GradientMap({columns} x {rows} pixels of {self.resolution:.3g} m, "
            f"{100 * self.mask.mean():.0f} % observed, length scale {self.parameters.length_scale:.3g} m)"
        )

    @cached_property
    def magnitude(self) -> Image:
        """Length of the gradient (I_g of the paper), dimensionless."""
        return read_only(np.hypot(self.gradient_x, self.gradient_y))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(x_min, x_max, y_min, y_max) of the outer edges of the pixels, metres, as Matplotlib takes it."""
        rows, columns = self.mask.shape
        (x, y), half = self.origin, 0.5 * self.resolution
        return x - half, x + (columns - 0.5) * self.resolution, y - half, y + (rows - 0.5) * self.resolution

    @property
    def warnings(self) -> tuple[str, ...]:
        """What casts doubt on the map, in words: little of the ground observed, and the likely cause."""
        observed = float(self.mask.mean())
        if observed >= _LITTLE:
            return ()
        relief, noise = math.sqrt(self.parameters.variance), self.parameters.noise
        cause = (
            f"heights scatter by {noise:.2g} m, the ground by {relief:.2g} m, as if this were no surface"
            if noise > relief
            else "the points are too few for ground that varies so fast"
        )
        return (
            f"only {100 * observed:.0f} % of the map is observed: {cause} "
            f"(length scale {self.parameters.length_scale:.2g} m)",
        )

    @property
    def metres_from_pixels(self) -> Array:
        """Affine map (3, 3) from (column, row) to metres."""
        (x, y), r = self.origin, self.resolution
        return np.array([[r, 0.0, x], [0.0, r, y], [0.0, 0.0, 1.0]])

    @classmethod
    def from_points(
        cls,
        points: Points,
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
        points : array_like, (N, 3), Submap, or TrainingData
            Gravity-aligned points, metres; or what `terrainloop.gp.training.detrend` made of them.
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
            Points of these drawn for the fit; None: all (see `fit_hyperparameters`).
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

    def plot(self) -> Any:
        """A matplotlib Figure of the elevation, its standard deviation and the gradients.

        Raises
        ------
        TerrainLoopError
            If matplotlib is not installed.
        """
        return import_module("terrainloop.report.figures").figure_map(None, self)

    @property
    def local_origin(self) -> Array:
        """Point (3,) near the map that its loops' covariances refer to, metres.

        It is zero, the origin of the submap's frame, unless that is more than `FAR` times the map's radius
        away (UTM): there a rotation of a microradian moves the origin by metres, and a covariance of the
        transform cannot be inverted. Then it is the middle of the map, in whole metres.
        """
        rows, columns = self.mask.shape
        half = self.resolution * np.array([columns - 1, rows - 1]) / 2
        middle = np.array(self.origin) + half
        if np.hypot(*middle) <= FAR * np.hypot(*half):
            return np.zeros(3)
        height = float(np.median(self.elevation[self.mask])) if self.mask.any() else 0.0
        return np.round([*middle, height])

    def to_bytes(self) -> bytes:
        """The map as the bytes of an ``.npz`` file."""
        content: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        content |= {"magnitude": self.magnitude, "parameters": astuple(self.parameters)}
        return pack(content, compress=True)

    @classmethod
    def from_bytes(cls, data: bytes) -> "GradientMap":
        """The map that `to_bytes` wrote.

        Raises
        ------
        TerrainLoopError
            If the bytes are not such a map, or their content is not valid.
        """
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                content: dict[str, Any] = {
                    field.name: read_member(archive, field.name, MAX_BYTES, kinds="fb")
                    for field in fields(cls)
                }
            content["parameters"] = Hyperparameters(*content["parameters"].tolist())
            return cls(**content)
        except TerrainLoopError as error:
            raise TerrainLoopError(
                expected=f"a gradient map with {error.expected}", found=error.found, mend=_MAKE_ONE
            ) from error
        except Exception as error:  # what zipfile raises on damaged files is not documented
            found = " ".join(str(error).split()) or type(error).__name__
            raise TerrainLoopError(expected="a gradient map", found=found[:120], mend=_MAKE_ONE) from error

    def save(self, path: Path | str) -> None:
        """Write every array and number of the map to an ``.npz`` file, completely or not at all."""
        write_whole(as_path(path, "a gradient map"), lambda file: file.write(self.to_bytes()))

    @classmethod
    def load(cls, path: Path | str) -> "GradientMap":
        """Read a map that `save` wrote.

        Raises
        ------
        TerrainLoopError
            If the file is not such a map, or its content is not valid.
        """
        path = as_path(path, "a gradient map")
        try:
            if not path.is_file():
                raise FileNotFoundError("no file" if not path.exists() else "not a regular file")
            return cls.from_bytes(path.read_bytes())
        except OSError as error:
            raise TerrainLoopError(
                expected=f"a gradient map in {path}", found=str(error), mend=_MAKE_ONE
            ) from error
        except TerrainLoopError as error:
            raise TerrainLoopError(
                expected=f"{error.expected} in {path}", found=error.found, mend=_MAKE_ONE
            ) from error


def _require(met: bool | np.bool_, expected: str, found: str) -> None:
    if not met:
        raise TerrainLoopError(
            expected=expected, found=found, mend="make the map with GradientMap.from_points"
        )


def _image(name: str, values: ArrayLike) -> Image:
    array = np.asarray(values)
    _require(array.dtype.kind == "f", f"floating-point numbers as {name}", str(array.dtype)[:60])
    within = bool((np.abs(array) <= _LARGEST).all())  # False for NaN too
    _require(within, f"finite numbers as {name}, also outside the mask", "NaN, infinity or more than 1e12")
    return array.astype(np.float32, copy=False)


def _number(name: str, value: Any) -> float:
    number = isinstance(value, int | float | np.integer | np.floating | np.ndarray) and np.size(value) == 1
    _require(number, f"a number as {name}", repr(value)[:60])
    _require(bool(np.abs(value) <= _LARGEST), f"a finite {name}", repr(value)[:60])
    return float(np.asarray(value).item())


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
