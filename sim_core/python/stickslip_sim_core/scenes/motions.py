"""Prescribed motions: keyframes, and the frames of an animated mesh.

All are smooth in time, and begin and end at rest.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats


def _times(times: ArrayLike) -> Floats:
    """Return instants (K,) [s] that ascend from 0 or later, or raise ValueError."""
    t = np.asarray(times, float)
    if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or t[0] < 0.0 or not (np.diff(t) > 0.0).all():
        raise ValueError(f"times: must be one or more instants that ascend from 0 s or later, got {t.tolist()}")
    return t


def _through(times: Floats, values: Floats, slopes: Floats) -> Callable[[float], Floats]:
    """Return the cubic Hermite interpolant of values (K, ...); constant before the first and after the last."""
    from scipy.interpolate import CubicHermiteSpline  # here, so that importing the package stays quick

    if len(times) == 1:
        return lambda _time: np.array(values[0])
    path = CubicHermiteSpline(times, values, slopes)
    return lambda time: np.asarray(path(min(max(time, float(times[0])), float(times[-1]))))


@dataclass(frozen=True, eq=False)
class Keyframes:
    """A rigid motion through keyframes, without overshoot: monotone cubics [Fritsch & Carlson 1980].

    Nothing moves before the first and after the last keyframe.

    Raises:
        ValueError: An argument breaks its rule.
    """

    times: ArrayLike
    """(K,) [s], ascending, from 0 on."""

    moves: ArrayLike
    """(K, 3): displacements since the start [m]."""

    turns: ArrayLike
    """(K, 3): rotations since the start, as rotation vectors [rad], whose components are interpolated."""

    about: ArrayLike = (0.0, 0.0, 0.0)
    """(3,): the point at the start that rotations are about [m]."""

    _path: Callable[[float], Floats] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times))
        shape = (len(np.asarray(self.times)), 3)
        for name, expected in (("moves", shape), ("turns", shape), ("about", (3,))):
            value = np.asarray(getattr(self, name), float)
            if value.shape != expected or not np.isfinite(value).all():
                raise ValueError(f"{name}: must be finite, of shape {expected}, got {value.tolist()}")
            object.__setattr__(self, name, value)
        values = np.concatenate([np.asarray(self.moves), np.asarray(self.turns)], axis=1)
        times = np.asarray(self.times)
        object.__setattr__(self, "_path", _through(times, values, _monotone(times, values)))

    def at(self, time: float) -> tuple[Floats, Floats]:
        """Return the motion at a time [s]: x -> R x + b, as R (3, 3) and b (3,) [m]."""
        found = self._path(time)
        R, about = rotation(found[3:]), np.asarray(self.about)
        shift: Floats = about + found[:3] - R @ about
        return R, shift

    def pose(self, time: float) -> Floats:
        """Return the motion at a time [s] as (3, 4)."""
        R, shift = self.at(time)
        return np.column_stack([R, shift])


def _monotone(times: Floats, values: Floats) -> Floats:
    """Return the slopes of monotone cubics (K, n) at keyframes: 0 at both ends and where a value turns back."""
    from scipy.interpolate import PchipInterpolator

    slopes = np.zeros_like(values)
    if len(times) > 2:
        slopes[1:-1] = PchipInterpolator(times, values).derivative()(times[1:-1])
    return slopes


def rotation(turn: ArrayLike) -> Floats:
    """Return the matrix (3, 3) of a rotation vector (3,) [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.asarray(turn, float)).as_matrix())


