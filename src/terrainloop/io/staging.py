"""Several files of one folder, written aside and moved in together."""

import errno
import os
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """A hidden folder inside `folder` for what is to be moved in by `publish`; it is removed at the end.

    `folder` is made where it is missing, and removed at the end if nothing was moved in. What a process
    that was killed left behind is removed.

    Raises
    ------
    OSError
        Naming `folder`.
    """
    made = not folder.exists()
    with errors_naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        prefix = f".terrainloop-{socket.gethostname()}-"
        _remove_abandoned(folder, prefix)
        aside = Path(tempfile.mkdtemp(prefix=f"{prefix}{os.getpid()}-", dir=folder))
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        if made:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def publish(aside: Path, folder: Path, names: Iterable[str], stale: Iterable[str | Path]) -> None:
    """Move the files of those names from `aside` into `folder`, after the stale ones there are removed.

    Neither an interrupt nor another process that publishes comes in between.

    Raises
    ------
    OSError
        Naming `folder`.
    """

    def move() -> None:
        with _locked(folder):
            for name in stale:
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (folder / name).parent.mkdir(exist_ok=True)
                (aside / name).replace(folder / name)

    # An interrupt is raised in the main thread, which then waits for this one.
    with errors_naming(folder), ThreadPoolExecutor(1) as pool:
        pool.submit(move).result()


@contextmanager
def errors_naming(path: Path) -> Iterator[None]:
    """Errors of the system that name `path`: those of writing name no file, others name one aside."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error


def _remove_abandoned(folder: Path, prefix: str) -> None:
    if fcntl is None:  # processes cannot be probed there
        return
    for aside in folder.glob(f"{prefix}*"):
        number = aside.name.removeprefix(prefix).partition("-")[0]
        if number.isdecimal() and not _is_running(int(number)):
            shutil.rmtree(aside, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another user's
        pass
    return True


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Wait until no other process has locked the folder; on file systems without locks, go on."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
