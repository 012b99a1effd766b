"""The clips that a network sees: crops around the holders, and their true values.

They are rendered from simulations (`render_clips`), or read from a dataset (`read_clips`) or from a
file (`clips_of_file`).
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stickslip_schemas.base import sha256
from stickslip_schemas.kinds.cloth.spec import SEGMENTS
from stickslip_schemas.spec.cameras import Camera, load_rig

from stickslip_training.arrays import Array, Floats, Integers
from stickslip_training.cloth.crop import Cameras, cut, grey, holder_crops
from stickslip_training.cloth.evaluation import Truth
from stickslip_training.cloth.render import jitter_cameras, render_crops
from stickslip_training.cloth.runs import Runs, load_runs, runs_of_dataset
from stickslip_training.cloth.style import sample_style
from stickslip_training.cloth.surroundings import sample_surroundings
from stickslip_training.data.reader import DatasetReader, Split
from stickslip_training.engine.fit import seed_of_step

RIG = "drag"

VIEWPOINTS = ("calibrated", "left", "right")
"""Viewpoints of training. The family of turned ones is for tests."""

INSTANTS = (60, 80, 130, 150, 210, 220)
"""Of the frames that a network sees, of 300: two along each of the first three legs.

By then the cloth slides steadily: leave-one-out, a mesh between two neighbours in mu is 0.03 mm
from the simulation there. It is 18 mm off at instant 20, since the side of the drop still shows.
"""

RATE = 2.4
"""Instants a second [thesis, 4.2.3]."""

LATE_MAX = 0.06
"""Largest distance of a frame from its instant [s]. It moves mu by 0.005 in the mean and by up to
0.04 in 30 runs; a blend of the frames before and after is no better."""

CHUNK = 32
"""Clips that are rendered or estimated at once outside of training."""

TRAINING = 0
VALIDATION = 1
CHOICE = 2
"""Streams of random numbers."""

SPLITS: tuple[Split, ...] = ("train", "validation")

_READ_CHUNK = 8  # clips of full pictures in memory at once


@dataclass(frozen=True, eq=False, kw_only=True)
class Clips(Truth):
    """Crops of clips, and their true values."""

    crops: torch.Tensor
    """(clips, F, 72, 88)"""
    direction: torch.Tensor
    """(clips, 3): of view."""
    cover: torch.Tensor
    """(clips, F, 72, 88): fraction of each pixel that cloth covers; NaN if it is not known."""

    def __len__(self) -> int:
        return len(self.mu)

    def __getitem__(self, chosen: Integers | NDArray[np.bool_]) -> "Clips":
        parts: dict[str, Any] = {}
        for name, value in vars(self).items():
            # Tensors take no index of NumPy.
            is_tensor = torch.is_tensor(value)
            parts[name] = value[torch.from_numpy(np.asarray(chosen)) if is_tensor else chosen]
        return Clips(**parts)

    @staticmethod
    def joined(parts: "Sequence[Clips]") -> "Clips":
        """Return all clips of several parts."""
        whole: dict[str, Any] = {}
        for name, value in vars(parts[0]).items():
            values = [getattr(part, name) for part in parts]
            whole[name] = torch.cat(values) if torch.is_tensor(value) else np.concatenate(values)
        return Clips(**whole)


@dataclass(frozen=True, eq=False)
class RenderedClips:
    """Clips of another renderer, over dark floors, to train on besides rendered pictures.

    They are a fraction of each batch, with surroundings sampled about their cloth. `validation`
    chooses the weights and the temperature.
    """

    train: Clips
    validation: Clips

    def __post_init__(self) -> None:
        for name in ("train", "validation"):
            part: Clips = getattr(self, name)
            if not len(part) or (part.material < 0).any():
                raise ValueError(
                    f"the clips for {name} must be some, and of materials of the runs: "
                    f"{len(part)} clips"
                )
        if self.train.cover.isnan().any():
            raise ValueError(
                "the clips for train must have a segmentation: other floors are drawn "
                "under their cloth"
            )
        if shared := set(self.train.run.tolist()) & set(self.validation.run.tolist()):
            raise ValueError(
                "clips of one simulation must not be in both splits: simulations "
                f"{sorted(shared)[:5]}"
            )


def frames_at(instants: Sequence[float] | Floats) -> tuple[list[int], tuple[float, ...]]:
    """Return the frames nearest to the instants that a network reads, and their instants.

    Crops of a frame are cut at its own instant. Raises ValueError if one is more than `LATE_MAX`
    from any frame.
    """
    available = np.asarray(instants, dtype=np.float64)
    frames = [int(np.abs(available - instant).argmin()) for instant in INSTANTS]
    for frame, instant in zip(frames, INSTANTS, strict=True):
        if abs(available[frame] - instant) > LATE_MAX * RATE:
            raise ValueError(
                f"a clip must have a frame within {LATE_MAX:g} s of {instant / RATE:.2f} s "
                "after the start; its "
                f"nearest of {len(available)} is at {available[frame] / RATE:.2f} s"
            )
    return frames, tuple(available[frames].tolist())


def training_cameras() -> tuple[Camera, ...]:
    """Return the cameras of the viewpoints that a network is trained on."""
    return tuple(camera for camera in load_rig(RIG) if camera.name in VIEWPOINTS)


def render_clips(
    runs: Runs,
    renders: int,
    seed: int,
    *,
    spread: float = 0.0,
    with_surroundings: bool = False,
    device: str = "cpu",
) -> Clips:
    """Render every run `renders` times, each with a look of its own, by the cameras in turn.

    `spread` is the standard deviation of random rotations of the cameras [degree]. With
    `with_surroundings` each clip has surroundings of its own, and a dark floor without. `device`
    renders.
    """
    frames, instants = frames_at(runs.instants)
    number = np.repeat(np.arange(len(runs)), renders)
    crops: list[torch.Tensor] = []
    covers: list[torch.Tensor] = []
    directions: list[torch.Tensor] = []
    with torch.device(device):
        rig = Cameras.of(training_cameras())
        for start in range(0, len(number), CHUNK):
            chunk = number[start : start + CHUNK]
            generator = torch.Generator(device).manual_seed(seed_of_step(seed, VALIDATION, start))
            # The order of these draws is part of what a seed means.
            turns = torch.arange(start, start + len(chunk)) % len(rig.focal)
            cameras = jitter_cameras(rig[turns], spread, generator)
            style = sample_style(len(chunk), len(frames), generator)
            meshes = torch.from_numpy(runs.positions[chunk][:, frames]).to(device)
            surroundings = None
            if with_surroundings:
                surroundings = sample_surroundings(len(chunk), generator)
            picture, cover = render_crops(meshes, cameras, instants, style, generator, surroundings)
            crops.append(picture.cpu())
            covers.append(cover.cpu())
            directions.append(cameras.rotation[:, 2].cpu())
    rendered = runs[number]
    return Clips(
        crops=torch.cat(crops),
        direction=torch.cat(directions),
        material=rendered.material,
        mu=rendered.mu,
        run=number,
        cover=torch.cat(covers),
    )


def jittered(crops: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return crops (B, F, H, W) with a gamma, gain, offset and shift of each clip's own, and noise.

    They differ as other exposures and registrations would; values stay about 0 to 1.
    """

    def normal(deviation: float) -> torch.Tensor:
        return deviation * torch.randn(len(crops), 1, 1, 1, generator=generator)

    # The order of the calls is part of what a seed means: gamma, gain, offset, shift, noise.
    gamma = torch.exp(normal(0.25))
    gain = torch.exp(normal(0.15))
    exposed = crops.clamp(1e-3, 1.0) ** gamma * gain + normal(0.05)
    shifts = torch.randint(-1, 2, (len(crops), 2), generator=generator).tolist()
    moved = [torch.roll(clip, shift, (1, 2)) for clip, shift in zip(exposed, shifts, strict=True)]
    return torch.stack(moved) + 0.01 * torch.randn(crops.shape, generator=generator)


