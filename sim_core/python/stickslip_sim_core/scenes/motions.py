"""Prescribed motions: keyframes, spins, and the frames of an animated mesh."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rotations import matrices_of_vectors
from stickslip_sim_core.splines import hermite, monotone_slopes

RIGHT_ANGLE = 1e-12
"""Tolerance within which the entries of a rotation matrix are rounded to -1, 0 and 1.

A user who turns a body by a right angle cannot write it exactly in radians.
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

    It is constant before the first and after the last time.
    """
    # A spline needs two times. The copy keeps callers from writing into `values`.
    if len(times) == 1:
        return lambda time: np.array(np.broadcast_to(values[0], np.shape(time) + values.shape[1:]))
    return lambda time: hermite(times, values, slopes, np.clip(time, times[0], times[-1]))


@dataclass(frozen=True, eq=False)
class Keyframes:
    """A rigid motion through keyframes.

    Nothing moves before the first and after the last keyframe. By default the motion follows
    monotone cubics, which are smooth and do not overshoot [Fritsch & Carlson 1980]. A linear motion
    has an even speed between keyframes. From each keyframe on, its speed changes evenly for `ramp`
    seconds, so the motion ends later by `ramp`.

    Raises:
        ValueError: An argument breaks its rule.
    """

    times: ArrayLike
    """Times of the keyframes, ascending, from 0 on: (K,) [s]."""

    moves: ArrayLike
    """Displacements since the start: (K, 3) [m]."""

    turns: ArrayLike
    """Rotations since the start, as rotation vectors: (K, 3) [rad].

    Their components are interpolated.
    """

    about: ArrayLike = (0.0, 0.0, 0.0)
    """Centre of the rotations, as a point at the start: (3,) [m]."""

    linear: bool = False

    ramp: float = 0.0
    """Time of a change of speed in a linear motion [s], 0 or more."""

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
            # A frozen dataclass allows no plain assignment.
            object.__setattr__(self, name, value)
        # One path interpolates all six components.
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
        """Time at which the motion ends [s], or 0 if nothing moves."""
        values = np.concatenate([np.asarray(self.moves), np.asarray(self.turns)], axis=1)
        return 0.0 if (values == values[0]).all() else float(np.asarray(self.times)[-1]) + self.ramp

    def pose(self, time: ArrayLike) -> Floats:
        """Return the motion x -> R x + b at a time [s], or at times (T,): ([T,] 3, 4) [m]."""
        pose = self._path(time)
        R = rotation(pose[..., 3:])
        # R (x - about) + about + move, as a matrix and a shift.
        about = np.asarray(self.about)
        return np.concatenate([R, (about + pose[..., :3] - R @ about)[..., None]], axis=-1)


@dataclass(frozen=True, eq=False)
class Spin:
    """A rotation that begins at a time, gains its speed evenly, and keeps it."""

    axis: ArrayLike
    """Direction of the axis, of any length above 0: (3,)."""

    speed: float
    """Speed of the rotation [rad/s]."""

    begin: float
    """Time at which the rotation begins [s]."""

    ramp: float
    """Time in which the rotation gains its speed [s]."""

    about: ArrayLike
    """A point of the axis: (3,) [m]."""

    @property
    def last(self) -> float:
        """Time at which the motion ends [s]: inf, or 0 if nothing moves."""
        return float("inf") if self.speed else 0.0

    def pose(self, time: ArrayLike) -> Floats:
        """Return the motion x -> A x + b at a time [s], or at times (T,): ([T,] 3, 4) [m]."""
        t = np.maximum(np.asarray(time, float) - self.begin, 0.0)
        # `np.where` computes both cases, so a ramp of 0 must not divide by it.
        angle = self.speed * np.where(
            t < self.ramp, 0.5 * t * t / (self.ramp or 1.0), t - 0.5 * self.ramp
        )
        axis = np.asarray(self.axis, float)
        about = np.asarray(self.about, float)
        R = rotation(angle[..., None] * axis / np.linalg.norm(axis))
        return np.concatenate([R, (about - R @ about)[..., None]], axis=-1)


RigidMotion = Keyframes | Spin


def _evenly(times: Floats, values: Floats, ramp: float) -> Callable[[ArrayLike], Floats]:
    """Return v0 + sum over k of (s_k - s_(k-1)) r(t - t_k), with the slope s_k after t_k.

    r(u) is 0 before 0, u^2/(2 ramp) up to the ramp, and u - ramp/2 after it.
    """
    # The motion is at rest before the first keyframe and after the last.
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

    A slope is 0 at both ends, and at a keyframe from which a value turns back.
    """
    # With other slopes at the ends, the motion would start with a jump of speed.
    slopes = np.zeros_like(values)
    if len(times) > 2:
        slopes[1:-1] = monotone_slopes(times, values)
    return slopes


