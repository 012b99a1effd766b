"""Trajectories of cloth for programs that render or animate: USD, one file a sample, or OBJ, one file an instant.

Both have the mesh in metres, z up, with the flat cloth as texture coordinates from 0 to 1. USD has all instants of a
sample as time samples, with its labels beside them; numbers are those of the dataset, bit by bit. OBJ is text, and its
numbers, read as 32-bit floats, are the same bits, too.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_training.arrays import Array
from stickslip_training.export.content import Content, OnBytes

NEEDED = ("positions", "rest", "triangles")


def write_usd(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `SLOT.usdc` for each sample: a mesh `/cloth` whose points move."""
    from pxr import Sdf, Usd, UsdGeom, Vt

    rate = _instants_per_second(content)
    for slot, positions, uv, triangles, labels in _samples(content):
        stage = Usd.Stage.CreateNew(str(directory / f"{slot:08d}.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(len(positions) - 1))
        mesh = UsdGeom.Mesh.Define(stage, "/cloth")
        stage.SetDefaultPrim(mesh.GetPrim())
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles).reshape(-1)))
        coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv)))
        points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
        for instant, vertices in enumerate(positions):
            box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
            points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices)), float(instant))
            extent.Set(Vt.Vec3fArray.FromNumpy(box), float(instant))
        stage.GetRootLayer().customLayerData = {"stickslip": json.dumps(labels)}
        stage.Save()
        on_bytes(content.sample_bytes)


def write_obj(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write `SLOT/0000.obj` and so on, one for each instant, and `SLOT/labels.json`."""
    _instants_per_second(content)
    for slot, positions, uv, triangles, labels in _samples(content):
        folder = directory / f"{slot:08d}"
        folder.mkdir()
        (folder / "labels.json").write_text(json.dumps(labels, indent=2) + "\n")
        coordinates = "".join(f"vt {u:.9g} {v:.9g}\n" for u, v in uv.tolist())
        faces = "".join("f " + " ".join(f"{i}/{i}" for i in corners) + "\n" for corners in (triangles + 1).tolist())
        for instant, vertices in enumerate(positions.tolist()):
            moved = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)
            (folder / f"{instant:04d}.obj").write_text(f"o cloth\n{moved}{coordinates}{faces}")
        on_bytes(content.sample_bytes)


def _instants_per_second(content: Content) -> float:
    """Return the instants per second of the meshes; raise ValueError where this part of the dataset has none."""
    arrays = {array.name: array for array in content.arrays}
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise ValueError(
            f"a mesh needs the arrays {', '.join(NEEDED)}, and {', '.join(missing)} are not in this part of "
            f"{content.name}"
        )
    return float(arrays["positions"].attributes["instants_per_second"])


def _samples(content: Content) -> Any:
    """Yield of each sample its slot, positions (T, V, 3), texture coordinates (V, 2), triangles and labels."""
    for slot in content.slots:
        alone: npt.NDArray[np.int64] = np.array([slot])
        positions, rest, triangles = (content.read(name, alone)[0] for name in NEEDED)
        labels = {array.name: content.read(array.name, alone)[0].tolist() for array in content.labels}
        yield int(slot), positions, _coordinates(rest), triangles, labels


def _coordinates(rest: Array) -> Array:
    """Return the flat cloth (V, 2) [m] as texture coordinates, from 0 to 1 along both axes."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    scaled: Array = ((rest - low) / (high - low)).astype(np.float32)
    return scaled
