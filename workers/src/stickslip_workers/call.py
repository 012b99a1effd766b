"""What a Ray task does. Ray gets this module by value, so that it also runs in Blender's environment, which does not
have stickslip_workers: it may import nothing of ours.
"""

import importlib
import os
import sys
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

FRAMES_SECONDS = 2.0
"""Time between two messages about how far a simulation is [s]."""


def run(
    factory: str, store: str, builds: dict[str, Any], method: str, arguments: list[Any], tells_frames: bool
) -> Iterator[Any]:
    """Yield where the call runs, perhaps (frames done, frames in total), and at last the list of answers.

    What `factory` (`module:Class`) makes stays in the process for the calls that follow. Where its builds are not
    `builds`, the call ends after the first message.
    """
    import ray

    held = vars(sys.modules.setdefault("stickslip_held", ModuleType("stickslip_held")))
    if (key := f"{factory} {store}") not in held:
        module, name = factory.split(":")
        made = getattr(importlib.import_module(module), name)(store)
        held[key] = made, made.describe()["builds"]
    inner, own_builds = held[key]
    is_foreign = own_builds != builds
    node = ray.get_runtime_context().get_node_id()
    yield {"node": node, "pid": os.getpid(), "first": f"worked {key}" not in held, "foreign": is_foreign}
    if is_foreign:
        return
    if arguments:
        held[f"worked {key}"] = True
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["answers"] = [getattr(inner, method)(argument) for argument in arguments]
        except BaseException as error:
            outcome["error"] = error

    if tells_frames:
        thread = threading.Thread(target=work)
        thread.start()
        while True:
            thread.join(FRAMES_SECONDS)
            if not thread.is_alive():
                break
            if (frames := inner.frames()) is not None:
                yield tuple(frames)
    else:
        work()
    if "error" in outcome:
        raise outcome["error"]
    yield outcome["answers"]
