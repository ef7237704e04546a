"""The gradient field of a map, prepared for correlation.

The gradient of the ground is a vector at every position; a yaw rotates all of them. Where two maps show the
same ground, one rotation and shift makes all vectors agree at once.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from terrainloop import _core
from terrainloop.config import Calibration
from terrainloop.geometry import Array, transform
from terrainloop.gradient_map import GradientMap

RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))  # median length of a vector of two standard normal components
TINY = float(np.finfo(np.float32).tiny)

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Field:
    """A gradient field on a coarse grid: mean subtracted, weighted by its variance, whitened, soft-clipped.

    Attributes
    ----------
    x, y : array, (rows, columns)
        Gradient, zero where the ground was not observed.
    valid : array, (rows, columns)
        1 where the ground was observed, else 0.
    origin : tuple of float
        (x, y) of pixel (0, 0), metres.
    spacing : float
        Metres per pixel.
    length_scale : float
        Length scale of the Gaussian process of the map, metres.
    """

    x: Image
    y: Image
    valid: Image
    origin: tuple[float, float]
    spacing: float
    length_scale: float

    @property
    def metres_from_pixels(self) -> Array:
        """Affine map (3, 3) from (column, row) to metres."""
        x, y = self.origin
        return np.array([[self.spacing, 0.0, x], [0.0, self.spacing, y], [0.0, 0.0, 1.0]])

    @cached_property
    def positions(self) -> Array:
        """Centres (N, 2) of the valid pixels, metres."""
        return transform(self.metres_from_pixels, np.argwhere(self.valid)[:, ::-1].astype(float))

    @cached_property
    def centre(self) -> Array:
        """Centroid (2,) of the observed area, metres."""
        return self.positions.mean(axis=0) if len(self.positions) else np.array(self.origin)

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the observed area from its centroid, metres."""
        squares = ((self.positions - self.centre) ** 2).sum()
        return float(np.sqrt(squares / max(len(self.positions), 1)))

    @cached_property
    def diameter(self) -> int:
        """Side, in pixels, of a square that holds the observed area at every rotation about its centroid."""
        if not len(self.positions):
            return 0
        offsets = (self.positions - self.centre) / self.spacing
        return int(np.ceil(2 * np.hypot(*offsets.T).max())) + 4


def field_spacing(gradient_map: GradientMap, calibration: Calibration) -> float:
    """Metres per pixel at which a map is searched: a share of the length scale, doubled for large maps."""
    spacing = gradient_map.parameters.length_scale / calibration.pixels_per_length_scale
    width = max(gradient_map.mask.shape) * gradient_map.resolution
    return float(spacing * 2 ** max(0, np.ceil(np.log2(width / (calibration.max_pixels * spacing)))))


def field_of(gradient_map: GradientMap, spacing: float, calibration: Calibration) -> Field:
    """The field of a map, averaged over pixels of `spacing` metres.

    The mean slope is subtracted, since gravity is never known exactly, and gradients are weighted down where
    their variance is high. Then the spectrum is flattened, because the waves that dominate it, such as
    ripples or a long slope, identify the place least; and long vectors are soft-clipped, so that no single
    crest dominates.

    Parameters
    ----------
    gradient_map : GradientMap
    spacing : float
        Metres, not below the map's resolution.
    calibration : Calibration
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
        sigma = max(calibration.blur * step, 0.3)
        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(smooth, every_step, (columns, rows), flags=flags), dtype=np.float32)

    observed = average(mask)
    valid = (observed > 0.5).astype(np.float32)
    share = np.asarray(valid / np.maximum(observed, 0.5), dtype=np.float32)
    white = _whitened(average(x * weight) * share, average(y * weight) * share, valid, calibration)
    x, y = _clipped(*white, valid, calibration)
    return Field(x, y, valid, gradient_map.origin, spacing, gradient_map.parameters.length_scale)


def rotate_field(field: Field, affine: Array, shape: tuple[int, int]) -> tuple[Image, Image, Image]:
    """x, y and valid area of a field under an affine map (3, 3) of its pixels, the vectors rotated too.

    Parameters
    ----------
    field : Field
    affine : array, (3, 3)
        Affine map from (column, row) of the result to (column, row) of the field; a rotation up to its scale.
    shape : tuple of int
        Rows and columns of the result.
    """
    rows, columns = shape
    x, y, valid = _core.turn_field(field.x, field.y, field.valid, affine, rows=rows, cols=columns)
    return x, y, valid


def _whitened(x: Image, y: Image, valid: Image, calibration: Calibration) -> tuple[Image, Image]:
    """The field through the filter 1 / sqrt(P + floor mean P), with P its smoothed power spectrum."""
    width = max(x.shape)
    size = fft.next_fast_len(2 * width, real=True)
    spectra = fft.rfft2(np.stack([x, y]), s=(size, size))
    correlation = fft.irfft2((np.abs(spectra) ** 2).sum(axis=0), s=(size, size))
    lags = np.minimum(np.arange(size), size - np.arange(size))
    # A product in the lags is a smoothing of the spectrum.
    taper = np.exp(-0.5 * (2 * np.pi * calibration.spectrum_smoothing / width * lags) ** 2).astype(np.float32)
    power = np.maximum(fft.rfft2(correlation * taper * taper[:, None]).real, 0.0)
    power += max(calibration.whitening_floor * float(power.mean()), TINY)
    white_x, white_y = fft.irfft2(spectra / np.sqrt(power), s=(size, size))[:, : x.shape[0], : x.shape[1]]
    return white_x * valid, white_y * valid


def _clipped(x: Image, y: Image, valid: Image, calibration: Calibration) -> tuple[Image, Image]:
    """Vectors in units of their deviation, each divided by sqrt(1 + (length / clip)^2).

    Correlations do not depend on the unit, but the search transforms energies and areas together, in single
    precision, so both have to be of the same magnitude.
    """
    length = np.hypot(x, y)
    robust = max(_median(length, valid > 0) / RAYLEIGH_MEDIAN, 1e-6 * float(length.max()), TINY)
    factor = 1.0 / (robust * np.sqrt(1.0 + (length / (calibration.clip * robust)) ** 2))
    return x * factor.astype(np.float32), y * factor.astype(np.float32)


def _median(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
    return float(np.median(values[mask])) if mask.any() else 0.0
