"""Stored results are reused only if the code, the data and the settings behind them are still the same.

Each has a record next to it: a JSON file with a fingerprint under "key".
"""

import json
import platform
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import scipy

from benchmarks.provenance import fingerprint, package
from terrainloop import __version__


@cache
def code_key() -> str:
    """Fingerprint of terrainloop with its compiled core, of this package, and of their dependencies."""
    return fingerprint(*package(), Path(__file__).parent, versions=versions())


def versions() -> dict[str, str]:
    """Versions of the software that all methods share."""
    return {
        "terrainloop": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
    }


def is_current(record: Path, key: str) -> bool:
    """Whether a record exists and has this key."""
    try:
        return json.loads(record.read_text(encoding="utf-8"))["key"] == key
    except (OSError, ValueError, KeyError, TypeError):
        return False
