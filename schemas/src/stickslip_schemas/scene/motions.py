"""Rigid motions of a scene, as far as it must be known before a simulation whether they can work.

The paths are those of the simulation core: monotone cubics through keyframes [Fritsch & Carlson
1980], or straight lines with ramps.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SHORTEST_STEPS: Mapping[str, tuple[float, float]] = {
    "certified": (0.125 / 64, 2e-4),
    "fast": (0.125 / 16, 4e-4),
    "fine": (0.0625 / 64, 2e-5),
    "thesis-high": (0.0005, 2e-4),
    "thesis-low-small-dt": (0.0005, 2e-4),
    "thesis-low-big-dt": (0.001, 2e-4),
}
"""By preset: the shortest step that its step error asks for [s], and that error [m]."""

SAMPLES_PER_STEP = 2
"""Samples of a motion in a shortest step: its begin and its middle."""

SAMPLED_STEPS = 2
"""Steps before and after each key in which a motion is sampled: cubics bend most at their ends."""

DENSE_ROWS = 4
"""Rows of even instants, each shifted by a part of their distance, where keys are dense."""

INSTANTS_AT_ONCE = 20_000
"""Instants whose windows are sampled in one operation: bounds the memory to 30 MB."""


def rotation_matrix(turn: Floats) -> Floats:
    """Return the matrix (3, 3) of a rotation vector (3,) [rad] [Rodrigues]."""
    angle = float(np.linalg.norm(turn))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    # Radians have no exact right angles: entries near to whole numbers are meant to be whole.
    whole = np.rint(matrix)
    is_right = bool((np.abs(matrix - whole) < 1e-12).all())
    return whole + 0.0 if is_right else np.asarray(matrix)


def _rotation_matrices(turns: Floats) -> Floats:
    """Return the matrices (T, 3, 3) of rotation vectors (T, 3) [rad] [Rodrigues]."""
    angles = np.linalg.norm(turns, axis=1)
    x, y, z = (turns / np.maximum(angles, 1e-300)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    sines, cosines = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sines * cross + (1.0 - cosines) * (cross @ cross))


class Track:
    """A motion of a document: keyframes, a path or a spin."""

    def __init__(self, motion: Mapping[str, Any]) -> None:
        self._spin = motion["spin"]
        self._about = motion["about"]
        self._ramp = float(motion["ramp"])
        self._is_linear = motion["interpolation"] == "linear"
        if self._spin is not None:
            self.times = np.zeros(1)
            values = np.zeros((1, 6))
        elif motion["path"] is not None:
            path = motion["path"]
            self.times = np.asarray(path["time"], float)
            values = np.concatenate([path["move"], path["turn"]], axis=1)
        else:
            self.times = np.array([key["time"] for key in motion["keys"]], float)
            values = np.array([(*key["move"], *key["turn"]) for key in motion["keys"]], float)
        self.values = np.asarray(values, float)
        """(K, 6): displacements [m] and rotation vectors [rad] at the keys."""
        self._slopes = _monotone_slopes(self.times, self.values)

    def pose_at_start(self, middle: Floats) -> Floats:
        """Return the motion x -> A x + b at 0 s, (3, 4) [m]; `middle` is that of what moves."""
        # Nothing moves before the first key, so the first values hold at 0 s.
        about = middle if self._about is None else np.array(self._about, float)
        turn = rotation_matrix(self.values[0, 3:])
        shift = about + self.values[0, :3] - turn @ about
        return np.column_stack([turn, shift])

    def at(self, times: Floats) -> Floats:
        """Return displacements and rotation vectors at times (T,) [s]: (T, 6)."""
        if len(self.times) == 1:
            return np.repeat(self.values, len(times), axis=0)
        return self._on_lines(times) if self._is_linear else self._on_cubics(times)

    def _on_lines(self, times: Floats) -> Floats:
        # At key k the velocity changes by c_k, evenly for the ramp r. With s = t - t_k,
        #     x(t) = x_0 + sum_(s >= r) c_k (s - r / 2) + sum_(0 <= s < r) c_k s^2 / (2 r)
        # Sums of c_k, c_k t_k and c_k t_k^2 up to each key give it without a loop over the keys.
        slopes = np.diff(self.values, axis=0) / np.diff(self.times)[:, None]
        still = np.zeros((1, 6))
        # Large terms cancel, so the sums have more digits than the result.
        changes = np.diff(np.concatenate([still, slopes, still]), axis=0).astype(np.longdouble)
        instants = self.times[:, None].astype(np.longdouble)
        terms = np.concatenate([changes, changes * instants, changes * instants**2], axis=1)
        sums = np.concatenate([np.zeros((1, 18), np.longdouble), np.cumsum(terms, axis=0)])
        of_passed = sums[np.searchsorted(self.times, times - self._ramp, side="right")]
        of_ramping = sums[np.searchsorted(self.times, times, side="right")] - of_passed
        t = times[:, None].astype(np.longdouble)
        passed = (t - 0.5 * self._ramp) * of_passed[:, :6] - of_passed[:, 6:12]
        ramping = t * t * of_ramping[:, :6] - 2.0 * t * of_ramping[:, 6:12] + of_ramping[:, 12:]
        return np.asarray(self.values[0] + passed + ramping / (2.0 * (self._ramp or 1.0)), float)

    def _on_cubics(self, times: Floats) -> Floats:
        clipped = np.clip(times, self.times[0], self.times[-1])
        before = np.clip(
            np.searchsorted(self.times, clipped, side="right") - 1, 0, len(self.times) - 2
        )
        length = np.diff(self.times)[before][:, None]
        s = (clipped - self.times[before])[:, None] / length
        begin, end = self.values[before], self.values[before + 1]
        slope_begin, slope_end = self._slopes[before] * length, self._slopes[before + 1] * length
        # Hermite's cubic between two keys.
        return np.asarray(
            begin * (1.0 + 2.0 * s) * (1.0 - s) ** 2
            + slope_begin * s * (1.0 - s) ** 2
            + end * s * s * (3.0 - 2.0 * s)
            + slope_end * s * s * (s - 1.0)
        )

    def unevenness(self, step: float, radius: float, end: float) -> tuple[float, float]:
        """Return the time and size of the largest distance from an even motion within a step.

        Args:
            step: Length of the step [s].
            radius: Distance of what moves from the middle that it turns about [m].
            end: When the scene ends [s]; later steps do not count.

        Returns:
            The time at which it begins [s], and the distance [m].
        """
        if self._spin is not None:
            begin = float(self._spin["begin"])
            angle = abs(self._spin["speed"]) * step if begin < end else 0.0
            return begin, radius * float(_arc_height(np.array(angle)))
        size, begin = max(
            (self._largest_bend(windows, radius) for windows in self._windows(step, end)),
            default=(0.0, 0.0),
        )
        return begin, size

    def _windows(self, step: float, end: float) -> Iterator[Floats]:
        """Yield instants (W, N) [s], in rows of even distance, at which it may bend most."""
        half = step / SAMPLES_PER_STEP
        last = min(float(self.times[-1]) + self._ramp, end)
        first = max(float(self.times[0]) - step, 0.0)
        reach = SAMPLED_STEPS * SAMPLES_PER_STEP
        offsets = half * np.arange(-reach, reach + 1)
        # Cubics bend most at the keys, and turn fastest in the middle between two.
        instants = np.concatenate([self.times, 0.5 * (self.times[1:] + self.times[:-1])])
        instants = instants[instants < end]
        count = int((last + step - first) / half) + 1
        # Where keys are dense, their windows overlap, and even rows of all instants are shorter.
        if DENSE_ROWS * count < len(instants) * len(offsets):
            for row in range(DENSE_ROWS):
                even = first + half * (row / DENSE_ROWS + np.arange(count))
                yield np.asarray(even[None], float)
            return
        for begin in range(0, len(instants), INSTANTS_AT_ONCE):
            chosen = instants[begin : begin + INSTANTS_AT_ONCE, None]
            yield np.asarray(np.maximum(chosen + offsets, 0.0), float)

    def _largest_bend(self, windows: Floats, radius: float) -> tuple[float, float]:
        """Return the largest distance from an even motion in windows [m], and its time [s]."""
        samples = self.at(windows.ravel()).reshape(*windows.shape, 6)
        if windows.shape[1] < 3:
            return 0.0, 0.0
        # The second difference: how far the middle of a step is from that of its ends.
        bends = 0.5 * np.abs(samples[:, 2:] - 2.0 * samples[:, 1:-1] + samples[:, :-2])
        moved = np.linalg.norm(bends[..., :3], axis=-1)
        turned = np.minimum(np.linalg.norm(bends[..., 3:], axis=-1), 1.0)
        # What turns evenly leaves the straight line between the ends of a step all the same.
        angles = np.linalg.norm(samples[:, 2:, 3:] - samples[:, :-2, 3:], axis=-1)
        size = np.maximum(moved, np.maximum(turned, _arc_height(angles)) * radius)
        row, sample = np.unravel_index(int(np.argmax(size)), size.shape)
        return float(size[row, sample]), float(windows[row, sample])

    def moved(self, points: Floats, middle: Floats, times: Floats) -> Floats:
        """Return points (K, 3) [m] of the start where the motion has taken them: (T, K, 3) [m].

        `middle` is that of what moves, and `times` are (T,) [s]. A spin does not take them anywhere
        here.
        """
        about = middle if self._about is None else np.array(self._about, float)
        begin = self.at(np.zeros(1))[0]
        now = self.at(times)
        # A holder takes its vertices where they are, so the motion at 0 s is undone first.
        turns = _rotation_matrices(now[:, 3:]) @ rotation_matrix(begin[3:]).T
        moved = np.einsum("kj,tij->tki", points - about - begin[:3], turns)
        return np.asarray(moved + about + now[:, None, :3])

    @property
    def is_translation(self) -> bool:
        """False if it turns: where its parts are then depends on their shape."""
        return self._spin is None and not np.any(self.values[:, 3:])

    @property
    def moves(self) -> bool:
        """Whether a translation goes anywhere."""
        return bool(np.any(self.values[:, :3] != self.values[0, :3]))

    @property
    def end_times(self) -> Floats:
        """When it has reached the keys (K,) [s]."""
        return np.asarray(self.times + self._ramp)

    def displacements(self, times: Floats) -> Floats:
        """Return the displacements of a translation since 0 s, (T, 3) [m], at times (T,) [s]."""
        return np.asarray(self.at(times)[:, :3] - self.values[0, :3])


def _arc_height(angles: Floats) -> Floats:
    """Return the height of arcs of the unit circle over their chords: 1 - cos(angle / 2)."""
    return np.asarray(1.0 - np.cos(0.5 * np.minimum(angles, np.pi)))


def _monotone_slopes(times: Floats, values: Floats) -> Floats:
    """Return the slopes of monotone cubics (K, n) at the keys: 0 at both ends."""
    slopes = np.zeros_like(values)
    if len(times) < 3:
        return slopes
    lengths = np.diff(times)[:, None]
    rates = np.diff(values, axis=0) / lengths
    before, after = rates[:-1], rates[1:]
    weight_before = 2.0 * lengths[1:] + lengths[:-1]
    weight_after = lengths[1:] + 2.0 * lengths[:-1]
    # The weighted harmonic mean; 0 where a value turns back or rests.
    rises = before * after > 0.0
    safe_before = np.where(rises, before, 1.0)
    safe_after = np.where(rises, after, 1.0)
    weights = weight_before + weight_after
    means = weights / (weight_before / safe_before + weight_after / safe_after)
    slopes[1:-1] = np.where(rises, means, 0.0)
    return slopes
