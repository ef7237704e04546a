"""The C++ core. Arrays must be C-contiguous, of the stated type, finite and not empty; else ValueError."""

import numpy as np
from numpy.typing import NDArray

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
