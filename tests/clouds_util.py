"""Ground that every reader and check should accept, and where the real data lie."""

from pathlib import Path

import numpy as np

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
UTM = np.array([431234.125, 3761234.5, 100.25])


def ground(count=400, size=10.0, seed=0):
    """Points (count, 3) on rolling ground of `size` metres a side."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, count))
    z = 0.03 * size * np.sin(5 * x / size) * np.cos(4 * y / size) + rng.normal(0, 0.002 * size, count)
    return np.column_stack([x, y, z])
