"""Animated meshes from other programs, for custom scenes.

`python -m stickslip_blender.import_mesh IN OUT.npz` reads what Blender reads: Alembic, USD, OBJ, PLY and STL. The NPZ
file has `positions` (frames, vertices, 3) [m], `triangles` (T, 3) and `times` (frames,) [s]. `stickslip simulate` takes
it as the file of a body.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_blender.cycles.blender import import_bpy

READERS: dict[str, tuple[str, dict[str, Any]]] = {
    ".abc": ("wm.alembic_import", {"as_background_job": False}),
    ".usd": ("wm.usd_import", {}),
    ".usda": ("wm.usd_import", {}),
    ".usdc": ("wm.usd_import", {}),
    ".usdz": ("wm.usd_import", {}),
    ".obj": ("wm.obj_import", {"forward_axis": "Y", "up_axis": "Z"}),
    ".ply": ("wm.ply_import", {}),
    ".stl": ("wm.stl_import", {}),
}
"""By suffix, the operator of Blender and how it is called."""

MAX_FRAMES = 10_000

Array = npt.NDArray[np.float64]


class ImportMeshError(ValueError):
    """A file that holds no mesh whose vertices move."""


def read(path: Path, *, frame_rate: int = 24, name: str | None = None, scale: float = 1.0) -> dict[str, Any]:
    """Read all meshes of a file, or the one of a name, as one, at all frames: what the NPZ file holds.

    Args:
        path: A file with one of the suffixes of `READERS`.
        frame_rate: Frames a second of the file.
        name: Of an object; None: all meshes.
        scale: Metres in a unit of the file, as Blender reads it.

    Raises:
        ImportMeshError: It holds no such mesh, or its triangles change.
    """
    if path.suffix.lower() not in READERS:
        raise ImportMeshError(f"{path}: must end in one of {', '.join(READERS)}")
    if not path.is_file():
        raise ImportMeshError(f"{path}: no such file")
    bpy = import_bpy()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = frame_rate, 1.0
    operator, settings = READERS[path.suffix.lower()]
    module, function = operator.split(".")
    getattr(getattr(bpy.ops, module), function)(filepath=str(path.resolve()), **settings)
    meshes = [thing for thing in scene.objects if thing.type == "MESH" and name in (None, thing.name)]
    if not meshes:
        there = ", ".join(thing.name for thing in scene.objects if thing.type == "MESH") or "none"
        raise ImportMeshError(
            f"{path}: must hold a mesh{f' named {name}' if name else ''}, and its meshes are: {there}"
        )
    first, last = (scene.frame_start, scene.frame_end) if _moves(meshes) else (scene.frame_start, scene.frame_start)
    if last - first >= MAX_FRAMES:
        raise ImportMeshError(f"{path}: must have at most {MAX_FRAMES} frames, and it has {last - first + 1}")
    frames, triangles = [], None
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        points, corners = _joined(meshes, bpy.context.evaluated_depsgraph_get())
        if triangles is not None and not (corners.shape == triangles.shape and (corners == triangles).all()):
            raise ImportMeshError(f"{path}: must keep its triangles, and they change at frame {frame}")
        triangles = corners
        frames.append(scale * points)
    return {
        "positions": np.stack(frames),
        "triangles": np.asarray(triangles),
        "times": np.arange(len(frames)) / frame_rate,
    }


def _moves(meshes: list[Any]) -> bool:
    """Say whether a mesh has a motion: a cache of Alembic or USD, keyframes, or an armature."""
    return any(
        thing.animation_data or thing.modifiers or thing.constraints or thing.parent or thing.data.shape_keys
        for thing in meshes
    )


def _joined(meshes: list[Any], graph: Any) -> tuple[Array, npt.NDArray[np.int32]]:
    """Return the vertices (N, 3) and triangles (T, 3) of all meshes at this frame, in the world."""
    points, corners, count = [], [], 0
    for thing in meshes:
        seen = thing.evaluated_get(graph)
        mesh = seen.to_mesh()
        mesh.calc_loop_triangles()
        own = np.empty(3 * len(mesh.vertices), dtype=np.float32)
        mesh.vertices.foreach_get("co", own)
        faces = np.empty(3 * len(mesh.loop_triangles), dtype=np.int32)
        mesh.loop_triangles.foreach_get("vertices", faces)
        seen.to_mesh_clear()
        matrix = np.array(seen.matrix_world, dtype=np.float64)
        points.append(own.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3])
        corners.append(faces.reshape(-1, 3) + count)
        count += len(points[-1])
    return np.concatenate(points), np.concatenate(corners)


def main(arguments: list[str] | None = None) -> int:
    """Convert a file; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m stickslip_blender.import_mesh", description=__doc__)
    parser.add_argument("file", type=Path, help=f"with one of {', '.join(READERS)}")
    parser.add_argument("out", type=Path, help="the NPZ file to write")
    parser.add_argument("--frame-rate", type=int, default=24, help="frames a second of the file (default: 24)")
    parser.add_argument("--object", help="name of the mesh (default: all meshes together)")
    parser.add_argument("--scale", type=float, default=1.0, help="metres in a unit of the file (default: 1)")
    options = parser.parse_args(arguments)
    try:
        found = read(options.file, frame_rate=options.frame_rate, name=options.object, scale=options.scale)
    except ImportMeshError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    np.savez_compressed(options.out, **found)
    frames, vertices, _ = found["positions"].shape
    sys.stdout.write(f"{options.out}: {frames} frames, {vertices} vertices, {len(found['triangles'])} triangles\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
