"""The scenes of all kinds: one module per kind, named after it."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from stickslip_schemas.documents.tasks import RenderTask, TaskResult
from stickslip_schemas.kinds import kind_named

from stickslip_blender.workshop import Workshop


def renders(kind: str) -> Callable[[Any, RenderTask, Workshop], TaskResult]:
    """Return the function that renders a kind, from its render document, the task of it and a workshop to a result.

    Raises:
        UnknownKindError: The contract does not have the kind.
    """
    kind_named(kind)
    render: Callable[[Any, RenderTask, Workshop], TaskResult] = import_module(f"{__name__}.{kind}").render
    return render
