"""Paths, and files that are written completely or not at all."""

import codecs
import contextlib
import errno
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, TextIO, cast

from terrainloop.errors import TerrainLoopError


def as_path(path: str | os.PathLike[str], of: str) -> Path:
    """The path of something, such as a cloud.

    Raises
    ------
    TerrainLoopError
        If it is no path.
    """
    if not isinstance(path, str | os.PathLike):
        raise TerrainLoopError(
            expected=f"the path of {of}", found=f"{path!r:.60}", mend="give a text or a pathlib.Path"
        )
    return Path(path)


def write_whole(path: str | Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a binary file under a temporary name and rename it once it is complete.

    A symbolic link is followed; a device or a pipe is written to directly.

    Parameters
    ----------
    path : path
        An existing file is replaced.
    write : callable
        Writes the content to the binary file it is given.

    Raises
    ------
    OSError
        Naming `path`; whatever was at `path` before is still there.
    """
    target = Path(os.path.realpath(path))
    special = target.exists() and not target.is_file()
    aside = target if special else target.with_name(f".{os.getpid()}-{threading.get_ident()}.part")
    try:
        with aside.open("wb") as file:
            write(file)
        if not special:
            aside.replace(target)
    except OSError as error:
        # Errors of write() and close() carry no file name, those of open() the name of the temporary file.
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        if not special:
            with contextlib.suppress(OSError):  # where its folder does not exist
                aside.unlink()


def write_whole_text(path: str | Path, write: Callable[[TextIO], object]) -> None:
    """Write a text file in UTF-8 as `write_whole` does; line ends stay as written."""

    def encode(file: IO[bytes]) -> None:
        # Unlike io.TextIOWrapper it buffers nothing that its finaliser would try to write again.
        write(cast(TextIO, codecs.getwriter("utf-8")(file)))

    write_whole(path, encode)
