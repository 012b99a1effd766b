"""Bodies of triangles: where they start, and how they move through the frames of their file.

Vertices move on cubics through the frames. The slope at a frame is that of the parabola through it
and its two neighbours, and 0 at both ends, as in the simulation core.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.geometry import TriangleMesh
from stickslip_schemas.scene.motions import Track

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

SKIN_VERTICES = 256
"""Vertices of a skin that are followed, evenly spread: they all follow the same few bones."""

POSITIONS_AT_ONCE = 200_000
"""Positions of vertices in frames that are compared in one operation: bounds the memory to 50 MB.
"""

CLOSEST_LOOKS = 16
"""Frames whose steps are sampled: those from which vertices bend most."""

SAMPLES_AROUND = 8
"""Samples of the path before and after such a frame, half a step apart."""

RIGID = 1e-6
"""Largest difference of the displacements of vertices at which a body moves as a whole [m]."""


@dataclass(frozen=True, slots=True)
class Jump:
    """Where the frames of a body change too fast."""

    time: float
    """When the step begins [s]."""
    vertex: int
    distance: float
    """Of the vertex from an even motion within the step [m]."""
    speed: float
    """Of the vertex in the faster half of the step [m/s]."""


def surface_at_start(body: Mapping[str, Any]) -> TriangleMesh:
    """Return the triangles of a body of type mesh where they are at 0 s."""
    file = body["file"]
    vertices = _frame_positions(file, slice(None), slice(0, 1))[0]
    if body["motion"] is not None:
        pose = Track(body["motion"]).pose_at_start(vertices.mean(axis=0))
        vertices = vertices @ pose[:, :3].T + pose[:, 3]
    return TriangleMesh(np.asarray(vertices, float), np.asarray(file["triangles"], np.int64))


def rigid_displacements(body: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return displacements of a mesh since its first frame (F, 3) [m], and their times (F,) [s].

    They are empty for a body that turns or deforms: where its parts are depends on their shape.
    """
    file = body["file"]
    times = np.asarray(file["times"], float)
    moves = np.empty((0, 3))
    for vertices in _groups(file):
        positions = _frame_positions(file, vertices, slice(None))
        shifts = float(body["strength"]) * (positions - positions[0])
        moves = moves if len(moves) else shifts[:, 0]
        if np.abs(shifts - moves[:, None]).max() > RIGID:
            return np.empty((0, 3)), np.empty(0)
    return moves, times


def largest_jump(body: Mapping[str, Any], step: float, end: float) -> Jump | None:
    """Return where a vertex is farthest from an even motion within a step; None if nothing moves.

    Args:
        body: The JSON of a body of type mesh, with the arrays of its file.
        step: Length of the step [s].
        end: When the scene ends [s].
    """
    file = body["file"]
    times = np.asarray(file["times"], float)
    count = int(np.searchsorted(times, end, side="right"))
    # The frame after the end, and the slope there, have an effect on the way to it.
    times = times[: count + 2]
    largest: Jump | None = None
    if len(times) < 2:
        return None
    for vertices in _groups(file):
        path = float(body["strength"]) * _frame_positions(file, vertices, slice(0, len(times)))
        jump = _jump_of(times, path, step, end)
        if largest is None or jump.distance > largest.distance:
            largest = Jump(jump.time, int(vertices[jump.vertex]), jump.distance, jump.speed)
    return largest


