"""The remote function that Ray runs.

Ray gets this module by value, so that it also runs in Blender's environment, which does not have
stickslip_workers: it may import nothing of ours.
"""

import importlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

FRAMES_SECONDS = 2.0
"""Time between two messages about how far a simulation is [s]."""

_objects: dict[tuple[str, str], tuple[Any, Any]] = {}
"""Objects that factories have made in this process, by factory and store, with their builds."""

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

    The first message is a dict: the node, whether the builds of the process are `foreign`, and
    whether it is `cold`. Progress is a tuple (frames done, frames in total). The last message is
    the list of answers. A call on foreign builds ends after the first message.

    The object that `factory` (`module:Class`) makes stays in the process for later calls.
    """
    import ray

    if (factory, store) not in _objects:
        module, name = factory.split(":")
        new = getattr(importlib.import_module(module), name)(store)
        _objects[factory, store] = (new, new.describe()["builds"])
    actor, process_builds = _objects[factory, store]
    # The first tasks of a process also import what their kind needs.
    is_cold = bool(arguments) and factory not in _used
    if arguments:
        _used.add(factory)
    node = ray.get_runtime_context().get_node_id()
    is_foreign = process_builds != builds
    yield {"node": node, "foreign": is_foreign, "cold": is_cold}
    if is_foreign:
        return

    def work() -> list[Any]:
        return [getattr(actor, method)(argument) for argument in arguments]

    if not reports_frames:
        yield work()
        return
    # The work runs in a thread, so that this one can look at its progress.
    answers = ThreadPoolExecutor(1).submit(work)
    while wait([answers], FRAMES_SECONDS).not_done:
        frames = actor.frames()
        if frames is not None:
            yield tuple(frames)
    yield answers.result()
