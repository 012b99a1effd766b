"""A process that runs tasks, as Ray sees it.

This module is pickled by value, so that the Blender environment need not have stickslip_workers: it may import
nothing of ours.
"""

import importlib
import os
from pathlib import Path
from typing import Any


class Host:
    """Holds one object for the life of a process and calls it."""

    def __init__(self, factory: str, store: str) -> None:
        module, name = factory.split(":")
        self._inner = getattr(importlib.import_module(module), name)(store)

    def describe(self) -> dict[str, Any]:
        """Return what the object says about itself, the pid, and the node that it is on."""
        import ray

        return {**self._inner.describe(), "pid": os.getpid(), "node": ray.get_runtime_context().get_node_id()}

    def frames(self) -> Any:
        """Return how far the object is, while `call` runs in another thread; None if it does not tell."""
        return self._inner.frames()

    def call(self, method: str, arguments: list[Any]) -> tuple[list[Any], int]:
        """Call a method with each of some arguments; return the answers, and the resident memory after them [bytes]."""
        answers = [getattr(self._inner, method)(argument) for argument in arguments]
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return answers, pages * os.sysconf("SC_PAGE_SIZE")
