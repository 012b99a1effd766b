"""Kinds of simulations: the interface between the workers and the module of each kind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
Record = Mapping[str, Array]

IMPOSSIBLE_START = "impossible_start"
"""Code of the reason of a simulation that could not begin: nothing ran."""

OnFrame = Callable[[int, int], None]
"""Takes (frames done, frames) after every frame."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of one simulation."""

    record: Record = field(default_factory=dict)
    """Arrays to store, floating ones in single precision."""

    labels: Mapping[str, Any] = field(default_factory=dict)
    """Numbers and texts to store beside them."""

    reason: str = ""
    """Reason for a rejection; empty if the simulation is valid."""

    code: str = "solver_diverged"
    """Code of that reason: for cloth, the name of the check that failed."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of simulations: `KIND` of the module of its name in `scenes`."""

    simulate: Callable[[Sequence[Mapping[str, Any]], OnFrame | None], list[Outcome]]
    """From the physics of simulations, by name, to their outcomes in the same order.

    Raises:
        ValueError: A value breaks its rule.
    """

    solver: str
    """The module of the solver that a certificate is of."""

    batch: int = 1
    """Simulations a call at most, which are stored together."""

    kernel: Callable[[], str] = str
    """Return the level of the kernels that run here, if levels differ in the last digits."""
