"""Holders: vertices of the cloth that move as rigid bodies while they are grasped."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.bodies import Body
from stickslip_sim_core.cloth.solver import Motion

ALWAYS = (0.0, np.inf)


@dataclass(frozen=True, eq=False)
class Holder:
    """Vertices that move as one rigid body from a grasp to a release.

    At the time t0 of the grasp the holder takes each vertex where it is: x(t) = M(t) M(t0)^-1 x(t0), M being its pose.

    Raises:
        ValueError: An argument breaks its rule.
    """

    vertices: NDArray[np.intp]
    """(K,)"""

    pose: Callable[[ArrayLike], Floats]
    """From the time [s] to a rigid motion (3, 4): x -> A x + b [m]; in a scene with `poses`, from times (T,), too."""

    grasp: tuple[float, float] = ALWAYS
    """When it takes hold, and when it lets go [s]."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.grasp[0] < self.grasp[1]:
            raise ValueError(f"grasp: must ascend from 0 s or later, got {list(self.grasp)}")
        if not len(self.vertices):
            raise ValueError("vertices: a holder must hold a vertex, got none")

    def holds(self, time: float) -> bool:
        """Return whether it holds its vertices from this time [s] on."""
        return self.grasp[0] <= time < self.grasp[1]


class Hands:
    """The holders of a scene, of which no two may hold the same vertex at a time, with what each holds now.

    `positions` are those of all vertices at 0 s, (V, 3) [m].
    """

    def __init__(self, holders: Sequence[Holder], positions: Floats) -> None:
        self.holders = tuple(holders)
        self.events = sorted({t for holder in holders for t in holder.grasp if 0.0 < t < np.inf})
        """Times of all grasps and releases after 0 s [s], ascending."""
        self._taken: dict[int, Floats] = {}
        self.take(0.0, positions)

    def take(self, time: float, positions: Floats) -> NDArray[np.int32]:
        """Grasp and release what this time [s] asks for, and return the held vertices (K,)."""
        taken: dict[int, Floats] = {}
        for number, holder in enumerate(self.holders):
            if holder.holds(time):
                pose = holder.pose(time)
                place = (positions[holder.vertices] - pose[:, 3]) @ pose[:, :3]
                taken[number] = self._taken.get(number, place)
        self._taken = taken
        return self.vertices

    @property
    def vertices(self) -> NDArray[np.int32]:
        """(K,): held vertices, holder by holder."""
        held = [self.holders[number].vertices for number in self._taken]
        return np.concatenate([np.empty(0, np.int32), *held], dtype=np.int32)

    def at(self, time: ArrayLike) -> Floats:
        """Return the positions of the held vertices at a time [s], or at times (T,): ([T,] K, 3) [m]."""
        shape = np.shape(time)
        found = [np.empty((*shape, 0, 3))]
        for number, points in self._taken.items():
            pose = np.broadcast_to(self.holders[number].pose(time), (*shape, 3, 4))
            found.append(points @ np.swapaxes(pose[..., :3], -1, -2) + pose[..., None, :, 3])
        return np.concatenate(found, axis=-2)

    def driving(self, motion: Callable[[float], tuple[Floats, Sequence[Body]]]) -> Motion:
        """Return gravity, the held vertices and bodies, where `motion` returns gravity and bodies."""

        def drive(time: float) -> tuple[Floats, Floats, Sequence[Body]]:
            gravity, bodies = motion(time)
            return gravity, self.at(time), bodies

        return drive