# --- reading
# --------------------------------------------------------------------------------------------------


def read_clips(
    reader: DatasetReader, split: Split | None, materials: tuple[str, ...]
) -> tuple[Clips, Integers]:
    """Return the crops of the clips of a split, and their slots.

    `materials` are known to the network.

    A clip of another material has the code -1. Raises ValueError if the dataset is of another
    kind, has no clip, or shows other instants than a network needs.
    """
    if reader.kind != "cloth_drag":  # crops follow the path of its holders
        raise ValueError(
            f"kind of the dataset must be cloth_drag to measure friction: it is {reader.kind}"
        )
    slots = reader.slots(split)
    if not len(slots):
        part = "dataset" if split is None else f"split {split} of the dataset"
        raise ValueError(f"the {part} has no valid clip")
    frames, instants = frames_at(tuple(reader.arrays["video"].attributes["instants"]))
    viewpoints = reader.categories("viewpoint")
    rig = {camera.name: camera for camera in reader.manifest.cameras}
    codes = reader.label("viewpoint")[slots].tolist()
    cameras = Cameras.of([rig[viewpoints[code]] for code in codes])
    crops, cover = _cropped(_pictures(reader, slots, frames), cameras, instants)
    clips = Clips(
        crops=crops,
        direction=cameras.rotation[:, 2],
        material=_codes(reader.categories("material"), materials)[reader.label("material")[slots]],
        mu=reader.label("mu")[slots].astype(np.float64),
        run=simulations(reader, slots),
        cover=cover,
    )
    return clips, slots