@dataclass(frozen=True, eq=False)
class MovingMesh:
    """Triangles whose vertices pass through given frames, with the slopes of parabolas through three of them.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: ArrayLike
    """(F,) [s], ascending, from 0 on. Before the first and after the last frame nothing moves."""

    positions: ArrayLike
    """(F, N, 3) [m]"""

    _path: Callable[[float], Floats] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times))
        path = np.asarray(self.positions, float)
        if path.ndim != 3 or path.shape[2] != 3 or not np.isfinite(path).all():
            raise ValueError(f"positions: must be finite, of shape (frames, vertices, 3), got {path.shape}")
        times = np.asarray(self.times)
        if len(path) != len(times):
            raise ValueError(f"positions: must have {len(times)} frames, one for each instant, got {len(path)}")
        object.__setattr__(self, "positions", path)
        object.__setattr__(self, "triangles", np.asarray(self.triangles, dtype=np.int32))
        slopes = np.zeros_like(path)
        h = np.diff(times)[:, None, None]
        rate = np.diff(path, axis=0) / h
        slopes[1:-1] = (h[1:] * rate[:-1] + h[:-1] * rate[1:]) / (h[1:] + h[:-1])
        object.__setattr__(self, "_path", _through(times, path, slopes))

    def at(self, time: float) -> Floats:
        """Return the vertices at a time [s]: (N, 3) [m]."""
        return self._path(time)


def read_moving_mesh(path: str | Path, *, frame_rate: float | None = None) -> MovingMesh:
    """Read triangles that may move: an OBJ file, a folder of them, one a frame, or an NPZ file.

    Polygons are cut into triangles. An NPZ file has `positions` (F, N, 3) [m], `triangles` (T, 3) and `times` (F,) [s];
    `python -m stickslip_blender.import_mesh` writes one from Alembic, USD and what else Blender reads.

    Args:
        path: What to read; frames of a folder are in the order of their names.
        frame_rate: Of a folder [1/s]; its first frame is at 0 s.

    Raises:
        ValueError: It holds no such mesh.
        OSError: It cannot be read.
    """
    place = Path(path)
    if place.is_dir():
        files = sorted(place.glob("*.obj"))
        if not files:
            raise ValueError(f"{place}: must hold OBJ files, one a frame, and holds none")
        if frame_rate is None or not (np.isfinite(frame_rate) and frame_rate > 0.0):
            raise ValueError(f"frame_rate: must be > 0 for a folder of frames, got {frame_rate}")
        frames = [read_obj(file) for file in files]
        for file, (vertices, triangles) in zip(files, frames, strict=True):
            if vertices.shape != frames[0][0].shape or not np.array_equal(triangles, frames[0][1]):
                raise ValueError(f"{file}: must have the vertices and faces of {files[0].name}, in the same order")
        return MovingMesh(frames[0][1], np.arange(len(files)) / frame_rate, np.stack([frame[0] for frame in frames]))
    if place.suffix.lower() == ".obj":
        vertices, triangles = read_obj(place)
        return MovingMesh(triangles, [0.0], vertices[None])
    if place.suffix.lower() == ".npz":
        with np.load(place, allow_pickle=False) as file:
            missing = [name for name in ("positions", "triangles", "times") if name not in file]
            if missing:
                raise ValueError(
                    f"{place}: must have positions, triangles and times, and {', '.join(missing)} is not there"
                )
            return MovingMesh(file["triangles"], file["times"], file["positions"])
    raise ValueError(f"{place}: must be an OBJ file, a folder of OBJ files, or an NPZ file")


def read_obj(path: Path) -> tuple[Floats, NDArray[np.int32]]:
    """Return the vertices (N, 3) and triangles (T, 3) of a Wavefront OBJ file; its polygons are cut into triangles.

    Raises:
        ValueError: A line is no vertex or face.
    """
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        word, *rest = line.split() or [""]
        try:
            if word == "v":
                x, y, z = map(float, rest[:3])
                vertices.append([x, y, z])
            elif word == "f":
                corners = list(_corners(rest, len(vertices)))
                triangles += [(corners[0], b, c) for b, c in pairwise(corners[1:])]
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path}, line {number}: must be a vertex or a face, got {line.strip()!r}") from error
    if not triangles:
        raise ValueError(f"{path}: must have faces, and has none")
    return np.array(vertices), np.array(triangles, dtype=np.int32)


def _corners(words: list[str], count: int) -> Iterable[int]:
    """Return the vertices of a face, from 0: an OBJ file counts from 1, or from -1 back from the last one."""
    if len(words) < 3:
        raise ValueError("a face has three corners or more")
    for word in words:
        number = int(word.partition("/")[0])
        if not 1 <= abs(number) <= count:
            raise ValueError("a corner must be a vertex that is there")
        yield number - 1 if number > 0 else count + number
