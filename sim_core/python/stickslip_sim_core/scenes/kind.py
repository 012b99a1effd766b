"""Kinds of simulations: the interface between the workers and the module of each kind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
Record = Mapping[str, Array]

IMPOSSIBLE_START = "impossible_start"
"""Code of the reason if a simulation could not begin, so that nothing ran."""

OnFrame = Callable[[int, int], None]
"""Function that a simulation calls with (finished frames, all frames) after every frame."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of one simulation."""

    record: Record = field(default_factory=dict)
    """Arrays to store, with floating numbers in single precision."""

    labels: Mapping[str, Any] = field(default_factory=dict)
    """Numbers and texts to store beside the arrays."""

    reason: str = ""
    """Reason for a rejection, or empty if the simulation is valid."""

    code: str = "solver_diverged"
    """Code of the reason. For cloth it is the name of the failed check, for example."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of simulation: `KIND` in the module of its name in `scenes`."""

    simulate: Callable[[Sequence[Mapping[str, Any]], OnFrame | None], list[Outcome]]
    """Function from the physics of simulations, by name, to their outcomes in the same order.

    Raises:
        ValueError: A value breaks its rule.
    """

    solver: str
    """Module of the solver that a certificate vouches for."""

    batch: int = 1
    """Most simulations in a call. Their samples are stored together."""

    kernel: Callable[[], str] = str
    """Function that returns the level of the kernels that run here.

    It returns an empty text if the kind has no levels that differ in the last digits.
    """
