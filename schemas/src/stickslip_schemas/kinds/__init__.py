"""The kinds of dataset. A kind is one module here; this one only lists them.

To add a kind, import its module and add its classes to the table and to the three unions.
"""

from typing import Annotated

from pydantic import Field, TypeAdapter

from stickslip_schemas.kinds.cloth_drag import ClothDragRender, ClothDragSimulation, ClothDragSpec
from stickslip_schemas.kinds.cloth_on_cloth import ClothOnClothRender, ClothOnClothSimulation, ClothOnClothSpec
from stickslip_schemas.kinds.cloth_sphere import ClothSphereRender, ClothSphereSimulation, ClothSphereSpec
from stickslip_schemas.kinds.rod_hang import RodHangRender, RodHangSimulation, RodHangSpec
from stickslip_schemas.kinds.shawl import ShawlRender, ShawlSimulation, ShawlSpec
from stickslip_schemas.spec.jobs import JobSpec

KINDS: dict[str, type[JobSpec]] = {
    "rod_hang": RodHangSpec,
    "cloth_drag": ClothDragSpec,
    "cloth_sphere": ClothSphereSpec,
    "cloth_on_cloth": ClothOnClothSpec,
    "shawl": ShawlSpec,
}
"""The class of the specs of each kind, by name."""

AnyJobSpec = Annotated[
    RodHangSpec | ClothDragSpec | ClothSphereSpec | ClothOnClothSpec | ShawlSpec,
    Field(discriminator="kind"),
]
AnySimulation = Annotated[
    RodHangSimulation | ClothDragSimulation | ClothSphereSimulation | ClothOnClothSimulation | ShawlSimulation,
    Field(discriminator="kind"),
]
AnyRender = Annotated[
    RodHangRender | ClothDragRender | ClothSphereRender | ClothOnClothRender | ShawlRender,
    Field(discriminator="kind"),
]

job_spec_adapter: TypeAdapter[JobSpec] = TypeAdapter(AnyJobSpec)
"""Validates and dumps the spec of any kind."""


class UnknownKindError(ValueError):
    """A kind, or a class of one, that is not in the table."""


def registered(spec: JobSpec) -> JobSpec:
    """Return a spec as it is if its class is that of its kind; raise UnknownKindError."""
    if KINDS.get(spec.kind) is not type(spec):
        raise UnknownKindError(f"kind must be one of {', '.join(KINDS)}; got {spec.kind!r} of {type(spec).__name__}")
    return spec


def kind_named(name: str) -> type[JobSpec]:
    """Return the class of the specs of a kind; raise UnknownKindError."""
    if name not in KINDS:
        raise UnknownKindError(f"kind must be one of {', '.join(KINDS)}; got {name!r}")
    return KINDS[name]
