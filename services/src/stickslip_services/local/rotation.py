"""Rotation of log files by size and age.

The file `NAME` is renamed to `NAME.1`, `NAME.1` to `NAME.2` and so on, and the oldest one is
deleted. Processes follow the name (`stickslip_schemas.logs`), so no line is lost or copied.
"""

import calendar
import time
from dataclasses import dataclass
from pathlib import Path

from stickslip_schemas.logs import TIME_FORMAT

DAY_SECONDS = 86_400.0

_TIME_LENGTH = len("2026-01-31T00:00:00")

_TAIL_BYTES = 65_536
"""End of a log that is read for an error message [bytes]."""


@dataclass(frozen=True, slots=True)
class LogRotation:
    """When logs are rotated, and how many rotated files of each are kept."""

    max_bytes: int
    """Size from which on a log is rotated [bytes]."""
    max_seconds: float
    """Age of the first line from which on a log is rotated [s]."""
    files: int
    """Number of rotated files of each log, at least 1."""

    def rotate_if_due(self, path: Path, now: float) -> None:
        """Rotate a log that is too large or too old at a time [s since 1970]."""
        if self._is_due(path, now):
            self.rotate(path, now)

    def rotate(self, path: Path, now: float) -> None:
        """Rotate a log that is not empty."""
        if not path.exists() or path.stat().st_size == 0:
            return
        for number in range(self.files - 1, 0, -1):
            older = numbered(path, number)
            if older.exists():
                older.replace(numbered(path, number + 1))
        path.replace(numbered(path, 1))
        # The first line has the time, by which the next rotation knows the age of the file. A
        # process may write before it: its lines begin with the time, too.
        begin = time.strftime(TIME_FORMAT, time.gmtime(now))
        with path.open("a", encoding="utf-8") as file:
            path.chmod(0o600)
            file.write(f"{begin}.000Z INFO logs: earlier lines are in {path.name}.1\n")

    def _is_due(self, path: Path, now: float) -> bool:
        try:
            if path.stat().st_size >= self.max_bytes:
                return True
            with path.open("rb") as file:
                began_at = _time_of(file.read(_TIME_LENGTH))
        except OSError:
            return False
        return began_at is not None and now - began_at >= self.max_seconds


def numbered(path: Path, number: int) -> Path:
    """Return the path of a rotated file; 1 is the newest."""
    return path.with_name(f"{path.name}.{number}")


def last_lines(path: Path, count: int) -> list[str]:
    """Return the last lines of a log that are not empty, also if it was rotated just now."""
    lines: list[str] = []
    for file in (path, numbered(path, 1)):
        lines = _end_of(file) + lines
        if len(lines) >= count:
            break
    return lines[-count:]


def _end_of(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - _TAIL_BYTES))
            text = file.read().decode(errors="replace")
    except OSError:
        return []
    return [line for line in text.splitlines() if line.strip()]


def _time_of(line: bytes) -> float | None:
    """Return the time with which a line begins [s since 1970]; None if it has none."""
    try:
        return float(calendar.timegm(time.strptime(line.decode("ascii"), TIME_FORMAT)))
    except ValueError:
        return None
