"""The clips of a dataset as a network sees them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stickslip_schemas.spec.cameras import load_rig

from stickslip_training.arrays import Array, Integers
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.fabric import fabric_numbers, numbers_of_runs
from stickslip_training.cloth.runs import landed_side
from stickslip_training.cloth.training import RIG, Clips, frames_at
from stickslip_training.data.reader import DatasetReader, Split

_CHUNK = 8  # clips in memory at once


def read_clips(reader: DatasetReader, split: Split | None, materials: tuple[str, ...]) -> tuple[Clips, Integers]:
    """Return the crops of the clips of a split, and their slots; `materials` are those that the network knows.

    A clip of another material has the code -1. Raises ValueError where the dataset is of another kind, has no clip, or
    shows other instants than a network needs.
    """
    check_kind(reader)
    slots = reader.slots(split)
    if not len(slots):
        raise ValueError(f"the dataset has no clip in the split {split}")
    frames, instants = frames_at(tuple(reader.arrays["video"].attributes["instants"]))
    names = reader.categories("viewpoint")
    cameras = {camera.name: camera for camera in reader.manifest.cameras}
    views = [cameras[names[code]] for code in reader.label("viewpoint")[slots].tolist()]
    seen = Cameras.of(views)
    crops = []
    for start in range(0, len(slots), _CHUNK):
        video = torch.from_numpy(reader.read("video", slots[start : start + _CHUNK])[:, frames])
        place = holder_crops(seen[start : start + _CHUNK], instants)
        crops.append(cut(grey(video), place))
    known = np.array([materials.index(name) if name in materials else -1 for name in reader.categories("material")])
    mu = reader.label("mu")[slots].astype(np.float64)
    material = known[reader.label("material")[slots]]
    fabric = fabric_numbers(*(reader.label(name)[slots] for name in ("areal_density", "bending_rigidity")))
    landed, runs = _landed(reader, slots), simulations(reader, slots)
    return Clips(torch.cat(crops), seen.rotation[:, 2], material, mu, landed, runs, fabric), slots


def clips_of_file(path: Path, materials: tuple[str, ...]) -> tuple[Clips, list[dict[str, Any]]]:
    """Return the crops of the clips that `benchmarks/training/blender_clips.py` wrote, and what is true of each.

    `Clips.run` is the number of the simulation in the packed file that the clips are of.
    """
    with np.load(path) as file:
        if not {"video", "instants", "about"} <= set(file.files):
            raise ValueError(f"{path} must be a file of clips with video, instants and about: it has {file.files}")
        video, shown = file["video"], tuple(map(int, file["instants"]))
        about = [json.loads(str(line)) for line in file["about"]]
    frames, instants = frames_at(shown)
    named = {camera.name: camera for camera in load_rig(RIG)}
    seen = Cameras.of([named[clip["viewpoint"]] for clip in about])
    crops = [
        cut(grey(torch.from_numpy(video[i : i + 1, frames])), holder_crops(seen[i : i + 1], instants))
        for i in range(len(video))
    ]
    known = [materials.index(clip["material"]) if clip["material"] in materials else -1 for clip in about]
    mu, landed, run = (np.array([clip[name] for clip in about]) for name in ("mu", "landed_side", "run"))
    fabric = numbers_of_runs(about)
    return Clips(torch.cat(crops), seen.rotation[:, 2], np.array(known), mu, landed, run, fabric), about


def check_kind(reader: DatasetReader) -> None:
    """Raise ValueError where the stage is not the one whose motion the crops know."""
    if reader.kind != "cloth_drag":
        raise ValueError(f"kind of the dataset must be cloth_drag to measure friction: it is {reader.kind}")


def simulations(reader: DatasetReader, slots: Integers) -> Integers:
    """Return a number for each slot that is the same for the clips of one simulation: one fabric, mu and bias."""
    names = [name for name in ("material", "mu", "bias", "areal_density", "bending_rigidity") if name in reader.arrays]
    told: list[Array] = [reader.label(name)[slots].reshape(len(slots), -1).astype(np.float64) for name in names]
    return np.unique(np.concatenate(told, axis=1), axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def truth_of_slots(reader: DatasetReader, slots: Integers) -> dict[int, tuple[int, float, int]]:
    """Return the code of the material, mu and the number of the simulation of slots, as `score_predictions` asks."""
    material, mu = (reader.label(name)[slots].tolist() for name in ("material", "mu"))
    groups = simulations(reader, slots).tolist()
    return {slot: (m, x, run) for slot, m, x, run in zip(slots.tolist(), material, mu, groups, strict=True)}


def _landed(reader: DatasetReader, slots: Integers) -> Integers:
    """Return the side to which each cloth fell; where no vertices are stored, the side to which it was pushed."""
    if "positions" not in reader.arrays:
        return reader.label("bias_side")[slots].astype(np.int64)
    rest = reader.read("rest", slots[:1])[0]
    return np.concatenate([landed_side(reader.read("positions", [slot]), rest) for slot in slots.tolist()])
