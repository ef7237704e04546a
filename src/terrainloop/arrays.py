"""Arrays of frozen dataclasses: read-only for whoever holds the object."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """A view that cannot be written through; the array itself, which may be the caller's, stays as it was."""
    view = array.view()
    view.setflags(write=False)
    return view


class ReadOnlyArrays:
    """Keeps the arrays of an object read-only when it is unpickled, as by worker processes."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(
            {name: read_only(v) if isinstance(v, np.ndarray) else v for name, v in state.items()}
        )
