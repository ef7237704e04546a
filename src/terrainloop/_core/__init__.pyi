"""The C++ core. Arrays must be C-contiguous, of the stated type, finite and not empty; else ValueError."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

VARIANT: str
"""Which build of the core this is: native, portable, x86-64-v2, x86-64-v3 or x86-64-v4."""

LEVEL: int
"""Level of x86-64 that its compiler made use of; 0 for less than 2, or another architecture."""

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

    From xy (N, 2), elevation (N,) and noise (N,); pixel (0, 0) lies at (x, y). RuntimeError where the
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
    xy: NDArray[np.float64], elevation: NDArray[np.float64], *, cell: float, threads: int = 1
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
