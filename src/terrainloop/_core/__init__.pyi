"""The C++ core. Arrays must be C-contiguous, of the stated type, finite and not empty; else ValueError."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]

VARIANT: str
"""Build of the core: native, portable, x86-64-v2 or x86-64-v3."""

LEVEL: int
"""Level of x86-64 that it was compiled for; 0 for less than 2, or another architecture."""

def surf(
    image: NDArray[np.float32],
    mask: NDArray[np.uint8] | None = None,
    *,
    threshold: float = 0.0,
    octaves: int = 4,
    intervals: int = 4,
    max_keypoints: int | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """SURF keypoints where mask is not 0, strongest first, and their descriptors (K, 64).

    Keypoints are (K, 6): x (column), y (row) and scale in pixels, orientation in radians as the angle of
    (d column, d row), response in image units squared, sign of the Laplacian.
    """

def fast_hessian(image: NDArray[np.float32], filter_size: int) -> NDArray[np.float64]:
    """SURF response map of one box filter (9, 15, 21, ... pixels); 0 where it reaches over the border."""

def gp_predict_grid(
    xy: NDArray[np.float64],
    elevation: NDArray[np.float64],
    noise: NDArray[np.float64],
    *,
    length_scale: float,
    variance: float,
    x: float,
    y: float,
    resolution: float,
    rows: int,
    cols: int,
    threads: int = 1,
) -> list[NDArray[np.float32]]:
    """Elevation, gradient in x and y, variance and gradient variance, each (rows, cols).

    From xy (N, 2), elevation (N,) and noise (N,); pixel (0, 0) is at (x, y). RuntimeError if the
    equations cannot be solved.
    """

def gp_predict_at(
    xy: NDArray[np.float64],
    elevation: NDArray[np.float64],
    noise: NDArray[np.float64],
    *,
    length_scale: float,
    variance: float,
    queries: NDArray[np.float64],
    threads: int = 1,
) -> list[NDArray[np.float32]]:
    """As `gp_predict_grid`, at queries (Q, 2)."""

def gp_noise_ratio(
    xy: NDArray[np.float64],
    elevation: NDArray[np.float64],
    *,
    cell: float,
    smallest_scatter: float = 0.0,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Noise of each point as a share of the typical one, (N, 1), from the scatter in cells of this side."""

def gp_block_likelihood(
    surfaces: Sequence[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]],
    *,
    length_scale: float,
    variance: float,
    noise: float,
    side: float,
    work: float,
    threads: int = 1,
) -> tuple[Callable[[float, float, float], tuple[float, tuple[float, float, float]]], int, int, int]:
    """-log p of (length scale, variance, noise) and its derivatives by their logarithms.

    From (xy, elevation, relative noise) of each surface; then the numbers of blocks, components and points.
    """

LANES: int
"""Number of rotations that the search processes side by side."""

def search_spectra(images: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Conjugate half spectra of pairs of images (K, 2, n, n), zero beyond n, for the search.

    They are (K / LANES, 2, size, size / 2 + 1, 2, LANES): real and imaginary parts, then the rotations
    side by side. The size is even, with no prime factors but 2, 3 and 5.
    """

def search_correlate(
    fields: NDArray[np.float32],
    ground: NDArray[np.float32],
    stored_field: NDArray[np.float32],
    stored_ground: NDArray[np.float32],
    *,
    least_shared: float,
    evident: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Correlations of a rotated field and a stored one, at every rotation and every (cyclic) shift.

    Parameters
    ----------
    fields, ground : array
        Result of `search_spectra` for (x, y) and, of half the size, for (valid area, energy) summed over
        2 x 2 pixels.
    stored_field, stored_ground : array, (2, n, n / 2 + 1, 2)
        Half spectra of the stored field's x and y, and of its valid area and energy.
    least_shared : float
        Number of pixels that a shift has to share.
    evident : float
        r^2 in units of its mean, above which a pose is reported.

    Returns
    -------
    evident : array, (N, 5)
        Rotation, row, column, r^2 and the independent samples in the shared ground,
        of poses with r > 0 that agree better than the shifts beside them.
    sample : array, (K,)
        For each rotation the pixels that count as one sample; NaN where no shift shares enough.
    admissible : array, (K,)
        For each rotation the shifts that share enough.
    """

def turn_field(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    known: NDArray[np.float32],
    affine: NDArray[np.float64],
    *,
    rows: int,
    cols: int,
) -> NDArray[np.float32]:
    """x, y and valid area (3, rows, cols) of a vector field, through an affine map (3, 3) of pixels."""

def inlier_counts(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    motions: NDArray[np.float64],
    radius: float,
) -> NDArray[np.int32]:
    """Number of associations (A, 2) that each motion (cos, sin, x, y) (K, 4) brings within the radius."""

def settle(
    source: tuple[Any, ...],
    target: tuple[Any, ...],
    T_target_source: NDArray[np.float64],
    *,
    step: int,
    places: int,
    steps: int,
    tolerance: float,
) -> tuple[_Array, _Array, _Array, _Array, _Array, _Array, _Array] | None:
    """The pose that `terrainloop.matching.refine.refine` seeks, with the data of its `Refinement`.

    A map is (gradient x, gradient y, gradient variance, mask as uint8, origin, resolution). None if
    the overlap is too small.
    """

def calibration() -> dict[str, Any]:
    """The calibration that `match` has in C++, by the names of `terrainloop.config.Calibration`."""

def match(
    source: tuple[Any, ...],
    target: tuple[Any, ...],
    *,
    pairs: float = 1.0,
    max_false_loops: float = 0.01,
    calibration: dict[str, Any] = {},
) -> dict[str, Any]:
    """The decision on two maps that C++ users call (terrainloop/match.hpp): `register` without keypoints.

    A map is (elevation, gradient x, gradient y, gradient variance, mask as uint8, origin, resolution, length
    scale). The tests hold this call and Python together; the library does not use it.
    """

def make_gradient_map(
    xyz: NDArray[np.float64],
    *,
    length_scale: float,
    variance: float,
    noise: float,
    resolution: float = 0.0,
    max_variance_ratio: float = 0.25,
    threads: int = 1,
) -> dict[str, Any]:
    """The map of a cloud (N, 3) that C++ users make (terrainloop/gradient_map.hpp); for the tests, too."""
