"""Renders that share a shading are made in one call: tasks are put together, and the result is taken apart again."""

from collections.abc import Sequence

from stickslip_schemas.base.keys import canonical_json
from stickslip_schemas.documents.tasks import RenderOutput, RenderTask, TaskResult

from stickslip_workers.failures import failure


def shading_of(task: RenderTask) -> str | None:
    """Return a text that is the same for renders that share a shading; None where a render shares none."""
    shared = task.render.shading
    return None if shared is None else canonical_json({"shading": shared, "record": task.record.model_dump()})


def together(tasks: Sequence[RenderTask]) -> RenderTask:
    """Return one task for several renders of one shading; a single task stays as it is."""
    if len(tasks) == 1:
        return tasks[0]
    if len({shading_of(task) for task in tasks}) != 1 or shading_of(tasks[0]) is None:
        raise ValueError("tasks must be renders of one shading to be made together")
    textures = tuple(dict.fromkeys(task.render.variant for task in tasks))
    return tasks[0].model_copy(update={"textures": textures, "preview": any(task.preview for task in tasks)})


def apart(tasks: Sequence[RenderTask], result: TaskResult) -> list[TaskResult]:
    """Return the result of each task from that of all together; what it cost is divided among them."""
    if len(tasks) == 1:
        return [result]
    share = {
        "cpu_seconds": result.cpu_seconds / len(tasks),
        "wall_seconds": result.wall_seconds / len(tasks),
    }
    if not isinstance(result.output, RenderOutput):
        return [result.model_copy(update=share)] * len(tasks)
    try:
        return [result.model_copy(update=share | {"output": _own(task, result.output)}) for task in tasks]
    except KeyError as error:
        return [failure(error)] * len(tasks)


def _own(task: RenderTask, output: RenderOutput) -> RenderOutput:
    name = task.render.variant
    return RenderOutput(
        chunks={"video": output.clips[name], **output.chunks},
        preview=output.previews[name] if task.preview else None,
        labels=output.labels,
    )
