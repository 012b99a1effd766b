"""The object in a render process takes render tasks and returns results, both as JSON.

It depends on neither Ray nor any kind, because the module of the kind renders. A fault of the
sample gives a rejection. The actor raises any other error, and the owner of the process handles it.
The actor publishes a result by renaming whole files, so a crash of Blender leaves no partial
result.
"""

import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from stickslip_schemas.documents.tasks import RenderTask, TaskResult
from stickslip_schemas.kinds import KINDS, kind_named

from stickslip_blender.cycles.engine import blender_version, described
from stickslip_blender.render_context import RenderContext, build_digest, check_rig


class RenderActor:
    """Renders samples from the store into the store.

    A process has one actor, because Blender holds one scene.
    """

    def __init__(self, store_root: str) -> None:
        self._context = RenderContext(store_root)

    def describe(self) -> dict[str, Any]:
        """Return the build of each kind, and the versions.

        All processes of one installation return equal answers.
        """
        return {
            "builds": {kind: build_digest(kind) for kind in KINDS},
            "versions": blender_version() | {"device": " ".join(map(str, described().values()))},
        }

    def render(self, task: dict[str, Any]) -> dict[str, Any]:
        """Render the sample of a `RenderTask`, and return a `TaskResult`."""
        wall = time.perf_counter()
        cpu = time.process_time()
        job = RenderTask.model_validate(task)
        check_rig(job.render)
        result = renders(job.render.kind)(job.render, job, self._context)
        spent = {
            "cpu_seconds": time.process_time() - cpu,
            "wall_seconds": time.perf_counter() - wall,
        }
        return result.model_copy(update=spent).model_dump(mode="json")


def renders(kind: str) -> Callable[[Any, RenderTask, RenderContext], TaskResult]:
    """Return the function that renders a kind.

    The function takes the render document, its task and a context, and returns a result.

    Raises UnknownKindError if the contract does not have the kind.
    """
    kind_named(kind)
    render: Callable[[Any, RenderTask, RenderContext], TaskResult] = import_module(
        f"stickslip_blender.scenes.{kind}"
    ).render
    return render
