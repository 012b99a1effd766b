"""The kinds of dataset: every module of this package is one, and has the name of its kind."""

from collections.abc import Iterable
from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, TypeAdapter

from stickslip_schemas.base import Document
from stickslip_schemas.spec.jobs import JobSpec, Render, Simulation


def _spec_type(kind: str) -> type[JobSpec]:
    """Return the class of specs that the module of a kind defines."""
    module = import_module(f"{__name__}.{kind}")
    # Base classes are imported; the class of the kind is defined in the module itself.
    (spec_type,) = (
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, JobSpec)
        and value.__module__ == module.__name__
    )
    return spec_type


def _union(types: Iterable[type[Document]]) -> Any:
    """Return the union of models that pydantic tells apart by their `kind`."""
    return Annotated[reduce(or_, types), Field(discriminator="kind")]


KINDS: dict[str, type[JobSpec]] = {
    module.name: _spec_type(module.name) for module in iter_modules(__path__) if not module.ispkg
}
"""Class of the specs of each kind, by name."""

if TYPE_CHECKING:  # checkers know what all kinds have in common
    AnyJobSpec = JobSpec
    AnySimulation = Simulation
    AnyRender = Render
else:
    AnyJobSpec = _union(KINDS.values())
    AnySimulation = _union(spec.simulation_type for spec in KINDS.values())
    AnyRender = _union(spec.render_type for spec in KINDS.values())

job_spec_adapter: TypeAdapter[JobSpec] = TypeAdapter(AnyJobSpec)
"""Validates and dumps the spec of any kind."""


class UnknownKindError(ValueError):
    """A kind, or a class of one, that is not in the table."""


def registered(spec: JobSpec) -> JobSpec:
    """Return a spec as it is if its class is that of its kind; raise UnknownKindError."""
    if KINDS.get(spec.kind) is not type(spec):
        raise UnknownKindError(
            f"kind must be one of {', '.join(KINDS)}; got {spec.kind!r} of {type(spec).__name__}"
        )
    return spec


def kind_named(name: str) -> type[JobSpec]:
    """Return the class of the specs of a kind; raise UnknownKindError."""
    if name not in KINDS:
        raise UnknownKindError(f"kind must be one of {', '.join(KINDS)}; got {name!r}")
    return KINDS[name]
