"""Two maps overlaid at a relative pose: the source interpolated at the pixels of the target."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from terrainloop.field import Field, rotate_field
from terrainloop.geometry import Array, inverse
from terrainloop.gradient_map import GradientMap

Image = NDArray[np.float32]


class _Grid(Protocol):
    @property
    def metres_from_pixels(self) -> Array: ...


@dataclass(frozen=True, eq=False)
class Overlay:
    """A source map over a target map.

    Attributes
    ----------
    source, target : GradientMap
    T_target_source : array, (3, 3)
        SE(2).
    step : int
        Every step-th row and column of the target is used.
    """

    source: GradientMap
    target: GradientMap
    T_target_source: Array
    step: int = 1

    @cached_property
    def shared(self) -> NDArray[np.bool_]:
        """Mask (rows, columns), on the target's pixels, of the ground that both maps have observed."""
        both: NDArray[np.bool_] = (self._look_up(self.source.mask.astype(np.float32)) > 0.999) & self._every(
            self.target.mask
        )
        return both

    @property
    def shared_area(self) -> float:
        """Square metres."""
        return float(self.shared.sum()) * (self.step * self.target.resolution) ** 2

    @property
    def overlap(self) -> float:
        """Intersection over union of the observed areas, 0 to 1."""
        areas = sum(m.mask.sum() * m.resolution**2 for m in (self.source, self.target))
        return float(self.shared_area / (areas - self.shared_area)) if self.shared.any() else 0.0

    @cached_property
    def positions(self) -> Array:
        """Positions (N, 2) of the shared pixels in the target frame, metres."""
        pixels = np.argwhere(self.shared)[:, ::-1]
        return pixels * (self.step * self.target.resolution) + np.array(self.target.origin)

    def of_source(self, image: Image) -> Array:
        """Values (N,) of an image of the source, interpolated at the shared pixels."""
        return self._look_up(image)[self.shared].astype(float)

    def of_target(self, image: Image) -> Array:
        """Values (N,) of an image of the target at the shared pixels."""
        return self._every(image)[self.shared].astype(float)

    def _every(self, image: NDArray[Any]) -> NDArray[Any]:
        return image[:: self.step, :: self.step]

    def _look_up(self, image: Image) -> Image:
        lookup = pixel_lookup(self.source, self.target, self.T_target_source)
        lookup = lookup @ np.diag([self.step, self.step, 1.0])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        rows, columns = self._every(self.target.mask).shape
        warped = cv2.warpAffine(image, lookup[:2], (columns, rows), flags=flags, borderValue=0.0)
        return np.asarray(warped, dtype=np.float32)


def pixel_lookup(source: _Grid, target: _Grid, T_target_source: Array) -> Array:
    """Affine map (3, 3) from (column, row) of the target to (column, row) of the source."""
    return np.asarray(
        np.linalg.inv(source.metres_from_pixels) @ inverse(T_target_source) @ target.metres_from_pixels
    )


@dataclass(frozen=True)
class Agreement:
    """How well two fields agree at a pose.

    Attributes
    ----------
    correlation : float
        Sum of scalar products over the root of the product of energies, -1 to 1.
    area : float
        Shared area, m^2.
    """

    correlation: float
    area: float


def agreement_at(source: Field, target: Field, T_target_source: Array) -> Agreement:
    """Measure how well two fields agree at a pose.

    Parameters
    ----------
    source, target : Field
    T_target_source : array, (3, 3)
        SE(2).
    """
    both, x, y, u, v = _shared_vectors(source, target, T_target_source)
    energy = (x @ x + y @ y) * (u @ u + v @ v)
    correlation = float((u @ x + v @ y) / np.sqrt(energy)) if energy > 0 else 0.0
    return Agreement(correlation, float(both.sum()) * target.spacing**2)


def participation_at(source: Field, target: Field, T_target_source: Array, block: float) -> float:
    """Share of the shared ground that the agreement of two fields rests on at a pose, 0 to 1.

    The participation ratio (sum_b s_b)^2 / (n sum_b s_b^2 / n_b) of the sums s_b of the scalar products over
    blocks of ground, with n_b their numbers of pixels and n that of all: 1 where all blocks agree alike, and
    k / K where k of K blocks do and the rest is zero.

    Parameters
    ----------
    source, target : Field
    T_target_source : array, (3, 3)
        SE(2).
    block : float
        Side of a block, metres.
    """
    both, x, y, u, v = _shared_vectors(source, target, T_target_source)
    side = max(1, round(block / target.spacing))
    rows, columns = np.nonzero(both)
    _, of = np.unique(rows // side * both.shape[1] + columns // side, return_inverse=True)
    counts, sums = np.bincount(of), np.bincount(of, weights=u * x + v * y)
    spread = len(rows) * (sums**2 / counts).sum()
    return float(sums.sum() ** 2 / spread) if spread > 0 else 0.0


def _shared_vectors(source: Field, target: Field, T_target_source: Array) -> tuple[Array, ...]:
    """Mask of the pixels of the target that both observed; there x, y of the source and of the target."""
    lookup = pixel_lookup(source, target, T_target_source)
    x, y, valid = rotate_field(source, lookup, target.valid.shape)
    both = (valid > 0) & (target.valid > 0)
    return both, *(image[both].astype(float) for image in (x, y, target.x, target.y))
