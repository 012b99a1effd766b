"""Cloth that falls, is crumpled, folds and piles up, by seed.

These small scenes are hard on contact with itself.

`watch` runs one, and after every step looks for crossings by comparing all edges with all
triangles.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS, Body, SelfContact, Surface, plane
from stickslip_sim_core.cloth.fabrics import fabric, fabric_names
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth

STEP = 0.01
"""[s]"""

FLAT = 1e-9
"""An edge whose end is no further from a triangle's plane lies in it [m]."""


@dataclass(frozen=True, eq=False)
class Tumble:
    """A cloth in its first state, and what happens to it."""

    cloth: Cloth
    bodies: Sequence[Body]
    held: Callable[[float], Floats]
    """Positions (K, 3) [m] of the held vertices at a time [s]."""

    steps: int


@dataclass(frozen=True)
class Watched:
    """What became of a tumble."""

    steps: int
    unconverged_steps: int
    crossing_steps: int
    """Steps at whose ends an edge crosses a triangle."""

    least_distance: float
    """Of pieces of cloth that do not hang together, and of cloth and surfaces, over how far apart
    they are to stay, at the ends of all steps; inf where none came near."""

    newton: int
    """Iterations."""

    seconds: float
    """CPU time of the steps, without the search for crossings."""


def watch(tumble: Tumble, steps: int | None = None) -> Watched:
    """Run a tumble, or its first steps, and look for crossings after each of them."""
    cloth, crossing, seconds = tumble.cloth, 0, 0.0
    triangles_of_cloth = np.asarray(cloth.mesh.triangles)
    for step in range(1, (tumble.steps if steps is None else steps) + 1):
        begin = time.process_time()
        cloth.step(STEP, held=tumble.held(step * STEP), bodies=tumble.bodies)
        seconds += time.process_time() - begin
        at = cloth.positions
        crossed = crossings(at, triangles_of_cloth, at, triangles_of_cloth)
        for surface in cloth.surfaces:
            vertices, triangles = surface.at(cloth.time), np.asarray(surface.triangles)
            crossed += crossings(at, triangles_of_cloth, vertices, triangles) + crossings(
                vertices, triangles, at, triangles_of_cloth
            )
        crossing += crossed > 0
    least = cloth.total.least_distance / THICKNESS
    return Watched(
        cloth.total.steps, cloth.total.unconverged, crossing, least, cloth.total.newton, seconds
    )


@dataclass(frozen=True, eq=False)
class Balance:
    """What the forces of all pairs add up to."""

    pairs: int
    size: float
    """Sum of the sizes of the forces of pairs [N]."""

    force: Floats
    """(3,): sum of the forces on vertices [N]; nothing, since what acts on one side acts on the
    other.
    """

    moment: Floats
    """(3,): sum of their moments [N m]."""

    moment_of_friction: Floats
    """(3,): its required value [N m]. A force along the normal has no moment; friction acts on both
    sides of the distance, and turns by it."""


def balance(cloth: Cloth) -> Balance:
    """Add up the forces of pairs at the end of the last step, of a cloth without surfaces."""
    pairs, positions = cloth.pair_forces, cloth.positions
    on_vertices = pairs.weights[:, :, None] * pairs.forces[:, None, :]
    at = positions[pairs.vertices]
    across = (pairs.weights[:, :, None] * at).sum(axis=1)
    normal = across / np.linalg.norm(across, axis=1, keepdims=True)
    friction = pairs.forces - (pairs.forces * normal).sum(axis=1, keepdims=True) * normal
    return Balance(
        len(normal),
        float(np.linalg.norm(pairs.forces, axis=1).sum()),
        on_vertices.sum(axis=(0, 1)),
        np.cross(at, on_vertices).sum(axis=(0, 1)),
        np.cross(across, friction).sum(axis=0),
    )


