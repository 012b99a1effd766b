"""The remote function that Ray runs.

Ray sends this module by value, because it also runs in Blender's environment. That environment does
not have stickslip_workers, so this module may not import any part of the project.
"""

import importlib
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

FRAMES_SECONDS = 2.0
"""Time between two progress messages of a simulation [s]."""

_objects: dict[tuple[str, str], tuple[Any, Any]] = {}
"""Objects that factories have made in this process, with their builds.

The key is the factory and the store.
"""

_used: set[str] = set()
"""Factories that have run tasks in this process."""


def run(
    factory: str,
    store: str,
    builds: dict[str, Any],
    method: str,
    arguments: list[Any],
    reports_frames: bool,
) -> Iterator[Any]:
    """Yield the messages of a call: its node, perhaps its progress, and its answers.

    The first message is a dict: the node, whether the builds of the process are `foreign`, whether
    the process is `cold`, and its `log`: the file of its errors, and the size of that file now.
    Progress is a tuple (frames done, frames in total). The last message is the list of answers. A
    call on foreign builds ends after the first message.

    `factory` (`module:Class`) makes an object that stays in the process for later calls.
    """
    import ray

    if (factory, store) not in _objects:
        module, name = factory.split(":")
        new = getattr(importlib.import_module(module), name)(store)
        _objects[factory, store] = (new, new.describe()["builds"])
    actor, process_builds = _objects[factory, store]
    # The first tasks of a process also import the modules of their kind.
    is_cold = bool(arguments) and factory not in _used
    if arguments:
        _used.add(factory)
    node = ray.get_runtime_context().get_node_id()
    is_foreign = process_builds != builds
    yield {"node": node, "foreign": is_foreign, "cold": is_cold, "log": _log()}
    if is_foreign:
        return

    def work() -> list[Any]:
        return [getattr(actor, method)(argument) for argument in arguments]

    if not reports_frames:
        yield work()
        return
    # The work runs in a separate thread, so this thread can read its progress.
    answers = ThreadPoolExecutor(1).submit(work)
    while wait([answers], FRAMES_SECONDS).not_done:
        frames = actor.frames()
        if frames is not None:
            yield tuple(frames)
    yield answers.result()


def _log() -> tuple[str, int]:
    """Return the file that this process writes its errors to, and its size [bytes].

    The name is empty where nobody can tell.
    """
    try:
        return str(Path("/proc/self/fd/2").readlink()), os.fstat(2).st_size
    except OSError:
        return "", 0
