"""The tilt of the tray against the table, frame by frame.

A camera does not see gravity. The board on the level table shows it: the tilt is the angle between
the normals of both boards, whatever the hand does with the phone. It depends on no length, so
a sheet that is printed at another scale has the same tilt.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Array, Floats
from stickslip_training.film.boards import TABLE, TRAY, Sight
from stickslip_training.film.poses import Lens, Pose, pose_of

BEFORE = 0.5
AFTER = 0.2
"""Times before and after an instant in which the tilt is taken as a parabola [s]: the hand goes on
for a quarter of a second after the cloth slides."""
NEIGHBOURS = 4
"""Frames before and after a frame that it is compared with."""
JUMP = np.radians(5.0)
"""Largest tilt of a frame off the median of its neighbours [rad]: a hand turns a tray by less in
four frames, and the second pose that fits a flat board is off by more."""
FRAMES_MIN = 5
"""Fewest frames that a parabola is fitted to."""


@dataclass(frozen=True)
class Tilts:
    """The tilt over the time of a film."""

    times: Floats
    """Of the frames that show both boards, (N,) [s]."""
    angles: Floats
    """(N,) [rad]"""
    downhill: Floats
    """Direction of steepest descent on the tray's board, (N, 2); noise while the tray is level."""
    poses: Sequence[Pose]
    """Of the tray's board, N of them."""


@dataclass(frozen=True)
class TiltAt:
    """The tilt at an instant."""

    angle: float
    """[rad]"""
    rate: float
    """[rad/s]"""
    noise: float
    """Standard deviation of the angle, by the scatter of frames about their parabola [rad]."""


def tilts_of(times: Floats, sights: Sequence[dict[str, Sight]], lens: Lens) -> Tilts:
    """Return the tilt in frames that show both boards, without those where it jumps."""
    angles = []
    downhill = []
    poses = []
    for boards in sights:
        table = pose_of(boards[TABLE.name], lens)
        tray = pose_of(boards[TRAY.name], lens)
        upward = tray.rotation.T @ table.rotation[:, 2]
        # The sine is exact where the cosine is flat, near the level.
        level = float(np.hypot(upward[0], upward[1]))
        angles.append(float(np.arctan2(level, upward[2])))
        downhill.append(-upward[:2] / max(level, 1e-9))
        poses.append(tray)
    used = np.flatnonzero(~jumps(np.array(angles)))
    return Tilts(
        times[used], np.array(angles)[used], np.array(downhill)[used], [poses[k] for k in used]
    )


def jumps(angles: Floats) -> Array:
    """Return which angles (N,) [rad] are far off the median of their neighbours, (N,)."""
    padded = np.pad(angles, NEIGHBOURS, mode="reflect" if len(angles) > NEIGHBOURS else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    return np.asarray(np.abs(angles - np.median(windows, axis=1)) > JUMP)


def tilt_at(tilts: Tilts, time: float) -> TiltAt:
    """Return the tilt at an instant, from the frames around it.

    Raises:
        ValueError: Too few frames near the instant show both boards.
    """
    near = (tilts.times > time - BEFORE) & (tilts.times < time + AFTER)
    count = int(near.sum())
    if count < FRAMES_MIN:
        raise ValueError(
            f"boards: both must be in sight in {FRAMES_MIN} frames or more near {time:.2f} s, when "
            f"the cloth begins to slide, and are in {count}; keep hands and shadows off the boards"
        )
    powers = np.vander(tilts.times[near] - time, 3, increasing=True)
    fit, *_ = np.linalg.lstsq(powers, tilts.angles[near], rcond=None)
    scatter = tilts.angles[near] - powers @ fit
    variance = float(scatter @ scatter) / (count - 3)
    covariance = variance * np.linalg.inv(powers.T @ powers)
    return TiltAt(float(fit[0]), float(fit[1]), float(np.sqrt(covariance[0, 0])))