def crossings(
    positions: Floats, triangles: NDArray[np.int32], vertices: Floats, cut: NDArray[np.int32]
) -> int:
    """Count the edges of `triangles` that cross a triangle of `cut`.

    Edges and triangles that share a vertex do not count.

    The ends p and q of the edge lie on both sides of the triangle's plane, by more than `FLAT`, and
    the volumes of p, q and each side of the triangle have one sign.

    Args:
        positions: (N, 3) [m]
        triangles: (T, 3)
        vertices: (M, 3) [m]: `positions` itself where cloth is compared with itself.
        cut: (U, 3)
    """
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0)
    p, q = positions[edges[:, 0]], positions[edges[:, 1]]
    corners = vertices[cut]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    above, below = (end @ normal.T - (corners[:, 0] * normal).sum(axis=1) for end in (p, q))
    pairs = np.argwhere((np.minimum(np.abs(above), np.abs(below)) > FLAT) & (above * below < 0.0))
    if vertices is positions:
        pairs = pairs[~(edges[pairs[:, 0], :, None] == cut[pairs[:, 1], None, :]).any(axis=(1, 2))]
    start, along = p[pairs[:, 0]], (q - p)[pairs[:, 0]]
    a, b, c = np.moveaxis(corners[pairs[:, 1]] - start[:, None], 1, 0)
    sides = np.stack(
        [
            (along * np.cross(edge, next_edge)).sum(axis=1)
            for edge, next_edge in ((a, b), (b, c), (c, a))
        ]
    )
    return int((np.abs(np.sign(sides).sum(axis=0)) == 3).sum())


SIDE = 0.3
"""Of the sheets that drop [m]."""

SOFT = ("gray-interlock", "camel-ponte-roma", "white-dots-on-blk")
"""Fabrics that fold easily."""


def drop(seed: int, preset: SolverSettings) -> Tumble:
    """A sheet of any fabric falls and spins onto a floor, a corner or an edge ahead."""
    rng = np.random.default_rng(seed)
    cells = int(rng.integers(6, 13))
    mesh = (
        meshes.grid(SIDE, SIDE, cells, cells)
        if seed % 2
        else meshes.unstructured(SIDE, SIDE, SIDE / cells, seed)
    )
    a, tilt, heading = rng.uniform(0.0, 6.0), rng.uniform(-0.5, 0.5), rng.uniform(0.0, 6.0)
    c, s = np.cos(a), np.sin(a)
    flat = mesh.rest @ np.array([[c, s], [-s, c]])
    x = 0.004 * np.sin(60.0 * mesh.rest @ rng.normal(size=2)) + np.sin(tilt) * flat[:, 1]
    upright = np.column_stack([x, flat[:, 0], np.cos(tilt) * flat[:, 1]])
    c, s = np.cos(heading), np.sin(heading)
    start = upright @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    spin, speed = rng.normal(size=3) * 3.0, np.array([0.0, 0.0, -rng.uniform(0.2, 1.0)])
    velocity = np.cross(spin, start) + speed
    start[:, 2] += 0.005 - start[:, 2].min()
    name = fabric_names()[int(rng.integers(len(fabric_names())))]
    cloth = Cloth(
        mesh, fabric(name), preset, self_contact=SelfContact(float(rng.uniform(0.0, 1.2)))
    )
    cloth.set_state(start, velocity)
    return Tumble(cloth, [plane(float(rng.uniform(0.1, 1.2)))], _free, 100)


def crumple(seed: int, preset: SolverSettings) -> Tumble:
    """Four walls push a wavy sheet on a floor together, to a quarter of its area.

    The walls are surfaces.
    """
    rng = np.random.default_rng(seed)
    mesh = (
        meshes.grid(0.1, 0.1, 10, 10) if seed % 2 else meshes.unstructured(0.1, 0.1, 0.0105, seed)
    )
    u, v = mesh.rest.T
    waves = sum(
        np.sin(rng.uniform(30, 90) * u + rng.uniform(30, 90) * v + rng.uniform(0, 6))
        for _ in range(3)
    )
    friction = float(rng.uniform(0.0, 1.0))
    cloth = Cloth(
        mesh,
        fabric(SOFT[seed % len(SOFT)]),
        preset,
        self_contact=SelfContact(float(rng.uniform(0.0, 1.0))),
        surfaces=[wall(turn, friction) for turn in range(4)],
    )
    cloth.set_state(np.column_stack([0.98 * mesh.rest, 0.006 + 0.0015 * waves]))
    return Tumble(cloth, [plane(friction)], _free, 70)


