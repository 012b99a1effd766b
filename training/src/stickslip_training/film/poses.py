"""The camera of an unknown phone, and the poses of boards: both from the corners of markers.

A pose is the least-squares fit of a board's corners. The focal length f and the distortion k1 of
the lens are those that fit the boards of many frames best [Zhang 2000]; the principal point is the
middle of the frame, and pixels are square, as in all phones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from stickslip_training.arrays import Floats
from stickslip_training.film.boards import Sight

FOCAL_STARTS = (0.5, 0.8, 1.3, 2.2)
"""Focal lengths that a calibration starts from, over the longer side of a frame: from the wide
camera of a phone to its tele camera."""
DISTORTION_SD = 0.05
"""Standard deviation of k1 before a film says more: phones correct their films to about this."""
CORNER_SD = 0.2
"""Standard deviation of a coordinate of a corner that the weight of this prior is by [px]."""
OUTLIER = 1.0
"""Distance of a corner beyond which it counts less [px]: a hand may cover a part of it."""
NOISE_MIN = 0.05
"""Least standard deviation of a corner that is believed [px]."""


@dataclass(frozen=True)
class Lens:
    """A camera that a film was taken by."""

    width: int
    """[px]"""
    height: int
    """[px]"""
    focal: float
    """[px]"""
    focal_sd: float
    """Standard deviation of the focal length [px]."""
    k1: float = 0.0
    """OpenCV's first coefficient of radial distortion."""
    k1_sd: float = 0.0
    noise: float = NOISE_MIN
    """Standard deviation of a coordinate of a corner [px]."""

    @property
    def matrix(self) -> Floats:
        """Return the matrix of the pinhole camera, (3, 3)."""
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.array([[self.focal, 0, middle[0]], [0, self.focal, middle[1]], [0, 0, 1.0]])

    @property
    def distortion(self) -> Floats:
        """Return OpenCV's coefficients of the distortion, (5,)."""
        return np.array([self.k1, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Pose:
    """Where a board is: a point p of the board is at `rotation` p + `place` before the camera."""

    rotation: Floats
    """(3, 3)"""
    place: Floats
    """(3,) [m]"""
    residual: Floats
    """Seen less fitted corners, (N, 2) [px]."""

    def pixels(self, points: Floats, lens: Lens) -> Floats:
        """Return the pixels (N, 2) of points on the board (N, 2) or (N, 3) [m]."""
        import cv2

        solid = np.zeros((len(points), 3))
        solid[:, : points.shape[1]] = points
        turn = cv2.Rodrigues(self.rotation)[0]
        pixels = cv2.projectPoints(solid, turn, self.place, lens.matrix, lens.distortion)[0]
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def pose_of(sight: Sight, lens: Lens) -> Pose:
    """Return the pose of a board that fits its corners best.

    A flat board has two likely poses [Collins and Bartoli 2014]: both are refined, and the better
    fit is the answer.
    """
    import cv2

    solid = np.column_stack([sight.points, np.zeros(len(sight.points))])
    matrix, distortion = lens.matrix, lens.distortion
    _, turns, places, _ = cv2.solvePnPGeneric(
        solid, sight.pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    candidates = []
    for turn, place in zip(turns, places, strict=True):
        turn, place = cv2.solvePnPRefineLM(solid, sight.pixels, matrix, distortion, turn, place)
        fitted = cv2.projectPoints(solid, turn, place, matrix, distortion)[0].reshape(-1, 2)
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
        candidates.append(Pose(rotation, place.ravel(), sight.pixels - fitted))
    return min(candidates, key=lambda pose: float(np.square(pose.residual).sum()))


def calibrated(sights: Sequence[Sight], width: int, height: int) -> Lens:
    """Return the camera that fits boards of several frames best, with standard deviations.

    Each corner is a measurement with the noise that the residual shows.
    """
    longer = max(width, height)
    base = Lens(width, height, longer, 0.0)

    def residuals(x: Floats) -> Floats:
        lens = replace(base, focal=longer * float(np.exp(x[0])), k1=float(x[1]))
        errors = [pose_of(sight, lens).residual.ravel() for sight in sights]
        return np.concatenate([*errors, [CORNER_SD * x[1] / DISTORTION_SD]])

    starts = [np.array([np.log(share), 0.0]) for share in FOCAL_STARTS]
    best = min(starts, key=lambda x: float(np.square(residuals(x)).sum()))
    fit = least_squares(
        residuals, best, loss="soft_l1", f_scale=OUTLIER, diff_step=np.array([1e-4, 1e-4])
    )
    errors = np.abs(fit.fun[:-1])
    noise = max(NOISE_MIN, float(np.median(errors)) / 0.6745)
    slopes = np.asarray(fit.jac, dtype=np.float64)
    covariance = noise**2 * np.linalg.pinv(slopes.T @ slopes)
    focal = longer * float(np.exp(fit.x[0]))
    spread = np.sqrt(np.diag(covariance))
    return replace(
        base,
        focal=focal,
        focal_sd=focal * float(spread[0]),
        k1=float(fit.x[1]),
        k1_sd=float(spread[1]),
        noise=noise,
    )
