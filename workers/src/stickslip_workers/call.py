"""What a Ray task does.

Ray gets this module by value, so that it also runs in Blender's environment, which does not have
stickslip_workers: it may import nothing of ours.
"""

import importlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

FRAMES_SECONDS = 2.0
"""Time between two messages about how far a simulation is [s]."""

_held: dict[tuple[str, str], tuple[Any, Any]] = {}
"""What factories made in this process, with its builds."""

_used: set[str] = set()
"""Factories that have run tasks in this process."""


def run(
    factory: str,
    store: str,
    builds: dict[str, Any],
    method: str,
    arguments: list[Any],
    tells_frames: bool,
) -> Iterator[Any]:
    """Yield where the call runs, perhaps (frames done, frames in total), and at last the list of
    answers.

    What `factory` (`module:Class`) makes stays in the process for the calls that follow. Where its
    builds are not `builds`, the call ends after the first message.
    """
    import ray

    if (held := _held.get((factory, store))) is None:
        module, name = factory.split(":")
        made = getattr(importlib.import_module(module), name)(store)
        held = _held[factory, store] = made, made.describe()["builds"]
    inner, own_builds = held
    # The first tasks of a process also import what their kind needs.
    is_cold = bool(arguments) and factory not in _used
    if arguments:
        _used.add(factory)
    node = ray.get_runtime_context().get_node_id()
    yield {"node": node, "foreign": own_builds != builds, "cold": is_cold}
    if own_builds != builds:
        return

    def work() -> list[Any]:
        return [getattr(inner, method)(argument) for argument in arguments]

    if tells_frames:
        done = ThreadPoolExecutor(1).submit(work)
        while wait([done], FRAMES_SECONDS).not_done:
            if (frames := inner.frames()) is not None:
                yield tuple(frames)
        yield done.result()
    else:
        yield work()
