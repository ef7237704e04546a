"""The gradient field of a map, made ready to be compared, and how well two agree at a pose.

The gradient of the ground is a vector at every place; a yaw turns all of them. Where two maps show the
same ground, turning and shifting one makes the vectors agree, everywhere at once.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from terrainloop import _core
from terrainloop.geometry import Array, inverse, transform
from terrainloop.gradient_map import GradientMap

FLOOR = 0.3  # of the mean power: waves below it are not raised, for they may be noise
CLIP = 1.5  # robust standard deviations at which a vector is drawn in to 0.7 of itself
RAYLEIGH_MEDIAN = 1.18  # length of a vector of two normal components
SPECTRUM_SMOOTHING = 1.5  # cycles per width of the map
TINY = float(np.finfo(np.float32).tiny)

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Field:
    """A gradient field on a coarse grid: mean out, weighted by its variance, whitened, clipped.

    Attributes
    ----------
    x, y : array, (rows, columns)
        Gradient, zero where the ground is not known.
    known : array, (rows, columns)
        1 where the ground is known, else 0.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    spacing : float
        Metres per pixel.
    """

    x: Image
    y: Image
    known: Image
    origin: tuple[float, float]
    spacing: float

    @property
    def metres_from_pixels(self) -> Array:
        """Affine map (3, 3) from (column, row) to metres."""
        x, y = self.origin
        return np.array([[self.spacing, 0.0, x], [0.0, self.spacing, y], [0.0, 0.0, 1.0]])

    @property
    def ground(self) -> Array:
        """Middles (N, 2) of the known pixels, metres."""
        return transform(self.metres_from_pixels, np.argwhere(self.known)[:, ::-1].astype(float))

    @cached_property
    def across(self) -> int:
        """Pixels of a square that holds the known ground at every rotation about its middle."""
        ground = self.ground / self.spacing
        return int(np.ceil(2 * np.hypot(*(ground - ground.mean(axis=0)).T).max())) + 4 if len(ground) else 0


@dataclass(frozen=True)
class Agreement:
    """How two fields agree at a pose.

    Attributes
    ----------
    correlation : float
        Sum of scalar products over the root of the product of energies, -1 to 1.
    area : float
        Shared ground, m^2.
    """

    correlation: float
    area: float


def field_of(gradient_map: GradientMap, spacing: float) -> Field:
    """The field of a map, averaged over pixels of `spacing` metres.

    The mean slope goes out, since gravity is never known exactly, and gradients count less where their
    variance is high. Then the spectrum is flattened, for waves that stand out of it, such as ripples
    or a long slope, tell least about the place; and vectors that are still long are drawn in, so that
    no single crest decides.

    Parameters
    ----------
    gradient_map : GradientMap
    spacing : float
        Metres, not below the map's resolution.
    """
    mask, variance = gradient_map.mask, gradient_map.gradient_variance
    weight = mask / (1.0 + variance / max(_median(variance, mask), TINY))
    x, y = (
        image - np.average(image, weights=weight) if mask.any() else image
        for image in (gradient_map.gradient_x, gradient_map.gradient_y)
    )
    step = spacing / gradient_map.resolution
    rows, columns = (int(np.ceil((n - 1) / step)) + 1 for n in mask.shape)
    every_step = np.array([[step, 0.0, 0.0], [0.0, step, 0.0]])

    def average(image: NDArray[Any]) -> Image:
        sigma = max(0.4 * step, 0.3)
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        return _warp(np.asarray(smooth, dtype=np.float32), every_step, (columns, rows), cv2.INTER_LINEAR)

    ground = average(mask)
    known = (ground > 0.5).astype(np.float32)
    share = np.asarray(known / np.maximum(ground, 0.5), dtype=np.float32)
    white = _whitened(average(x * weight) * share, average(y * weight) * share, known)
    return Field(*_clipped(*white, known), known, gradient_map.origin, spacing)


def turn_field(field: Field, affine: Array, size: tuple[int, int]) -> tuple[Image, Image, Image]:
    """x, y and known ground of a field under an affine map (3, 3) of its pixels, vectors turned along.

    Parameters
    ----------
    field : Field
    affine : array, (3, 3)
        From (column, row) of the result to (column, row) of the field; a rotation but for its scale.
    size : tuple of int
        Columns and rows of the result.
    """
    columns, rows = size
    x, y, known = _core.turn_field(field.x, field.y, field.known, affine, rows=rows, cols=columns)
    return x, y, known


def agreement_at(source: Field, target: Field, T_target_source: Array) -> Agreement:
    """How two fields agree at a pose.

    Parameters
    ----------
    source, target : Field
    T_target_source : array, (3, 3)
        SE(2).
    """
    lookup = np.linalg.inv(source.metres_from_pixels) @ inverse(T_target_source) @ target.metres_from_pixels
    x, y, known = turn_field(source, lookup, target.known.shape[::-1])
    both = (known > 0) & (target.known > 0)
    x, y, u, v = (image[both].astype(float) for image in (x, y, target.x, target.y))
    energy = (x @ x + y @ y) * (u @ u + v @ v)
    correlation = float((u @ x + v @ y) / np.sqrt(energy)) if energy > 0 else 0.0
    return Agreement(correlation, float(both.sum()) * target.spacing**2)


def _whitened(x: Image, y: Image, known: Image) -> tuple[Image, Image]:
    """The field through the filter 1 / sqrt(P + FLOOR mean P), with P its smoothed power spectrum."""
    width = max(x.shape)
    size = fft.next_fast_len(2 * width, real=True)
    spectra = fft.rfft2(np.stack([x, y]), s=(size, size))
    correlation = fft.irfft2((np.abs(spectra) ** 2).sum(axis=0), s=(size, size))
    lags = np.minimum(np.arange(size), size - np.arange(size))
    window = np.exp(-0.5 * (2 * np.pi * SPECTRUM_SMOOTHING / width * lags) ** 2).astype(
        np.float32
    )  # smoothes the spectrum
    power = np.maximum(fft.rfft2(correlation * window * window[:, None]).real, 0.0)
    power += max(FLOOR * float(power.mean()), TINY)
    white_x, white_y = fft.irfft2(spectra / np.sqrt(power), s=(size, size))[:, : x.shape[0], : x.shape[1]]
    return white_x * known, white_y * known


def _clipped(x: Image, y: Image, known: Image) -> tuple[Image, Image]:
    length = np.hypot(x, y)
    clip = CLIP * max(_median(length, known > 0) / RAYLEIGH_MEDIAN, 1e-6 * float(length.max()), TINY)
    drawn_in = (1.0 / np.sqrt(1.0 + (length / clip) ** 2)).astype(np.float32)
    return x * drawn_in, y * drawn_in


def _warp(image: Image, affine: Array, size: tuple[int, int], interpolation: int) -> Image:
    warped = cv2.warpAffine(image, affine[:2], size, flags=interpolation | cv2.WARP_INVERSE_MAP)
    return np.asarray(warped, dtype=np.float32)


def _median(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
    return float(np.median(values[mask])) if mask.any() else 0.0
