"""The tube: radius, orientation, closedness, twist."""

from collections import Counter

import numpy as np
import numpy.typing as npt
from stickslip_blender.scenes.rod_hang import (
    CAP_RINGS,
    SIDES,
    transport_frames,
    tube_faces,
    tube_vertices,
)


def test_every_vertex_of_a_ring_lies_a_radius_from_its_point(curl: npt.NDArray[np.float64]) -> None:
    vertices = tube_vertices(curl, 0.008)
    rings = vertices[: 150 * SIDES].reshape(150, SIDES, 3)
    np.testing.assert_allclose(np.linalg.norm(rings - curl[:, None], axis=2), 0.008, rtol=1e-12)
    end = vertices[150 * SIDES : -1]
    assert len(end) == CAP_RINGS * SIDES + 1
    np.testing.assert_allclose(np.linalg.norm(end - curl[-1], axis=1), 0.008, rtol=1e-12)


def test_frames_are_orthonormal_and_do_not_twist(curl: npt.NDArray[np.float64]) -> None:
    tangents = np.gradient(curl, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = transport_frames(tangents)
    frames = np.concatenate([tangents[:, None], normals], axis=1)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (150, 3, 3)), atol=1e-12
    )
    # No twist: the change of one normal has no component along the other, up to third order in the
    # step.
    twist = np.einsum(
        "ni,ni->n", normals[1:, 0] - normals[:-1, 0], 0.5 * (normals[1:, 1] + normals[:-1, 1])
    )
    assert np.abs(twist).max() < 1e-10


def test_a_straight_rod_has_frames_too() -> None:
    assert np.isfinite(tube_vertices(np.linspace((0, 0, 0), (0, 0, -1.0), 150), 0.008)).all()


def test_the_tube_is_closed_and_points_outwards(curl: npt.NDArray[np.float64]) -> None:
    vertices, faces = tube_vertices(curl, 0.008), tube_faces(150)
    edges = Counter(
        (face[i], face[(i + 1) % len(face)]) for face in faces for i in range(len(face))
    )
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    triangles = [(face[0], face[i], face[i + 1]) for face in faces for i in range(1, len(face) - 1)]
    a, b, c = vertices[np.array(triangles)].transpose(1, 0, 2)
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0
    assert volume > 0.97 * np.pi * 0.008**2  # positive where normals point outwards
    assert volume < 1.02 * np.pi * 0.008**2
