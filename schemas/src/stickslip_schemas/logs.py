"""Logs of long-running processes: one event a line on standard error, whose file may be rotated.

A rotation renames the file of a log and makes a new one (`stickslip up`, logrotate). The process
that writes has the renamed file open. Before each record, and on SIGHUP, it compares the two, and
changes to the file that has the name. So each record is in exactly one of the files, and no process
must be started again.
"""

import logging
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

_STANDARD_OUTPUT, _STANDARD_ERROR = 1, 2
"""File descriptors of a process."""

_FORMAT = "%(asctime)s.%(msecs)03dZ %(levelname)s %(name)s: %(message)s"
TIME_FORMAT = "%Y-%m-%dT%H:%M:%S"
"""Form of the time with which a line begins, in UTC."""


class FollowingHandler(logging.StreamHandler):  # type: ignore[type-arg]  # generic in stubs only
    """Writes to standard error, and follows the name of the file behind it."""

    def __init__(self) -> None:
        super().__init__()
        self.path = _file_behind(_STANDARD_ERROR)
        """File that standard error was sent to; None if it is a terminal, a pipe or a journal."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record to the file that has the name now."""
        self.follow()
        super().emit(record)

    def follow(self) -> None:
        """Send standard output and standard error to the file that has the name now."""
        # A record in the renamed file is better than none: a full disk must not silence the log.
        with suppress(OSError):
            if self.path is not None and not _is_behind(self.path, _STANDARD_ERROR):
                self._reopen(self.path)

    def _reopen(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        opened = os.open(path, flags, mode=0o600)
        try:
            old = os.fstat(_STANDARD_ERROR)
            for descriptor in (_STANDARD_OUTPUT, _STANDARD_ERROR):
                # Standard output may go elsewhere, for example into a pipe.
                if os.path.samestat(os.fstat(descriptor), old):
                    os.dup2(opened, descriptor)
        finally:
            os.close(opened)


def configure_logging() -> None:
    """Log to standard error, one event a line: `time level logger: message`, in UTC.

    If standard error is a file, the process follows its name; SIGHUP makes it do so at once.
    """
    formatter = logging.Formatter(_FORMAT, TIME_FORMAT)
    formatter.converter = time.gmtime
    handler = FollowingHandler()
    handler.setFormatter(formatter)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    # Without a file, SIGHUP means that the terminal is gone, and ends the process.
    if handler.path is not None:
        signal.signal(signal.SIGHUP, lambda _number, _frame: handler.follow())


def _file_behind(descriptor: int) -> Path | None:
    """Return the path of the regular file that a descriptor writes to; None if it is none."""
    try:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        # A deleted file, a pipe and a socket have no path at which they could be found again.
        return path if path.is_file() and _is_behind(path, descriptor) else None
    except OSError:
        return None


def _is_behind(path: Path, descriptor: int) -> bool:
    """Return whether a descriptor writes to the file at a path."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
