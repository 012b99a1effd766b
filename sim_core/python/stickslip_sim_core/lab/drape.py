"""Cusick's drape test: a disc of cloth hangs over a smaller pedestal [BS 5058:1973].

The disc of 30 cm lies between two plates of 18 cm, and its overhanging ring falls into folds. The
drape coefficient is the share of the ring that its shadow from above covers:

    DC = (A - pi r^2) / (pi R^2 - pi r^2),   r = 9 cm, R = 15 cm
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats, check_range
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.lab.settling import STEADY_STEPS, settle

DISC_RADIUS = 0.15
"""R [m]."""
PEDESTAL_RADIUS = 0.09
"""r [m]."""
CELL = 0.005
"""Usual distance of vertices [m]."""
REST = 2e-5
"""The cloth is at rest if no vertex moves further than this in a long step [m]."""
UNEVENNESS = 1e-4
"""Height of the bumps in which the disc starts [m]. A flat ring would stay flat."""
SHADOW_PIXEL = 2.5e-4
"""Side of the pixels of the shadow [m]: 0.1 points of the coefficient."""


@dataclass(frozen=True, eq=False)
class Drape:
    """A draped disc."""

    fabric: str
    coefficient: float
    """Drape coefficient [%]."""

    folds: int
    """Number of folds: maxima of the outline of the shadow that rise above its mean."""

    drop: tuple[float, float]
    """Least and largest drop of the rim below the pedestal [m]."""

    cell: float
    """Distance of vertices [m]."""

    at_rest: bool
    """Whether the cloth came to rest."""

    unconverged: int
    """Steps that stopped short of the tolerance."""

    flat: Floats
    """Vertices of the flat ring: (V, 2) [m]."""

    positions: Floats
    """Vertices of the ring at rest: (V, 3) [m], the pedestal's plane is z = 0."""

    triangles: NDArray[np.int32]
    """Triangles of the ring: (T, 3)."""


def drape(
    fabric: Fabric,
    *,
    cell: float = CELL,
    seed: int = 0,
    preset: str = "fast",
    coarser: Drape | None = None,
) -> Drape:
    """Drape a disc of a fabric.

    The folds that form are a matter of chance: bumps and meshes decide on them. With `coarser` the
    disc begins with the folds of another drape, so that the two differ by their cells alone.

    Args:
        fabric: The fabric, whose warp runs along x.
        cell: Distance of vertices [m], from 1 to 20 mm.
        seed: Seed of the mesh and of the bumps in which the disc starts.
        preset: Solver settings, by name.
        coarser: The same fabric, draped with larger cells.

    Raises:
        ValueError: The cell is out of its range, or there is no such preset.
    """
    check_range("cell", cell, 1e-3, 0.02)
    # Only the ring moves. Two rows are held: half a cell within the pedestal's edge and half a
    # cell beyond it, so that the cloth is level at the edge itself.
    ring = meshes.ring(PEDESTAL_RADIUS, DISC_RADIUS, cell, seed)
    radius = np.hypot(*ring.mesh.rest.T)
    held = np.flatnonzero(radius < ring.clamped)
    start = np.column_stack([ring.mesh.rest, _bumps(radius, seed)])
    if coarser is not None:
        start = refined(coarser, ring.mesh.rest)
    start[held] = np.column_stack([ring.mesh.rest[held], np.zeros(len(held))])

    cloth = Cloth(ring.mesh, fabric, preset_named(preset), held=held)
    cloth.set_state(start)
    # Cloth that has its folds needs no short steps, in which it would choose them.
    steady_steps = STEADY_STEPS if coarser is None else 0
    at_rest = settle(cloth, start[held], rest=REST, steady_steps=steady_steps)

    positions = cloth.positions
    rim = ring.mesh.rim
    rim = rim[radius[rim] > 0.5 * (PEDESTAL_RADIUS + DISC_RADIUS)]
    drops = -positions[rim, 2]
    overhang = np.pi * (DISC_RADIUS**2 - PEDESTAL_RADIUS**2)
    return Drape(
        fabric=fabric.name,
        coefficient=100.0 * shadow_beyond_pedestal(positions, ring.mesh.triangles) / overhang,
        folds=count_folds(positions[rim]),
        drop=(float(drops.min()), float(drops.max())),
        cell=cell,
        at_rest=at_rest,
        unconverged=cloth.total.unconverged,
        flat=ring.mesh.rest,
        positions=positions,
        triangles=ring.mesh.triangles,
    )


