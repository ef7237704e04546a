"""Checks of the numbers that come in, and of the errors that come out of the C++ core."""

from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral, Real

import numpy as np

from terrainloop.errors import TerrainLoopError
from terrainloop.resources import memory_errors
from terrainloop.submap import MIN_POINTS


def check_positive(**numbers: float | None) -> None:
    """Refuse a number that is given and not positive and finite."""
    for name, value in numbers.items():
        if value is not None and not (isinstance(value, Real) and 0 < value < np.inf):
            raise TerrainLoopError(
                expected=f"a positive {name}", found=f"{value}", mend="leave it out to have it derived"
            )


def check_max_points(**numbers: int | None) -> None:
    """Refuse a number of points to draw that is given and would not make a submap."""
    for name, value in numbers.items():
        if value is not None and not (isinstance(value, Integral) and value >= MIN_POINTS):
            raise TerrainLoopError(
                expected=f"{name} of at least {MIN_POINTS}", found=f"{value}", mend="leave it out"
            )


def check_seed(seed: int) -> None:
    """Refuse what cannot seed a random number generator, or would give other numbers each time."""
    if not (isinstance(seed, Integral) and seed >= 0):
        raise TerrainLoopError(
            expected="a whole number of at least 0 as the seed",
            found=f"{seed!r:.80}",
            mend="leave it out for 0",
        )


@contextmanager
def core_errors(task: str) -> Iterator[None]:
    """Turn every error that the C++ core or NumPy raises within the block into a TerrainLoopError."""
    try:
        with memory_errors(task):
            yield
    except (ValueError, RuntimeError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise TerrainLoopError(
            expected=f"numbers that allow {task}",
            found=" ".join(str(error).split()),
            mend="remove outliers, raise the noise or shorten the length scale",
        ) from error
