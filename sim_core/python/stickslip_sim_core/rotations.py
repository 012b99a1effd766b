"""Rotations as matrices, unit quaternions (w, x, y, z) and rotation vectors.

They need NumPy only, so that the package does.
"""

import numpy as np

from stickslip_sim_core.arrays import Floats

SMALL = 1e-3
"""Angle below which sin(angle/2)/angle is a series with an error of 1e-22 [rad]."""


def quaternions_of_matrices(matrices: Floats) -> Floats:
    """Return the quaternions (n, 4) of rotations (n, 3, 3), by its largest part [Shepperd 1978]."""
    trace = np.trace(matrices, axis1=1, axis2=2)
    diagonal = np.diagonal(matrices, axis1=1, axis2=2)
    largest = np.argmax(np.column_stack([trace, diagonal]), axis=1)
    quaternions = np.empty((len(matrices), 4))
    for case in range(4):
        chosen = largest == case
        m = matrices[chosen]
        # The parts that are skew give w times the vector.
        skew = np.stack(
            [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1
        )
        if case == 0:
            quaternions[chosen] = np.column_stack([1.0 + trace[chosen], skew])
            continue
        i = case - 1
        part = m[:, i] + m[:, :, i]
        part[:, i] = 1.0 - trace[chosen] + 2.0 * m[:, i, i]
        quaternions[chosen] = np.column_stack([skew[:, i], part])
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))


def matrices_of_quaternions(quaternions: Floats) -> Floats:
    """Return the rotations (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = quaternions.T
    rows = [
        [x * x - y * y - z * z + w * w, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -x * x - y * y + z * z + w * w],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def matrices_of_vectors(vectors: Floats) -> Floats:
    """Return the rotations (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    angle = np.sqrt((vectors**2).sum(axis=1))
    series = 0.5 - angle**2 / 48.0 + angle**4 / 3840.0
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(angle <= SMALL, series, np.sin(0.5 * angle) / angle)
    return matrices_of_quaternions(np.column_stack([np.cos(0.5 * angle), scale[:, None] * vectors]))


def vectors_of_matrices(matrices: Floats) -> Floats:
    """Return the rotation vectors (n, 3) of rotations (n, 3, 3), up to half a turn [rad]."""
    return vectors_of_quaternions(quaternions_of_matrices(matrices))


def vectors_of_quaternions(quaternions: Floats) -> Floats:
    """Return the rotation vectors (n, 3) of unit quaternions (n, 4), up to half a turn [rad]."""
    # A quaternion and its negative are the same rotation, once the short and once the long way.
    w = np.abs(quaternions[:, 0])
    v = np.where(quaternions[:, :1] < 0.0, -1.0, 1.0) * quaternions[:, 1:]
    sine = np.sqrt((v**2).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(sine > 0.0, 2.0 * np.arctan2(sine, w) / sine, 2.0)
    return np.asarray(scale[:, None] * v)