def _bumps(radius: Floats, seed: int) -> Floats:
    """Return heights at the start (V,) [m], which grow from the pedestal outwards."""
    bumps = np.random.default_rng(seed).uniform(-UNEVENNESS, UNEVENNESS, len(radius))
    return np.asarray(bumps * np.clip((radius - PEDESTAL_RADIUS) / DISC_RADIUS, 0.0, None))


def refined(coarser: Drape, points: Floats) -> Floats:
    """Return the places at rest of points of the flat ring (N, 2) on a coarser drape (N, 3) [m]."""
    a, b, c = np.moveaxis(coarser.flat[coarser.triangles], 1, 0)
    u, v = b - a, c - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    places = np.empty((len(points), 3))
    for number, point in enumerate(points):
        d = point - a
        # Barycentric coordinates in all triangles.
        s = (d[:, 0] * v[:, 1] - d[:, 1] * v[:, 0]) / area
        t = (u[:, 0] * d[:, 1] - u[:, 1] * d[:, 0]) / area
        weights = np.column_stack([1.0 - s - t, s, t])
        # The circles of a finer ring go beyond the polygons of a coarser one by less than a cell:
        # the triangle that is nearest by this measure is extended.
        nearest = int(np.argmax(weights.min(axis=1)))
        places[number] = weights[nearest] @ coarser.positions[coarser.triangles[nearest]]
    return places


def shadow_beyond_pedestal(positions: Floats, triangles: NDArray[np.int32]) -> float:
    """Return the area of the shadow from above, without the pedestal's [m^2].

    Folds may hang over each other, so the union of the triangles is counted in pixels.
    """
    count = round(2.1 * DISC_RADIUS / SHADOW_PIXEL)
    half = 0.5 * count * SHADOW_PIXEL
    centres: Floats = np.linspace(-half, half, count, endpoint=False) + 0.5 * SHADOW_PIXEL
    covered = np.zeros((count, count), dtype=bool)
    for corners in positions[triangles][:, :, :2]:
        # The pixels of the box around the triangle.
        low = np.floor((corners.min(axis=0) + half) / SHADOW_PIXEL).astype(int)
        high = np.ceil((corners.max(axis=0) + half) / SHADOW_PIXEL).astype(int) + 1
        columns = slice(low[0], high[0])
        rows = slice(low[1], high[1])
        covered[columns, rows] |= _inside(corners, centres[columns], centres[rows])
    beyond = np.hypot(centres[:, None], centres[None, :]) > PEDESTAL_RADIUS
    return float((covered & beyond).sum()) * SHADOW_PIXEL**2


def _inside(corners: Floats, x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Return which points of a grid are in a triangle (3, 2): (X, Y)."""
    a, b, c = corners
    (ux, uy), (vx, vy) = b - a, c - a
    area = ux * vy - uy * vx
    # A triangle that is seen edge on has no shadow.
    if abs(area) < 1e-14:
        return np.zeros((len(x), len(y)), dtype=bool)
    dx = x[:, None] - a[0]
    dy = y[None, :] - a[1]
    # Barycentric coordinates.
    s = (dx * vy - dy * vx) / area
    t = (dy * ux - dx * uy) / area
    return np.asarray((s >= 0.0) & (t >= 0.0) & (s + t <= 1.0))


def count_folds(rim: Floats) -> int:
    """Return how often the radius of a rim (N, 3), seen from above, rises above its mean."""
    order = np.argsort(np.arctan2(rim[:, 1], rim[:, 0]))
    radius = np.hypot(rim[order, 0], rim[order, 1])
    is_out = radius > radius.mean()
    return int((is_out & ~np.roll(is_out, 1)).sum())
