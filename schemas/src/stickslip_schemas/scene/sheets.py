"""Sheets where they start: their flat vertices, triangles, positions, and what holders hold.

The meshes are those of the simulation core, except that an unstructured sheet stands as a grid of
its lattice: its vertices are scattered about that by less than a spacing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.geometry import TriangleMesh
from stickslip_schemas.scene.motions import rotation_matrix
from stickslip_schemas.scene.parts import Unstructured
from stickslip_schemas.scene.shapes import cell_side

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SLACK = 1e-9
"""Distance from an edge, over the size of the sheet, up to which a vertex is on it."""


@dataclass(frozen=True, eq=False, slots=True)
class SheetStart:
    """A sheet where it starts."""

    name: str
    rest: Floats
    """(V, 2) [m]: the flat sheet."""
    mesh: TriangleMesh
    """Where it starts."""
    is_flat: bool
    """True if it starts flat or strained, so that it cannot cross itself."""
    is_hung: bool
    """True if it is let down first: nobody knows yet where it starts."""
    jitter: float
    """How far vertices may be from those here [m]; 0 if they are the same."""
    pieces: int
    cell: float
    """Side of a cell [m], see `cell_side`."""
    least_height: float
    """Least height of a triangle over an edge that it shares [m]; inf if it is not known."""

    @property
    def positions(self) -> Floats:
        """(V, 3) [m]."""
        return self.mesh.vertices


def start_of(name: str, sheet: Mapping[str, Any]) -> SheetStart:
    """Return where a sheet starts; `sheet` is its JSON, with the arrays of files."""
    rest, triangles, positions, jitter = _mesh_of(sheet["mesh"])
    start = sheet["start"]
    local = np.column_stack([rest, np.zeros(len(rest))])
    if start["type"] == "stretched":
        local[:, :2] = (1.0 + np.array(start["strain"])) * rest
    elif start["type"] == "file":
        file = start["file"]
        local = np.asarray(positions if file is None else file["positions"], float)
    turn = rotation_matrix(np.array(sheet["turn"], float))
    placed = local @ turn.T + np.array(sheet["origin"], float)
    is_file = sheet["mesh"]["type"] == "file"
    return SheetStart(
        name=name,
        rest=rest,
        mesh=TriangleMesh(placed, triangles),
        is_flat=start["type"] in ("flat", "stretched"),
        is_hung=start["type"] == "hung",
        jitter=jitter,
        pieces=_count_pieces(triangles) if is_file else 1,
        cell=_cell_of(sheet["mesh"], rest, triangles),
        least_height=np.inf if jitter else _least_height(rest, triangles),
    )


def _mesh_of(mesh: Mapping[str, Any]) -> tuple[Floats, Integers, Floats | None, float]:
    """Return the flat vertices, triangles, positions of a file, and the jitter of vertices."""
    if mesh["type"] == "file":
        file = mesh["file"]
        return (
            np.asarray(file["rest"], float),
            np.asarray(file["triangles"], np.int64),
            file["positions"],
            0.0,
        )
    width, length = mesh["size"]
    if mesh["type"] == "grid":
        rest, triangles = _grid(width, length, *mesh["cells"])
        return rest, triangles, None, 0.0
    spacing = mesh["spacing"]
    columns = max(1, round(width / spacing))
    rows = max(1, round(length / (spacing * 0.75**0.5)))
    rest, triangles = _grid(width, length, columns, rows)
    return rest, triangles, None, spacing


def _cell_of(mesh: Mapping[str, Any], rest: Floats, triangles: Integers) -> float:
    """Return the side of a cell of a sheet [m]; `mesh` is its JSON."""
    if mesh["type"] != "unstructured":
        return cell_side(rest, triangles)
    # The lattice here lacks the vertices with which shifted rows begin and end.
    _, count = Unstructured(size=mesh["size"], spacing=mesh["spacing"]).shape
    return float(np.sqrt(2.0 * mesh["size"][0] * mesh["size"][1] / count))


def _grid(width: float, length: float, columns: int, rows: int) -> tuple[Floats, Integers]:
    """Return the vertices and triangles of a grid, with alternating diagonals."""
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, columns + 1) * width, np.linspace(-0.5, 0.5, rows + 1) * length
    )
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    a = (row * (columns + 1) + column).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    rising = ((row + column) % 2 == 0).ravel()
    up = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)
    down = np.stack([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)], axis=1)
    triangles = np.where(rising[:, None, None], up, down).reshape(-1, 3)
    return np.stack([x.ravel(), y.ravel()], axis=1), triangles


def _count_pieces(triangles: Integers) -> int:
    """Return how many pieces triangles form that share vertices."""
    vertices, corners = np.unique(triangles, return_inverse=True)
    corners = corners.reshape(triangles.shape)
    label = np.arange(len(vertices))
    while True:
        # Each vertex takes the least label of its triangles, and then that of its label.
        least = label[corners].min(axis=1)
        spread = label.copy()
        for corner in range(3):
            np.minimum.at(spread, corners[:, corner], least)
        spread = spread[spread]
        if np.array_equal(spread, label):
            return len(np.unique(label))
        label = spread


def _least_height(rest: Floats, triangles: Integers) -> float:
    """Return the least height over an edge that two triangles share [m]; inf without one.

    The core refuses vertices that are nearer to the triangle beyond that edge than the thickness.
    """
    edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    opposite = np.concatenate([triangles[:, corner] for corner in (2, 0, 1)])
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, group, counts = np.unique(low * len(rest) + high, return_inverse=True, return_counts=True)
    is_shared = counts[group.ravel()] > 1
    if not is_shared.any():
        return float("inf")
    begin, end = rest[edges[is_shared, 0]], rest[edges[is_shared, 1]]
    along = end - begin
    offset = rest[opposite[is_shared]] - begin
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-300)
    # The nearest point of the edge is its end where the foot lies beyond it.
    fraction = np.clip(np.einsum("ij,ij->i", offset, along) / length**2, 0.0, 1.0)
    return float(np.linalg.norm(offset - fraction[:, None] * along, axis=1).min())


def held_vertices(
    sheet: SheetStart, holder: Mapping[str, Any], *, margin: float = 0.0
) -> npt.NDArray[np.bool_]:
    """Return which vertices of a sheet a holder holds: (V,).

    `margin` widens a rectangle [m]: scattered vertices may be in it or not by their jitter.
    """
    rest = sheet.rest
    low, high = rest.min(axis=0), rest.max(axis=0)
    slack = SLACK * float((high - low).max())
    held = np.zeros(len(rest), dtype=bool)
    if holder["vertices"] is not None:
        numbers = np.array(holder["vertices"], np.int64)
        held[numbers[numbers < len(rest)]] = True
    elif holder["rim"]:
        held[_rim(sheet.mesh.triangles)] = True
    elif holder["edge"] is not None:
        sides = {"left": (0, low), "right": (0, high), "bottom": (1, low), "top": (1, high)}
        axis, bound = sides[holder["edge"]]
        held[:] = np.abs(rest[:, axis] - bound[axis]) <= slack
    else:
        above = rest >= np.array(holder["low"]) - slack - margin
        below = rest <= np.array(holder["high"]) + slack + margin
        held[:] = (above & below).all(axis=1)
    return held


def _rim(triangles: Integers) -> Integers:
    edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    low, high = edges.min(axis=1), edges.max(axis=1)
    # One number for each edge, of both vertices.
    count = int(triangles.max()) + 1
    unique, counts = np.unique(low * count + high, return_counts=True)
    return np.unique(np.divmod(unique[counts == 1], count))
