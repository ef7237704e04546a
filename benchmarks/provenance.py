"""Provenance of results: a fingerprint of code, data and settings, and the machine.

Used by the benchmarks in this folder and by ``reproduce``. Results stored for later runs are keyed on their
fingerprint, so that a result of other code, data or settings is never reused.
"""

import json
import os
import platform
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import terrainloop._core


def package() -> tuple[Path, ...]:
    """Folders of the imported terrainloop, and its compiled core, which may have been built elsewhere."""
    return (*map(Path, terrainloop.__path__), Path(terrainloop._core._core.__file__))


def fingerprint(*roots: Path, **conditions: object) -> str:
    """Hash of the content of files and of anything else that a result depends on.

    Parameters
    ----------
    *roots : Path
        Files, or folders with all files below them except Python's caches. Names relative to the root are
        included, times of modification are not.
    **conditions : JSON-serialisable
        Settings, seeds, versions.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    whole = sha256(json.dumps(conditions, sort_keys=True).encode())
    for root in roots:
        for file in sorted(_files(root)):
            name = file.relative_to(root.parent if root.is_file() else root).as_posix()
            content = sha256(file.read_bytes()).hexdigest()
            whole.update(f"{name}\0{content}\n".encode())
    return whole.hexdigest()


def _files(root: Path) -> Iterator[Path]:
    """A file itself, or all files below a folder; linked folders are followed, as readers follow them."""
    if root.is_file():
        yield root
    for folder, below, names in os.walk(root, followlinks=True):
        below[:] = [name for name in below if name != "__pycache__"]
        yield from (path for path in (Path(folder, name) for name in names) if path.is_file())


def processor() -> str:
    """Model name of the CPU."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