def rotation(turn: ArrayLike) -> Floats:
    """Return the matrices (..., 3, 3) of rotation vectors (..., 3) [rad].

    Right angles are exact.
    """
    vectors = np.asarray(turn, float)
    matrices = matrices_of_vectors(vectors.reshape(-1, 3)).reshape(*vectors.shape, 3)
    # A matrix with one oblique entry stays as it is: rounding a part of it would leave no rotation.
    # Adding 0.0 turns -0.0 into 0.0.
    whole = np.rint(matrices)
    oblique = (np.abs(matrices - whole) > RIGHT_ANGLE).any(axis=(-2, -1), keepdims=True)
    return np.where(oblique, matrices, whole + 0.0)


@dataclass(frozen=True, eq=False)
class MovingMesh:
    """Triangles that move smoothly through given frames.

    The slope at a frame is the slope of the parabola through this frame and its two neighbours.
    Nothing moves before the first and after the last frame.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: NDArray[np.int32]
    """Vertices of each triangle: (T, 3)."""

    times: ArrayLike
    """Times of the frames, ascending, from 0 on: (F,) [s]."""

    frames: ArrayLike
    """Vertices (F, N, 3) [m], or for a skin the motions x -> A x + b of bones (F, B, 3, 4)."""

    rest: ArrayLike | None = None
    """Vertices of a skin before any bone moves: (N, 3) [m]."""

    weights: ArrayLike | None = None
    """Weights of a skin, with which each vertex follows each bone: (N, B)."""

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
        # The slopes at both ends stay 0, so that the mesh begins and ends at rest.
        slopes = np.zeros_like(path)
        h = np.diff(times).reshape(-1, *[1] * (path.ndim - 1))
        rate = np.diff(path, axis=0) / h
        slopes[1:-1] = (h[1:] * rate[:-1] + h[:-1] * rate[1:]) / (h[1:] + h[:-1])
        object.__setattr__(self, "_path", _through(times, path, slopes))

    @property
    def last(self) -> float:
        """Time at which the motion ends [s], or 0 with a single frame."""
        return float(np.asarray(self.times)[-1]) if len(np.asarray(self.times)) > 1 else 0.0

    def at(self, time: float) -> Floats:
        """Return the vertices at a time [s]: (N, 3) [m]."""
        now = self._placed(time)
        # The sum below would change the given vertices by rounding.
        if self.strength == 1.0:
            return now
        start = self._placed(0.0)
        return np.asarray(start + self.strength * (now - start))

    def _placed(self, time: float) -> Floats:
        """Return the vertices at a time [s], without the factor `strength`.

        A vertex of a skin is the sum over bones of w (A x + b) [linear blend skinning].
        """
        path = self._path(time)
        if self.rest is None:
            return path
        # Bone by bone: all products at once would need memory for every vertex and bone.
        x, y, z = np.asarray(self.rest, float).T[..., None]
        vertices = np.zeros((len(x), 3))
        for weight, bone in zip(np.asarray(self.weights, float).T, path, strict=True):
            vertices += weight[:, None] * (
                x * bone[:, 0] + y * bone[:, 1] + z * bone[:, 2] + bone[:, 3]
            )
        return vertices
