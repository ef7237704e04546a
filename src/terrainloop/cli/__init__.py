"""The command line: one file a command, all of them in `app`."""

import errno
import io
import logging
import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

from terrainloop.errors import TerrainLoopError, printable

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def main() -> None:
    """Run a command and exit: 0 done, 2 bad input, 1 a fault of ours, 128 + its number for a signal."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what the terminal's encoding lacks is escaped
            stream.reconfigure(errors="backslashreplace")
    interrupt = _Interrupt()
    try:
        try:
            from terrainloop.cli.app import app  # late: what it imports takes a while, and may be interrupted

            app()
        finally:
            sys.stdout.flush()
    except BaseException as error:
        if interrupt.number:
            _end_interrupted(error, interrupt.number)
        _end(error)
    finally:
        interrupt.restore()


class _Interrupt:
    """Turns the first Ctrl-C, SIGTERM or SIGHUP into a KeyboardInterrupt; the second ends the process."""

    def __init__(self) -> None:
        self.number = 0
        numbers = [getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")]
        before = {number: signal.getsignal(number) for number in numbers if number is not None}
        # What the parent had ignored, as nohup does, stays ignored.
        self._before = {n: handler for n, handler in before.items() if handler is not signal.SIG_IGN}
        for number in self._before:
            signal.signal(number, self)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self.number = number
        raise KeyboardInterrupt

    def restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def _end_interrupted(error: BaseException, number: int) -> NoReturn:
    """Exit as an interrupted process does; a command that ended in order has reported what it kept."""
    if not isinstance(error, SystemExit) or error.code:
        _print_line("interrupted before it was done")
    sys.exit(128 + number)


def _end(error: BaseException) -> NoReturn:
    """Exit with the code of what ended the command, after a line about it."""
    if isinstance(error, BrokenPipeError):  # who reads the output has seen enough
        _drop_output()
        sys.exit(1)
    if isinstance(error, OSError):
        error = _refused(error)
        _drop_output()
    if isinstance(error, TerrainLoopError):
        _print_line(str(error))
        sys.exit(2)
    if isinstance(error, Exception):
        logger = logging.getLogger(__name__)
        logger.error("a fault of ours, please report it with what follows", exc_info=error)
        sys.exit(1)
    raise error


def _refused(error: OSError) -> TerrainLoopError:
    """An OSError here is mostly about an output: readers raise errors of their own."""
    named = error.filename is not None
    if error.errno in _FULL:
        mend = "free some space there or write to another disk"
    elif named:
        mend = "check the path and its permissions"
    else:
        mend = "check the limits of the system (ulimit -a)"
    return TerrainLoopError(
        expected=f"to read or write {os.fsdecode(error.filename) if named else 'what the command needs'}",
        found=error.strerror or str(error) or type(error).__name__,
        mend=mend,
    )


def _print_line(text: str) -> None:
    sys.stderr.write(f"terrainloop: {printable(text)}\n")


def _drop_output() -> None:
    """Where stdout cannot be written to, it must not be tried again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
