"""Files of a scene that are read once, though a command needs them several times."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")

_results: ContextVar[dict[Any, Any] | None] = ContextVar("results", default=None)


@contextmanager
def reading_files_once() -> Iterator[None]:
    """Let `read_once` keep its results until the end of the block.

    A scene is read when its files are found, and again when its start is checked. A large mesh
    takes a second each time.
    """
    token = _results.set({})
    try:
        yield
    finally:
        _results.reset(token)


def read_once(read: Callable[[bytes], T], data: bytes) -> T:
    """Return `read(data)`; within `reading_files_once` of the first call, which nobody changes."""
    results = _results.get()
    if results is None:
        return read(data)
    # Python computes the hash of a bytes object once, and compares the same object by identity.
    key = (read, data)
    if key not in results:
        results[key] = read(data)
    result: T = results[key]
    return result