def _pictures(
    reader: DatasetReader, slots: Integers, frames: list[int]
) -> Iterator[tuple[Array, Array | None]]:
    """Yield videos (n, F, H, W, 3), and classes of pixels if the dataset has them."""
    has_classes = "segmentation" in reader.arrays
    for start in range(0, len(slots), _READ_CHUNK):
        chunk = slots[start : start + _READ_CHUNK]
        video = reader.read("video", chunk)[:, frames]
        classes = reader.read("segmentation", chunk)[:, frames] if has_classes else None
        yield video, classes


def _codes(names: Sequence[str], materials: Sequence[str]) -> Integers:
    """Return the place of each name in `materials`, and -1 for a name that is not there."""
    places = [materials.index(name) if name in materials else -1 for name in names]
    return np.array(places, dtype=np.int64)


def _cropped(
    pictures: Iterable[tuple[Array, Array | None]], cameras: Cameras, instants: tuple[float, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return crops and coverage of batches of pictures (n, F, H, W, 3).

    A batch may have the classes of its pixels, too. Coverage is NaN without them.
    """
    crops: list[torch.Tensor] = []
    covers: list[torch.Tensor] = []
    first = 0
    for video, classes in pictures:
        place = holder_crops(cameras[first : first + len(video)], instants)
        first += len(video)
        crops.append(cut(grey(torch.from_numpy(video)), place))
        if classes is None:
            covers.append(torch.full_like(crops[-1], math.nan))
        else:
            is_cloth = (classes == SEGMENTS.index("cloth")).astype(np.float32)
            covers.append(cut(torch.from_numpy(is_cloth), place))
    return torch.cat(crops), torch.cat(covers)


def clips_of_file(path: Path, materials: tuple[str, ...]) -> tuple[Clips, list[dict[str, Any]]]:
    """Return the crops of the clips of a file, and the true values of each.

    `benchmarks/training/blender_clips.py` writes such files.

    `Clips.run` is the number of the simulation in the packed file that the clips are of.
    """
    with np.load(path) as file:
        if not {"video", "segmentation", "instants", "about"} <= set(file.files):
            raise ValueError(
                f"{path} must be a file of clips with video, segmentation, instants and "
                f"about: it has {file.files}"
            )
        video = file["video"]
        classes = file["segmentation"]
        shown_instants = tuple(map(int, file["instants"]))
        about = [json.loads(str(line)) for line in file["about"]]
    frames, instants = frames_at(shown_instants)
    rig = {camera.name: camera for camera in load_rig(RIG)}
    cameras = Cameras.of([rig[clip["viewpoint"]] for clip in about])
    # One clip at a time: full pictures of all of them would fill the memory.
    pictures = (
        (video[clip : clip + 1, frames], classes[clip : clip + 1, frames])
        for clip in range(len(video))
    )
    crops, cover = _cropped(pictures, cameras, instants)
    clips = Clips(
        crops=crops,
        direction=cameras.rotation[:, 2],
        material=_codes([clip["material"] for clip in about], materials),
        mu=np.array([clip["mu"] for clip in about]),
        run=np.array([clip["run"] for clip in about]),
        cover=cover,
    )
    return clips, about


def training_runs(source: str, validation: str | None) -> tuple[dict[str, Any], Runs, Runs]:
    """Return the identity of simulations to train on and to validate, and both.

    They are two packed files (.npz), or splits of one dataset.
    """
    if source.endswith(".npz"):
        if validation is None:
            raise ValueError(
                "validation must be a packed file of simulations, as runs is one: it is not given"
            )
        train = load_runs(source)
        judged = load_runs(validation)
        named = {
            name: sha256(Path(of).read_bytes())
            for name, of in (("runs", source), ("validation", validation))
        }
        return named, train, judged.named(train.materials)
    if validation is not None:
        raise ValueError(
            "validation must not be given with a dataset, which has a split for it: it is "
            f"{validation}"
        )
    with DatasetReader(source) as reader:
        if missing := [split for split in SPLITS if not len(reader.slots(split))]:
            raise ValueError(
                "the splits train and validation must have simulations: "
                f"{', '.join(missing)} has none"
            )
        train, judged = (runs_of_dataset(reader, split, INSTANTS)[0] for split in SPLITS)
        return (
            {"manifest": reader.manifest_digest, "certificate": reader.manifest.certificate},
            train,
            judged,
        )


def training_clips(
    sources: list[str], train: Runs, validation: Runs
) -> tuple[list[str], RenderedClips]:
    """Return the identity of clips to train on and to validate, and both sets of clips.

    `sources` are one dataset, or files of clips, whose material and mu name their simulations.
    """
    if not all(source.endswith(".npz") for source in sources):
        if len(sources) > 1:
            raise ValueError(
                f"clips must be one dataset, or files (.npz), and are {', '.join(sources)}"
            )
        with DatasetReader(sources[0]) as reader:
            learned, judged = (read_clips(reader, split, train.materials)[0] for split in SPLITS)
            # Simulations have numbers by split.
            return [reader.manifest_digest], RenderedClips(
                learned, replace(judged, run=judged.run + len(learned))
            )
    runs = zip([*train.material, *validation.material], [*train.mu, *validation.mu], strict=True)
    numbers = {run: number for number, run in enumerate(runs)}
    clips = Clips.joined([clips_of_file(Path(source), train.materials)[0] for source in sources])
    places = [numbers.get(clip, -1) for clip in zip(clips.material, clips.mu, strict=True)]
    if unused := places.count(-1):
        raise ValueError(
            f"clips must show simulations to train on or to validate: {unused} of "
            f"{len(clips)} do not"
        )
    known = replace(clips, run=np.array(places))
    named = [sha256(Path(source).read_bytes()) for source in sources]
    return named, RenderedClips(known[known.run < len(train)], known[known.run >= len(train)])


def simulations(reader: DatasetReader, slots: Integers) -> Integers:
    """Return the number of the simulation of each slot.

    Clips of one fabric, mu and bias are of one simulation.
    """
    names = [
        name
        for name in ("material", "mu", "bias", "areal_density", "bending_rigidity")
        if name in reader.arrays
    ]
    columns: list[Array] = [
        reader.label(name)[slots].reshape(len(slots), -1).astype(np.float64) for name in names
    ]
    return (
        np.unique(np.concatenate(columns, axis=1), axis=0, return_inverse=True)[1]
        .reshape(-1)
        .astype(np.int64)
    )


def truth_of_slots(reader: DatasetReader, slots: Integers) -> Truth:
    """Return the true values of slots."""
    return Truth(
        material=reader.label("material")[slots].astype(np.int64),
        mu=reader.label("mu")[slots].astype(np.float64),
        run=simulations(reader, slots),
    )
