"""The coordinator's clock."""

from collections.abc import Callable
from datetime import UTC, datetime

Clock = Callable[[], float]
"""Returns seconds since 1970 [s]."""


def as_datetime(seconds: float) -> datetime:
    """Return a time in seconds since 1970 as a UTC datetime."""
    return datetime.fromtimestamp(seconds, UTC)
