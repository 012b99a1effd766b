"""Documents of render tasks for tests of the renderer."""

from collections.abc import Sequence
from typing import Any, Protocol

from stickslip_schemas.documents.tasks import RenderOutput, TaskResult
from stickslip_schemas.spec.cameras import rig_digest


class Actor(Protocol):
    """A renderer that takes the documents of tasks."""

    def render(self, task: dict[str, Any]) -> Any:
        """Render a task, and return its result."""


def cloth_task(
    record: str, *, textures: Sequence[str] | None = None, **settings: Any
) -> dict[str, Any]:
    """Return a task that renders a clip of one frame of a drag.

    Args:
        record: Digest of the trajectory.
        textures: Textures that are rendered together; without them, only that of the settings.
        settings: Fields of the render document that differ.
    """
    render = {
        "kind": "cloth_drag",
        "rig": "drag",
        "rig_digest": rig_digest("drag"),
        "material": "gray-interlock",
        "texture": "plaid",
        "viewpoint": "calibrated",
        "instants": [0],
        "quality": "preview",
        "light_seed": 9,
        "crease_seed": 4,
    }
    task = _task(render | settings, record, 0)
    return task if textures is None else task | {"textures": textures}


def rod_task(
    record: str, *, row: int = 0, preview: bool = False, **settings: Any
) -> dict[str, Any]:
    """Return a task that renders the views of a rod: a row of a record of centerlines."""
    render = {
        "kind": "rod_hang",
        "rig": "rod-4",
        "rig_digest": rig_digest("rod-4"),
        "quality": "draft",
        "color_seed": 5,
    }
    return _task(render | settings, record, row) | {"preview": preview}


def _task(render: dict[str, Any], record: str, row: int) -> dict[str, Any]:
    return {"stage": "render", "render": render, "record": {"digest": record, "row": row}}


def output_of(actor: Actor, task: dict[str, Any]) -> RenderOutput:
    """Render a task, which must succeed, and return its output."""
    result = TaskResult.model_validate(actor.render(task))
    assert isinstance(result.output, RenderOutput), result
    return result.output
