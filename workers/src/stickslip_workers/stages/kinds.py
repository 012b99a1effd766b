"""The kinds of things that these workers can make. A new kind is one more entry."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from stickslip_schemas.store import Store
from stickslip_schemas.tasks import TaskResult

from stickslip_workers.stages.cloth import RECORD_ARRAYS as CLOTH_ARRAYS
from stickslip_workers.stages.cloth import simulate_cloths
from stickslip_workers.stages.rods import RECORD_ARRAYS, simulate_rods

KindName = Literal["rod_hang", "cloth_drag"]


@dataclass(frozen=True, slots=True)
class Kind:
    """How one kind is simulated and packed."""

    simulate: Callable[[Sequence[Any], Store], list[TaskResult]]
    """From simulations to one result each, in their order."""
    batch: int
    """How many simulations one call is given at most."""
    record_arrays: tuple[str, ...]
    """The arrays of the dataset that come from the records of its simulations."""


KINDS: dict[KindName, Kind] = {
    # Small enough that a lost batch costs little: 512 rods are well below a second.
    "rod_hang": Kind(simulate=simulate_rods, batch=512, record_arrays=RECORD_ARRAYS),
    # Minutes each.
    "cloth_drag": Kind(simulate=simulate_cloths, batch=1, record_arrays=CLOTH_ARRAYS),
}
