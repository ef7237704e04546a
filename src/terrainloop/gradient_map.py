"""The gradient map: elevation, gradient and uncertainty of a submap, sampled as images."""

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrainloop.errors import TerrainLoopError
from terrainloop.gp.exact import predict_grid
from terrainloop.gp.hyperparameters import BLOCK_POINTS, maximise_likelihood
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gp.surface import surface_of
from terrainloop.submap import Submap

Image = NDArray[np.float32]

PIXELS_PER_LENGTH_SCALE = 6  # keeps the field's interpolation error below its noise
MAX_PIXELS = 20_000_000
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

    @classmethod
    def from_points(
        cls,
        points: ArrayLike | Submap,
        length_scale: float | None = None,
        variance: float | None = None,
        noise: float | None = None,
        resolution: float | None = None,
        *,
        max_points: int = 5000,
        remove_plane: bool = True,
        max_variance_ratio: float = 0.25,
        seed: int = 0,
        workers: int = 1,
    ) -> "GradientMap":
        """Gaussian-process map of a cloud, over its bounding box in x and y.

        Parameters
        ----------
        points : array_like, (N, 3), or Submap
            Gravity-aligned points, metres.
        length_scale, variance, noise : float, optional
            Of the process (see `Hyperparameters`): metres, metres squared, metres. Those not given
            are fitted to this cloud.
        resolution : float, optional
            Metres per pixel; a sixth of the length scale if not given.
        max_points : int
            Drawn at random if the cloud has more.
        remove_plane : bool
            Take the best plane out before and give its slope back after.
        max_variance_ratio : float
            Ground counts as known where its variance is below this share of the prior's.
        seed : int
            Of the draw.
        workers : int
            Threads; the result does not depend on it.

        Raises
        ------
        TerrainLoopError
            If the points make no submap, or the grid would be absurdly large.
        """
        surface = surface_of(points, max_points=max_points, remove_plane=remove_plane, seed=seed)
        given = {"length_scale": length_scale, "variance": variance, "noise": noise}
        _check_positive(given | {"resolution": resolution})
        fixed = [name for name, value in given.items() if value is not None]
        parameters = surface.start(**given)
        if len(fixed) < len(given):
            blocks = surface.blocks(BLOCK_POINTS)
            parameters = maximise_likelihood(blocks, parameters, fixed=fixed, workers=workers)
        if resolution is None:
            resolution = parameters.length_scale / PIXELS_PER_LENGTH_SCALE
        x, y = _axes(surface.xy, resolution)
        field = predict_grid(surface.xy, surface.elevation, parameters, x, y, workers=workers)
        plane = surface.centre[2] + surface.slope[0] * x + surface.slope[1] * y[:, None]
        return cls(
            elevation=(field.elevation + plane).astype(np.float32),
            gradient_x=(field.gradient_x + surface.slope[0]).astype(np.float32),
            gradient_y=(field.gradient_y + surface.slope[1]).astype(np.float32),
            variance=field.variance.astype(np.float32),
            gradient_variance=field.gradient_variance.astype(np.float32),
            mask=field.variance < max_variance_ratio * parameters.variance,
            origin=(float(x[0] + surface.centre[0]), float(y[0] + surface.centre[1])),
            resolution=float(resolution),
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


def _axes(xy: NDArray[np.float64], resolution: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Grid coordinates that cover the points' bounding box."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    width, height = (int(n) for n in np.floor((high - low) / resolution + 1e-9) + 1)
    if width * height > MAX_PIXELS:
        raise TerrainLoopError(
            expected=f"a map of at most {MAX_PIXELS / 1e6:.0f} million pixels",
            found=f"{width} x {height} for an extent of {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m "
            f"at {resolution:.3g} m per pixel",
            mend="remove far outlier points, or make the resolution coarser",
        )
    return low[0] + resolution * np.arange(width), low[1] + resolution * np.arange(height)


def _check_positive(numbers: Mapping[str, float | None]) -> None:
    for name, value in numbers.items():
        if value is not None and not 0 < value < np.inf:
            raise TerrainLoopError(
                expected=f"a positive {name}", found=f"{value}", mend="leave it out to have it derived"
            )


def _values(parameters: Hyperparameters) -> list[float]:
    return [parameters.length_scale, parameters.variance, parameters.noise]
