"""Kinds of simulations as the simulation core offers them: one module of `stickslip_sim_core.scenes` for each kind."""

from importlib import import_module
from typing import TYPE_CHECKING

from stickslip_schemas.kinds import kind_named

if TYPE_CHECKING:
    from stickslip_sim_core.scenes.kind import Kind


def scene_module(name: str) -> str:
    """Return the module that simulates a kind; raise UnknownKindError."""
    kind_named(name)
    return f"stickslip_sim_core.scenes.{name}"


def kind(name: str) -> "Kind":
    """Return how a kind is simulated; raise UnknownKindError."""
    found: Kind = import_module(scene_module(name)).KIND
    return found