def squeeze(seed: int, preset: SolverSettings) -> Tumble:
    """Four walls push a flat sheet together within its plane, which it has no reason to leave."""
    mesh = (
        meshes.grid(0.1, 0.1, 10, 10) if seed % 2 else meshes.unstructured(0.1, 0.1, 0.0105, seed)
    )
    walls = [wall(turn, 0.5) for turn in range(4)]
    cloth = Cloth(
        mesh, fabric("royal-target"), preset, self_contact=SelfContact(0.5), surfaces=walls
    )
    cloth.set_state(np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]))
    return Tumble(cloth, [plane(0.5)], _free, 12)


def wall(turn: int, mu: float) -> Surface:
    """Return an upright wall that comes closer to the origin, from 51 to 25 mm in 0.5 s.

    Turned by quarters about z.
    """
    corners = np.array([[-0.1, 0.0, -0.01], [0.1, 0.0, -0.01], [0.1, 0.0, 0.2], [-0.1, 0.0, 0.2]])
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn]
    about = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def at(time: float) -> Floats:
        moved: Floats = (corners + np.array([0.0, 0.051 - 0.052 * min(time, 0.5), 0.0])) @ about
        return moved

    return Surface([[0, 1, 2], [0, 2, 3]], at, mu)


def folding(seed: int, preset: SolverSettings) -> Tumble:
    """A strip is let down onto a floor by its upper edge, and folds to and fro.

    It comes down faster than it can slide away.
    """
    rng = np.random.default_rng(seed)
    cells = int(rng.integers(16, 25))
    mesh = (
        meshes.grid(0.03, 0.2, 3, cells)
        if seed % 2
        else meshes.unstructured(0.03, 0.2, 0.2 / cells, seed)
    )
    up = mesh.rest[:, 1] + 0.102
    held = np.flatnonzero(up > up.max() - 1e-9)
    start = np.column_stack(
        [1e-3 * np.sin(40.0 * up + rng.uniform(0, 6)) * (up.max() - up), mesh.rest[:, 0], up]
    )
    start[:, 0] += 0.05 * rng.uniform(-1.0, 1.0) * (up - up.max())

    def lowered(time: float) -> Floats:
        moved: Floats = start[held] - np.array([0.0, 0.0, 0.18 * min(time, 1.0)])
        return moved

    cloth = Cloth(
        mesh,
        fabric(SOFT[seed % len(SOFT)]),
        preset,
        held=held,
        self_contact=SelfContact(float(rng.uniform(0.1, 1.0))),
    )
    cloth.set_state(start)
    return Tumble(cloth, [plane(1.0)], lowered, 110)


def pile(seed: int, preset: SolverSettings, sheets: int = 5) -> Tumble:
    """Sheets of 6 x 6 cm, turned and tilted, fall onto each other and a floor."""
    rng = np.random.default_rng(seed)
    parts = [
        meshes.grid(0.06, 0.06, 5, 5) if i % 2 else meshes.unstructured(0.06, 0.06, 0.012, i)
        for i in range(sheets)
    ]
    places = []
    for i, part in enumerate(parts):
        angle, tilt = rng.uniform(0.0, 6.0), 0.1 * rng.normal(size=2)
        c, s = np.cos(angle), np.sin(angle)
        flat = part.rest @ np.array([[c, s], [-s, c]])
        places.append(np.column_stack([flat, 0.01 + 0.012 * i + flat @ tilt]))
    cloth = Cloth(
        meshes.together(*parts), fabric("gray-interlock"), preset, self_contact=SelfContact(0.4)
    )
    start = np.concatenate(places)
    start[:, 2] -= min(start[:, 2].min(), 0.0)  # none starts below the floor
    cloth.set_state(start)
    return Tumble(cloth, [plane(0.4)], _free, 60)


def _free(_: float) -> Floats:
    return np.empty((0, 3))


TUMBLES: Mapping[str, Callable[[SolverSettings], Tumble]] = MappingProxyType(
    {
        f"{make_tumble.__name__}-{seed}": partial(make_tumble, seed)
        for make_tumble, seeds in (
            (drop, range(8)),
            (folding, range(3)),
            (crumple, range(4)),
            (pile, range(4)),
            (squeeze, (1,)),
        )
        for seed in seeds
    }
)
"""By name, those that are quick to run first."""


def tumble(name: str, preset: str | SolverSettings = "certified") -> Tumble:
    """Return one of `TUMBLES`.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in TUMBLES:
        raise ValueError(f"tumble: must be one of {', '.join(TUMBLES)}, got {name!r}")
    return TUMBLES[name](preset_named(preset))
