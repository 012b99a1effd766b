"""The coordinator's clock."""

import time
from collections.abc import Callable
from datetime import UTC, datetime

Clock = Callable[[], float]
"""Returns seconds since 1970 [s]."""


def steady_clock() -> Clock:
    """Return a clock that reads the wall clock once and then runs on by itself.

    When somebody sets the machine's clock, leases neither expire at once nor live for ever.
    """
    offset = time.time() - time.monotonic()
    return lambda: offset + time.monotonic()


def as_datetime(seconds: float) -> datetime:
    """Return the point in time as the API shows it."""
    return datetime.fromtimestamp(seconds, UTC)
