"""Bodies of triangles: where they start, and how they move through the frames of their file.

Vertices move on cubics through the frames. The slope at a frame is that of the parabola through it
and its two neighbours, and 0 at both ends, as in the simulation core.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
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


@dataclass(eq=False)
class FileMotion:
    """The motion of a file of a body. Each part is computed once, however many rules ask for it."""

    file: Mapping[str, Any]
    """Its arrays."""
    strength: float
    """Factor of the displacements since the first frame."""

    @cached_property
    def start(self) -> Floats:
        """Positions of the vertices in the first frame (N, 3) [m]."""
        return np.asarray(_frame_positions(self.file, slice(None), slice(0, 1))[0], float)

    @cached_property
    def rigid_displacements(self) -> tuple[Floats, Floats]:
        """Displacements since the first frame (F, 3) [m], and their times (F,) [s].

        They are empty for a mesh that turns or deforms: where its parts are depends on their shape.
        """
        times = np.asarray(self.file["times"], float)
        # One frame cannot move.
        if len(times) < 2:
            return np.zeros((1, 3)), times
        moves = np.empty((0, 3))
        for vertices in _groups(self.file):
            positions = _frame_positions(self.file, vertices, slice(None))
            shifts = self.strength * (positions - positions[0])
            moves = moves if len(moves) else shifts[:, 0]
            if np.abs(shifts - moves[:, None]).max() > RIGID:
                return np.empty((0, 3)), np.empty(0)
        return moves, times

    def largest_jump(self, step: float, end: float) -> Jump | None:
        """Return where a vertex is farthest from an even motion within a step.

        It is None if nothing moves.

        Args:
            step: Length of the step [s].
            end: When the scene ends [s].
        """
        times = np.asarray(self.file["times"], float)
        count = int(np.searchsorted(times, end, side="right"))
        # The frame after the end, and the slope there, have an effect on the way to it.
        times = times[: count + 2]
        largest: Jump | None = None
        if len(times) < 2:
            return None
        moves, _ = self.rigid_displacements
        # Of a mesh that moves as a whole, each vertex makes the same jump.
        if len(moves):
            return _jump_of(times, moves[: len(times), None], step, end)
        for vertices in _groups(self.file):
            frames = slice(0, len(times))
            path = self.strength * _frame_positions(self.file, vertices, frames)
            jump = _jump_of(times, path, step, end)
            if largest is None or jump.distance > largest.distance:
                largest = Jump(jump.time, int(vertices[jump.vertex]), jump.distance, jump.speed)
        return largest


@dataclass(frozen=True, eq=False, slots=True)
class MovingMesh:
    """A body of type mesh."""

    frames: FileMotion
    surface: TriangleMesh
    """Its triangles where they are at 0 s."""


def moving_meshes(document: Mapping[str, Any]) -> dict[str, MovingMesh]:
    """Return the bodies of type mesh of a scene by name, sorted.

    `document` is the physics as JSON, with the arrays of files. Bodies of one file share what does
    not depend on their own motion.
    """
    by_file: dict[tuple[int, float], FileMotion] = {}
    meshes = {}
    for name, body in sorted(document["bodies"].items()):
        if body["type"] != "mesh":
            continue
        file, strength = body["file"], float(body["strength"])
        # The document keeps the file, so its identity stays that of its arrays.
        frames = by_file.setdefault((id(file), strength), FileMotion(file, strength))
        vertices = frames.start
        if body["motion"] is not None:
            pose = Track(body["motion"]).pose_at_start(vertices.mean(axis=0))
            vertices = vertices @ pose[:, :3].T + pose[:, 3]
        triangles = np.asarray(file["triangles"], np.int64)
        meshes[name] = MovingMesh(frames, TriangleMesh(vertices, triangles))
    return meshes


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
    pieces, vertices = np.unravel_index(chosen, scores.shape)
    offsets = 0.5 * step * np.arange(-SAMPLES_AROUND, SAMPLES_AROUND + 1)
    # (L, K) instants around the begin and the end of each chosen piece.
    instants = np.hstack([times[pieces][:, None] + offsets, times[pieces + 1][:, None] + offsets])
    middles = np.clip(np.clip(instants, 0.0, end), 0.5 * step, None)
    cubics = _Cubics(times, path, slopes)
    begins = cubics.at(vertices, middles - 0.5 * step)
    ends = cubics.at(vertices, middles + 0.5 * step)
    at_middle = cubics.at(vertices, middles)
    distances = np.linalg.norm(at_middle - 0.5 * (begins + ends), axis=2)
    look, sample = np.unravel_index(int(np.argmax(distances)), distances.shape)
    # What goes and comes back within a step has no speed over all of it.
    halves = [at_middle - begins, ends - at_middle]
    way = max(float(np.linalg.norm(half[look, sample])) for half in halves)
    return Jump(
        float(middles[look, sample] - 0.5 * step),
        int(vertices[look]),
        float(distances[look, sample]),
        way / (0.5 * step),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Cubics:
    """Paths of vertices through frames, with slopes at them."""

    times: Floats
    """(F,) [s]"""
    values: Floats
    """(F, V, 3) [m]"""
    slopes: Floats
    """(F, V, 3) [m/s]"""

    def at(self, vertices: Integers, instants: Floats) -> Floats:
        """Return where vertices (L,) are at K instants each (L, K) [s]: (L, K, 3) [m].

        Nothing moves outside of the frames.
        """
        inside = np.clip(instants, self.times[0], self.times[-1])
        last_piece = len(self.times) - 2
        piece = np.clip(np.searchsorted(self.times, inside, side="right") - 1, 0, last_piece)
        length = np.diff(self.times)[piece][..., None]
        s = (inside - self.times[piece])[..., None] / length
        of = vertices[:, None]
        # Hermite's cubic between two frames.
        return np.asarray(
            self.values[piece, of] * (1.0 + 2.0 * s) * (1.0 - s) ** 2
            + self.slopes[piece, of] * length * s * (1.0 - s) ** 2
            + self.values[piece + 1, of] * s * s * (3.0 - 2.0 * s)
            + self.slopes[piece + 1, of] * length * s * s * (s - 1.0)
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