def _jump_of(times: Floats, path: Floats, step: float, end: float) -> Jump:
    """Return the largest jump of vertices with positions (F, V, 3) [m] at frames (F,) [s]."""
    lengths = np.diff(times)[:, None, None]
    rates = np.diff(path, axis=0) / lengths
    slopes = np.zeros_like(path)
    slopes[1:-1] = (lengths[1:] * rates[:-1] + lengths[:-1] * rates[1:]) / (
        lengths[1:] + lengths[:-1]
    )
    # Second derivatives of the cubic at the begin and the end of each piece, times its length. A
    # piece that is shorter than a step bends the path for its own length only.
    bends = np.maximum(
        np.linalg.norm(6.0 * rates - 4.0 * slopes[:-1] - 2.0 * slopes[1:], axis=2),
        np.linalg.norm(6.0 * rates - 2.0 * slopes[:-1] - 4.0 * slopes[1:], axis=2),
    )
    scores = bends / lengths[..., 0] * np.minimum(lengths[..., 0], step) ** 2
    scores[times[:-1] > end] = 0.0
    looks = min(CLOSEST_LOOKS, scores.size)
    chosen = np.argpartition(scores, scores.size - looks, axis=None)[-looks:]
    largest = Jump(0.0, 0, 0.0, 0.0)
    offsets = 0.5 * step * np.arange(-SAMPLES_AROUND, SAMPLES_AROUND + 1)
    for piece, vertex in zip(*np.unravel_index(chosen, scores.shape), strict=True):
        instants = np.concatenate([times[piece] + offsets, times[piece + 1] + offsets])
        instants = np.clip(np.sort(instants), 0.0, end)
        middles = np.clip(instants, 0.5 * step, None)
        curve = _Cubics(times, path[:, vertex], slopes[:, vertex])
        begin, ends = curve.at(middles - 0.5 * step), curve.at(middles + 0.5 * step)
        at_middle = curve.at(middles)
        distances = np.linalg.norm(at_middle - 0.5 * (begin + ends), axis=1)
        # What goes and comes back within a step has no speed over all of it.
        ways = np.linalg.norm(np.stack([at_middle - begin, ends - at_middle]), axis=2).max(axis=0)
        worst = int(np.argmax(distances))
        if distances[worst] > largest.distance:
            largest = Jump(
                float(middles[worst] - 0.5 * step),
                int(vertex),
                float(distances[worst]),
                float(ways[worst]) / (0.5 * step),
            )
    return largest


@dataclass(frozen=True, eq=False, slots=True)
class _Cubics:
    """A path through frames, with slopes at them."""

    times: Floats
    """(F,) [s]"""
    values: Floats
    """(F, 3) [m]"""
    slopes: Floats
    """(F, 3) [m/s]"""

    def at(self, instants: Floats) -> Floats:
        """Return the positions (K, 3) [m] at instants (K,) [s]; nothing moves outside of frames."""
        inside = np.clip(instants, self.times[0], self.times[-1])
        last_piece = len(self.times) - 2
        piece = np.clip(np.searchsorted(self.times, inside, side="right") - 1, 0, last_piece)
        length = np.diff(self.times)[piece][:, None]
        s = (inside - self.times[piece])[:, None] / length
        # Hermite's cubic between two frames.
        return np.asarray(
            self.values[piece] * (1.0 + 2.0 * s) * (1.0 - s) ** 2
            + self.slopes[piece] * length * s * (1.0 - s) ** 2
            + self.values[piece + 1] * s * s * (3.0 - 2.0 * s)
            + self.slopes[piece + 1] * length * s * s * (s - 1.0)
        )


def _vertex_count(file: Mapping[str, Any]) -> int:
    return len(file["rest"]) if "bones" in file else file["positions"].shape[1]


def _groups(file: Mapping[str, Any]) -> list[Integers]:
    """Return the vertices of a file whose motion is compared, in groups that fit into memory."""
    count = _vertex_count(file)
    if "bones" in file:
        return [np.unique(np.linspace(0, count - 1, min(count, SKIN_VERTICES)).astype(np.int64))]
    groups = -(-count * len(file["times"]) // POSITIONS_AT_ONCE)
    return np.array_split(np.arange(count), min(groups, count))


def _frame_positions(file: Mapping[str, Any], vertices: Integers | slice, frames: slice) -> Floats:
    """Return where vertices (V,) are in frames of a file (F, V, 3) [m]."""
    if "bones" not in file:
        return np.asarray(file["positions"][frames][:, vertices], float)
    rest = np.asarray(file["rest"][vertices], float)
    rest = np.column_stack([rest, np.ones(len(rest))])
    weights = np.asarray(file["weights"][vertices], float)
    # A vertex of a skin is the sum over bones of w (A x + b).
    bones = np.asarray(file["bones"][frames], float)
    return np.asarray(np.einsum("nb,fbij,nj->fni", weights, bones, rest, optimize=True))
