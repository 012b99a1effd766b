"""How the workers make each kind of dataset. A kind is one module here, of the name of the kind; nothing lists them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.kinds import KINDS, kind_named
from stickslip_schemas.store import Store


@dataclass(frozen=True, slots=True)
class Kind:
    """How one kind is simulated."""

    simulate: Callable[[Sequence[Any], Store], list[TaskResult]]
    """From simulations to one result each, in their order."""
    batch: int
    """How many simulations one call is given at most."""
    solver: str
    """The module of sim_core whose build a certificate vouches for."""
    kernel: Callable[[], str] = str
    """Return the level of the kernels that the solver takes here, where levels differ in the last digits."""


def kind(name: str) -> Kind:
    """Return how a kind is made; raise UnknownKindError where the contract does not have it."""
    kind_named(name)
    module = import_module(f"{__name__}.{name}")
    made: Kind = module.KIND
    return made


def kind_names() -> tuple[str, ...]:
    """Return the names of all kinds."""
    return tuple(KINDS)
