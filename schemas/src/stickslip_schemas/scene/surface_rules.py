"""Rules of the triangles of a mesh: corners, areas, and edges that neighbours share."""

import numpy as np

from stickslip_schemas.scene.document import MAX_VERTICES
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.gate import MAX_TRIANGLES
from stickslip_schemas.scene.polygons import Floats, Indices, repeated_numbers

FLATTEST = 1e-12
"""Least height of a triangle [m]."""


def check_corners(triangles: Indices) -> None:
    """Raise UnfitFileError if a triangle (T, 3) names a vertex twice."""
    names_twice = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    if names_twice.any():
        raise UnfitFileError(
            "a triangle must have three vertices, and triangle "
            f"{int(np.argmax(names_twice))} names one twice"
        )


def check_edges(triangles: Indices, vertices: int) -> None:
    """Raise UnfitFileError if triangles are not the surface of a manifold, turned alike.

    At most two triangles share an edge, and each runs along it in another direction.
    """
    if vertices > MAX_VERTICES or len(triangles) > MAX_TRIANGLES:
        raise UnfitFileError(
            f"must have at most {MAX_VERTICES} vertices and {MAX_TRIANGLES} triangles, and has "
            f"{vertices} and {len(triangles)}"
        )
    # One number for each row: sorting rows takes ten times as long.
    a, b, c = np.sort(triangles, axis=1).T
    numbers = (a * vertices + b) * vertices + c
    repeated = repeated_numbers(numbers)
    if len(repeated):
        raise UnfitFileError(
            f"each triangle must be there once, and {len(repeated)} repeat another one, such as "
            f"triangle {int(np.argmax(numbers == repeated[0]))}: delete them (in Blender: merge "
            "vertices by distance)"
        )
    edges = triangles * vertices + np.roll(triangles, -1, axis=1)
    repeated = np.unique(repeated_numbers(edges.ravel()))
    if len(repeated):
        raise UnfitFileError(
            "must be a manifold: at most two triangles share an edge, turned alike; "
            f"{len(repeated)} edges are not so: turn all faces to one side (in Blender: Mesh, "
            "Normals, Recalculate Outside), and delete faces inside"
        )


def check_areas(vertices: Floats, triangles: Indices) -> None:
    """Raise UnfitFileError if a triangle (T, 3) of vertices (N, 3) [m] has no area."""
    a = vertices[triangles[:, 0]]
    b = vertices[triangles[:, 1]]
    c = vertices[triangles[:, 2]]
    # The height over the first edge, |ab x ac| / |ab|, has a unit that a limit can have.
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    length = np.linalg.norm(b - a, axis=1)
    flat = doubled <= FLATTEST * np.maximum(length, np.finfo(float).tiny)
    if flat.any():
        raise UnfitFileError(
            f"all triangles must have areas above 0 m^2, and triangle {int(np.argmax(flat))} has "
            "none: delete such triangles (in Blender: Mesh, Clean Up, Degenerate Dissolve)"
        )
