"""Prescribed motions: keyframes, and the frames of an animated mesh.

All are smooth in time, and begin and end at rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats

RIGHT_ANGLE = 1e-12
"""Entries of a matrix that are all as near to -1, 0 and 1 are meant to be right angles: radians
have no exact ones.
"""


def _times(times: ArrayLike) -> Floats:
    """Return instants (K,) [s] that ascend from 0 or later, or raise ValueError."""
    t = np.asarray(times, float)
    if (
        t.ndim != 1
        or not len(t)
        or not np.isfinite(t).all()
        or t[0] < 0.0
        or not (np.diff(t) > 0.0).all()
    ):
        raise ValueError(
            f"times: must be one or more instants that ascend from 0 s or later, got {t.tolist()}"
        )
    return t


def _through(times: Floats, values: Floats, slopes: Floats) -> Callable[[ArrayLike], Floats]:
    """Return the cubic Hermite interpolant of values (K, ...).

    Constant before the first and after the last.
    """
    from scipy.interpolate import (
        CubicHermiteSpline,
    )  # here, so that importing the package stays quick

    if len(times) == 1:
        return lambda time: np.array(np.broadcast_to(values[0], np.shape(time) + values.shape[1:]))
    path = CubicHermiteSpline(times, values, slopes)
    return lambda time: np.asarray(path(np.clip(time, times[0], times[-1])))


@dataclass(frozen=True, eq=False)
class Keyframes:
    """A rigid motion through keyframes. Nothing moves before the first and after the last one.

    It is smooth by default, without overshoot: monotone cubics [Fritsch & Carlson 1980]. A linear
    motion has an even speed between keyframes; from each on, its speed changes evenly for `ramp`
    seconds, which ends later by as much.

    Raises:
        ValueError: An argument breaks its rule.
    """

    times: ArrayLike
    """(K,) [s], ascending, from 0 on."""

    moves: ArrayLike
    """(K, 3): displacements since the start [m]."""

    turns: ArrayLike
    """(K, 3): rotations since the start, as rotation vectors [rad], whose components are
    interpolated.
    """

    about: ArrayLike = (0.0, 0.0, 0.0)
    """(3,): the point at the start that rotations are about [m]."""

    linear: bool = False

    ramp: float = 0.0
    """Of a linear motion [s], 0 or more."""

    _path: Callable[[ArrayLike], Floats] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times))
        shape = (len(np.asarray(self.times)), 3)
        for name, expected in (("moves", shape), ("turns", shape), ("about", (3,))):
            value = np.asarray(getattr(self, name), float)
            if value.shape != expected or not np.isfinite(value).all():
                raise ValueError(
                    f"{name}: must be finite, of shape {expected}, got {value.tolist()}"
                )
            object.__setattr__(self, name, value)
        values = np.concatenate([np.asarray(self.moves), np.asarray(self.turns)], axis=1)
        times = np.asarray(self.times)
        path = (
            _evenly(times, values, self.ramp)
            if self.linear
            else _through(times, values, _monotone(times, values))
        )
        object.__setattr__(self, "_path", path)

    @property
    def last(self) -> float:
        """When the motion ends [s]; 0 if nothing moves."""
        values = np.concatenate([np.asarray(self.moves), np.asarray(self.turns)], axis=1)
        return 0.0 if (values == values[0]).all() else float(np.asarray(self.times)[-1]) + self.ramp

    def pose(self, time: ArrayLike) -> Floats:
        """Return the motion x -> R x + b at a time [s], or at times (T,): ([T,] 3, 4) [m]."""
        found = self._path(time)
        R = rotation(found[..., 3:])
        about = np.asarray(self.about)
        return np.concatenate([R, (about + found[..., :3] - R @ about)[..., None]], axis=-1)


@dataclass(frozen=True, eq=False)
class Spin:
    """A rotation that begins at a time, gains its speed evenly, and keeps it."""

    axis: ArrayLike
    """(3,), of any length above 0."""

    speed: float
    """[rad/s]"""

    begin: float
    """[s]"""

    ramp: float
    """Time in which it gains its speed [s]."""

    about: ArrayLike
    """(3,): a point of the axis [m]."""

    @property
    def last(self) -> float:
        """When the motion ends [s]: never, unless nothing moves."""
        return float("inf") if self.speed else 0.0

    def pose(self, time: ArrayLike) -> Floats:
        """Return the motion x -> A x + b at a time [s], or at times (T,): ([T,] 3, 4) [m]."""
        t = np.maximum(np.asarray(time, float) - self.begin, 0.0)
        angle = self.speed * np.where(
            t < self.ramp, 0.5 * t * t / (self.ramp or 1.0), t - 0.5 * self.ramp
        )
        axis = np.asarray(self.axis, float)
        about = np.asarray(self.about, float)
        R = rotation(angle[..., None] * axis / np.linalg.norm(axis))
        return np.concatenate([R, (about - R @ about)[..., None]], axis=-1)


RigidMotion = Keyframes | Spin


def _evenly(times: Floats, values: Floats, ramp: float) -> Callable[[ArrayLike], Floats]:
    """Return v0 + sum over k of (s_k - s_(k-1)) r(t - t_k), s_k being the slope after t_k.

    r(u) = u^2/(2 ramp) up to the ramp, and u - ramp/2 from there on; 0 before 0.
    """
    slopes = np.diff(values, axis=0) / np.diff(times)[:, None]
    still = np.zeros((1, values.shape[1]))
    changes = np.diff(np.concatenate([still, slopes, still]), axis=0)

    def at(time: ArrayLike) -> Floats:
        u = np.clip(np.asarray(time, float)[..., None] - times, 0.0, None)
        reached = np.where(u < ramp, 0.5 * u * u / (ramp or 1.0), u - 0.5 * ramp)
        return np.asarray(values[0] + reached @ changes)

    return at


def _monotone(times: Floats, values: Floats) -> Floats:
    """Return the slopes of monotone cubics (K, n) at keyframes.

    They are 0 at both ends and where a value turns back.
    """
    from scipy.interpolate import PchipInterpolator

    slopes = np.zeros_like(values)
    if len(times) > 2:
        slopes[1:-1] = PchipInterpolator(times, values).derivative()(times[1:-1])
    return slopes


def rotation(turn: ArrayLike) -> Floats:
    """Return the matrices (..., 3, 3) of rotation vectors (..., 3) [rad].

    Right angles are exact.
    """
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(turn, float)
    found = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    whole = np.rint(found)
    oblique = (np.abs(found - whole) > RIGHT_ANGLE).any(axis=(-2, -1), keepdims=True)
    return np.where(oblique, found, whole + 0.0)


@dataclass(frozen=True, eq=False)
class MovingMesh:
    """Triangles that move smoothly through given frames.

    Slopes are those of parabolas through three frames.

    Before the first and after the last frame nothing moves.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: NDArray[np.int32]
    """(T, 3)"""

    times: ArrayLike
    """(F,) [s], ascending, from 0 on."""

    frames: ArrayLike
    """(F, N, 3): vertices [m]; of a skin, (F, B, 3, 4): motions of bones, x -> A x + b."""

    rest: ArrayLike | None = None
    """Of a skin (N, 3): vertices where bones do not move [m]."""

    weights: ArrayLike | None = None
    """Of a skin (N, B): how much each vertex follows each bone."""

    strength: float = 1.0
    """Factor of all displacements since the first frame."""

    _path: Callable[[ArrayLike], Floats] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times))
        path = np.asarray(self.frames, float)
        times = np.asarray(self.times)
        shape: tuple[Any, ...] = ("vertices", 3)
        if self.rest is not None:
            rest = np.asarray(self.rest, float)
            weights = np.asarray(self.weights, float)
            if (
                rest.ndim != 2
                or rest.shape[1] != 3
                or weights.ndim != 2
                or len(weights) != len(rest)
            ):
                raise ValueError(
                    "rest, weights: must be (N, 3) and (N, bones), "
                    f"got {rest.shape} and {weights.shape}"
                )
            if not (np.isfinite(rest).all() and np.isfinite(weights).all()):
                raise ValueError("rest, weights: must be finite")
            shape = (weights.shape[1], 3, 4)
        if (
            path.ndim != len(shape) + 1
            or path.shape[2:] != shape[1:]
            or not np.isfinite(path).all()
        ):
            raise ValueError(
                f"frames: must be finite, of shape {('frames', *shape)}, got {path.shape}"
            )
        if shape[0] not in ("vertices", path.shape[1]):
            raise ValueError(
                f"frames: must be of {shape[0]} bones, as weights are, got {path.shape[1]}"
            )
        if len(path) != len(times):
            raise ValueError(f"frames: must be {len(times)}, one for each instant, got {len(path)}")
        object.__setattr__(self, "triangles", np.asarray(self.triangles, dtype=np.int32))
        slopes = np.zeros_like(path)
        h = np.diff(times).reshape(-1, *[1] * (path.ndim - 1))
        rate = np.diff(path, axis=0) / h
        slopes[1:-1] = (h[1:] * rate[:-1] + h[:-1] * rate[1:]) / (h[1:] + h[:-1])
        object.__setattr__(self, "_path", _through(times, path, slopes))

    @property
    def last(self) -> float:
        """When the motion ends [s]; 0 if nothing moves."""
        return float(np.asarray(self.times)[-1]) if len(np.asarray(self.times)) > 1 else 0.0

    def at(self, time: float) -> Floats:
        """Return the vertices at a time [s]: (N, 3) [m]."""
        now = self._placed(time)
        if self.strength == 1.0:
            return now
        start = self._placed(0.0)
        return np.asarray(start + self.strength * (now - start))

    def _placed(self, time: float) -> Floats:
        """Return the vertices of the frames.

        A skin has the sum over bones of w (A x + b) [linear blend skinning].
        """
        path = self._path(time)
        if self.rest is None:
            return path
        x, y, z = np.asarray(self.rest, float).T[..., None]
        found = np.zeros((len(x), 3))
        for weight, bone in zip(np.asarray(self.weights, float).T, path, strict=True):
            found += weight[:, None] * (
                x * bone[:, 0] + y * bone[:, 1] + z * bone[:, 2] + bone[:, 3]
            )
        return found
