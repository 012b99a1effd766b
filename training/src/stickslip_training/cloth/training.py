"""Train `PosteriorNet` on pictures of simulations that are rendered while it trains."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_schemas.store import write_durably
from torch import nn

from stickslip_training.arrays import Floats, Integers, SingleFloats
from stickslip_training.cloth.crop import Cameras
from stickslip_training.cloth.evaluation import Truth
from stickslip_training.cloth.fabric import FABRIC, Quantity
from stickslip_training.cloth.familiarity import Familiarity
from stickslip_training.cloth.nets import PosteriorNet
from stickslip_training.cloth.posterior import MU_BINS, SHARE, Bins, Posterior, estimates
from stickslip_training.cloth.render import Style, draw_style, render_crops, turned
from stickslip_training.cloth.runs import Runs, between
from stickslip_training.engine.fit import (
    EpochReport,
    FitSettings,
    Learner,
    check_device,
    check_positive,
    cosine_rate,
    fit,
    seed_of_step,
    seeded,
    torch_threads,
)
from stickslip_training.engine.ranks import Rank

RIG = "drag"

VIEWPOINTS = ("calibrated", "left", "right")
"""Those that a network is trained on; the family of turned ones is to test with."""

INSTANTS = (60, 80, 130, 150, 210, 220)
"""Of the frames that a network sees, of 300: two along each of the first three legs.

By then the cloth slides steadily: leave-one-out, a mesh between two neighbours in mu is 0.03 mm from the simulation
there, and 18 mm at instant 20, where the side of the drop still shows.
"""

_TRAINING, _VALIDATION = 0, 1  # streams of random numbers
_CHUNK = 32  # clips that are rendered or estimated at once outside of training


@dataclass(frozen=True, kw_only=True)
class ClothTraining:
    """How a network is trained. The same settings, runs, machine and threads give the same weights."""

    steps: int = 1500
    batch_size: int = 16
    learning_rate: float = 2e-3
    """Of AdamW at its highest; it falls to nothing like half a cosine."""
    averaging: float = 0.99
    """Decay of the running average over steps that is the model's weights."""
    smoothing: tuple[float, float] = (0.2, 0.02)
    """Standard deviation of mu about the truth in what the network is told, at the first and at the last step [1]: it
    learns an order first, and at the end bins."""
    gap: float = 0.3
    """Neighbours in mu that are no farther apart have meshes between them: see `runs.between`."""
    turn: float = 4.0
    """Standard deviation of the turns of cameras, about the vertical and up [degree]."""
    instants: tuple[int, ...] = INSTANTS
    """Of the frames that the network sees, of 300."""
    fabric: bool = False
    """Also learn the numbers of the fabric, `fabric.FABRIC`. There are no meshes between neighbours in mu then: two
    fabrics do not make a third."""
    seed: int = 0
    width: int = 96
    threads: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        check_positive(self, "steps", "batch_size", "learning_rate", "width", "threads")
        if not all(0 < deviation < math.inf for deviation in self.smoothing):
            raise ValueError(f"smoothing must be two numbers above 0 and finite, and is {self.smoothing}")
        for name in ("gap", "turn"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more and finite, and is {getattr(self, name)}")
        check_device(self.device)


@dataclass(frozen=True, eq=False)
class Clips:
    """Crops of clips, and what is true of them."""

    crops: torch.Tensor
    """(clips, F, 72, 88)"""
    direction: torch.Tensor
    """(clips, 3): of view."""
    material: Integers
    mu: Floats
    landed: Integers
    run: Integers
    """(clips,): number of the simulation, for errors that count simulations and not clips."""
    fabric: Floats
    """(clips, 3): log10 of `fabric.FABRIC`; NaN where they are not known."""

    def __len__(self) -> int:
        return len(self.mu)

    def __getitem__(self, chosen: Integers | NDArray[np.bool_]) -> "Clips":
        which = torch.from_numpy(np.asarray(chosen))
        return Clips(
            self.crops[which],
            self.direction[which],
            self.material[chosen],
            self.mu[chosen],
            self.landed[chosen],
            self.run[chosen],
            self.fabric[chosen],
        )

    @staticmethod
    def joined(parts: "Sequence[Clips]") -> "Clips":
        """Return the clips of all parts."""
        columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Clips)}
        whole: dict[str, Any] = {
            name: torch.cat(each) if torch.is_tensor(each[0]) else np.concatenate(each)
            for name, each in columns.items()
        }
        return Clips(**whole)

    def truth(self) -> Truth:
        """Return what is true of the clips, as scores ask for it."""
        return Truth(self.material, self.mu, self.landed, self.run)


@dataclass(frozen=True, eq=False)
class RenderedClips:
    """Clips of another renderer to train on besides the pictures that are rendered while training.

    Half of each batch is then of `train`; `validation` chooses the weights and the temperature.
    """

    train: Clips
    validation: Clips

    def __post_init__(self) -> None:
        for name in ("train", "validation"):
            part: Clips = getattr(self, name)
            if not len(part) or (part.material < 0).any():
                raise ValueError(f"the clips for {name} must be some, and of materials of the runs: {len(part)} clips")
        if shared := set(self.train.run.tolist()) & set(self.validation.run.tolist()):
            raise ValueError(f"clips of one simulation must not be in both splits: simulations {sorted(shared)[:5]}")


@dataclass(frozen=True, eq=False)
class FrictionModel:
    """A trained network, or several, with what its answers mean and how sure they may be."""

    nets: tuple[PosteriorNet, ...]
    materials: tuple[str, ...]
    instants: tuple[int, ...]
    bins: Bins
    temperature: tuple[float, float]
    """By which log p(m) and log p(mu | m) are divided: see `calibrated` and `covering`."""
    familiarity: tuple[Familiarity, ...]
    """Of each network: what it was trained on."""
    card: dict[str, Any]
    """Where the network comes from: runs, settings, measures, limits."""
    quantities: tuple[Quantity, ...] = ()
    """Numbers of the fabric that it tells, too."""
    quantity_temperatures: tuple[float, ...] = ()

    def estimate(self, clips: Clips) -> Posterior:
        """Return the posterior of every clip: the mean over the networks."""
        return self.look(clips)[0]

    def strangeness(self, clips: Clips) -> Floats:
        """Return how far every clip is from what was trained on, over the limit: more than 1 is unfamiliar."""
        return self.look(clips)[1]

    def look(self, clips: Clips) -> tuple[Posterior, Floats]:
        """Return the posterior of every clip, and its strangeness; each network sees the clips once."""
        seen = [features(net, clips) for net in self.nets]
        answers = [answer(net, own) for net, own in zip(self.nets, seen, strict=True)]
        posteriors = [_posterior(*each, self.materials, self.bins, self.temperature) for each in answers]
        far = [known.distance(own) / known.limit for known, own in zip(self.familiarity, seen, strict=True)]
        return Posterior.mean(posteriors), np.asarray(np.mean(far, axis=0))

    def fabric(self, clips: Clips) -> dict[str, Floats]:
        """Return the histogram of each quantity by name, (clips, bins): the mean over the networks."""
        told = [tell(net, features(net, clips)) for net in self.nets]
        return {
            quantity.name: np.mean([_softmax(own[place] / temperature) for own in told], axis=0)
            for place, (quantity, temperature) in enumerate(
                zip(self.quantities, self.quantity_temperatures, strict=True)
            )
        }


def train_friction(
    train: Runs,
    validation: Runs,
    settings: ClothTraining,
    *,
    clips: RenderedClips | None = None,
    start: FrictionModel | None = None,
    out: Path | None = None,
    identity: dict[str, Any] | None = None,
    resume: bool = False,
    on_epoch: Callable[[EpochReport], None] | None = None,
    epoch: int = 250,
) -> FrictionModel:
    """Train a network on runs, calibrate it on others, and return both as a model.

    `clips` are trained on, too; `start` is a model whose weights are the first. `identity` names the runs, and these,
    for a run that is resumed. Validation chooses the weights and the temperature.
    """
    if start is not None and clips is None:
        train, validation = (runs.named(start.materials) for runs in (train, validation))
    with torch_threads(settings.threads):
        learner = _FrictionLearner(train, validation, settings, clips, start)
        fitted = fit(
            learner,
            FitSettings(
                steps=settings.steps,
                epoch=epoch,
                seed=settings.seed,
                averaging=settings.averaging,
                clip=1.0,
                threads=settings.threads,
                device=settings.device,
            ),
            out=out,
            identity={
                **(identity or {}),
                **{k: v for k, v in asdict(settings).items() if k not in ("threads", "device")},
            },
            resume=resume,
            on_epoch=on_epoch,
        )
        net = fitted.net.cpu()
        assert isinstance(net, PosteriorNet)
        seen = learner.validation
        found = features(net, seen)
        temperature = calibrated(*answer(net, found), seen.material, seen.mu, MU_BINS)
        temperature = (temperature[0], covering(net, seen, temperature[0], train.materials, settings.seed))
        quantities = learner.quantities
        temperatures = calibrated_quantities(quantities, tell(net, found), seen.fabric)
        known = render_clips(train, 6, settings.seed + 1, spread=settings.turn, wanted=settings.instants)
        familiarity = Familiarity.of(features(net, known), known.material, found, len(train.materials))
    card = {
        "settings": asdict(settings),
        "training_runs": len(train),
        "validation_runs": len(validation),
        "training_clips": 0 if clips is None else len(clips.train),
        "steps": fitted.steps,
        "best_step": fitted.best_step,
        "seconds": round(fitted.seconds, 1),
        "history": [asdict(report) for report in fitted.history],
        "parameters": sum(parameter.numel() for parameter in net.parameters()),
    }
    instants = frames_at(train.instants, settings.instants)[1]
    return FrictionModel(
        (net,), train.materials, instants, MU_BINS, temperature, (familiarity,), card, quantities, temperatures
    )


WEIGHTS = Path(__file__).with_name("friction.safetensors")
"""A trained model that comes with the package; its card says of what, and how good it is."""


def save_friction(path: Path, model: FrictionModel) -> None:
    """Write the model as safetensors, with its card; `load_friction` reads it."""
    tensors = {f"nets.{i}.{name}": t for i, net in enumerate(model.nets) for name, t in net.state_dict().items()}
    for i, own in enumerate(model.familiarity):
        tensors[f"familiarity.{i}.means"] = torch.from_numpy(own.means)
        tensors[f"familiarity.{i}.precision"] = torch.from_numpy(own.precision)
    about = {
        "sizes": model.nets[0].sizes,
        "nets": len(model.nets),
        "materials": model.materials,
        "instants": model.instants,
        "bins": asdict(model.bins),
        "temperature": model.temperature,
        "limits": [own.limit for own in model.familiarity],
        "quantities": [quantity.name for quantity in model.quantities],
        "quantity_temperatures": model.quantity_temperatures,
        "card": model.card,
    }
    tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
    write_durably(path, safetensors.torch.save(tensors, {"friction": json.dumps(about)}))


def load_friction(path: str | Path = WEIGHTS) -> FrictionModel:
    """Return the model of a file; raise ValueError where it holds none."""
    try:
        with safetensors.safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["friction"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        nets, known = [], []
        quantities = tuple(quantity for quantity in FABRIC if quantity.name in about.get("quantities", ()))
        for i in range(about["nets"]):
            net = PosteriorNet(**about["sizes"], quantities=[quantity.bins.count for quantity in quantities])
            net.load_state_dict({name: tensors[f"nets.{i}.{name}"] for name in net.state_dict()})
            nets.append(net.eval())
            means, precision = (tensors[f"familiarity.{i}.{name}"].numpy() for name in ("means", "precision"))
            known.append(Familiarity(means, precision, about["limits"][i]))
    except (safetensors.SafetensorError, KeyError, RuntimeError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} must be a model of `stickslip-train cloth train`, and is none: {error}") from error
    first, second = about["temperature"]
    return FrictionModel(
        tuple(nets),
        tuple(about["materials"]),
        tuple(about["instants"]),
        Bins(**about["bins"]),
        (first, second),
        tuple(known),
        about["card"],
        quantities,
        tuple(about.get("quantity_temperatures", ())),
    )


# --- pictures -------------------------------------------------------------------------------------------------


def frames_at(
    instants: tuple[int, ...], wanted: tuple[int, ...] = INSTANTS, off: int = 2
) -> tuple[list[int], tuple[int, ...]]:
    """Return the frames that are nearest to the instants that a network sees, and their instants.

    Raises ValueError where one is more than `off` instants from any frame.
    """
    frames = [int(np.abs(np.asarray(instants) - instant).argmin()) for instant in wanted]
    for frame, instant in zip(frames, wanted, strict=True):
        if abs(instants[frame] - instant) > off:
            raise ValueError(
                f"a clip must show the instant {instant} of 300 to within {off}; its nearest is {instants[frame]}"
            )
    return frames, tuple(instants[frame] for frame in frames)


def training_cameras() -> tuple[Camera, ...]:
    """Return the cameras that a network is trained on."""
    return tuple(camera for camera in load_rig(RIG) if camera.name in VIEWPOINTS)


def render_clips(
    runs: Runs,
    renders: int,
    seed: int,
    *,
    cameras: tuple[Camera, ...] | None = None,
    turn: tuple[float, float] = (0.0, 0.0),
    spread: float = 0.0,
    style: Callable[[Style], Style] | None = None,
    wanted: tuple[int, ...] = INSTANTS,
) -> Clips:
    """Render every run `renders` times at the instants `wanted`, each with a look of its own, by the cameras in turn.

    `turn` turns all cameras (about the vertical, up) [degree]; `spread` adds random turns of this deviation; `style`
    changes the looks that were drawn.
    """
    frames, instants = frames_at(runs.instants, wanted)
    rig = training_cameras() if cameras is None else cameras
    number = np.repeat(np.arange(len(runs)), renders)
    crops, directions = [], []
    for start in range(0, len(number), _CHUNK):
        chosen = number[start : start + _CHUNK]
        generator = torch.Generator().manual_seed(seed_of_step(seed, _VALIDATION, start))
        views = [rig[(start + place) % len(rig)] for place in range(len(chosen))]
        seen = _turned(Cameras.of(views), turn, spread, generator)
        looks = draw_style(len(chosen), len(frames), generator)
        looks = looks if style is None else style(looks)
        meshes = torch.from_numpy(runs.positions[chosen][:, frames])
        crops.append(render_crops(meshes, seen, instants, looks, generator))
        directions.append(seen.rotation[:, 2])
    material, mu, landed = runs.material[number], runs.mu[number], runs.landed[number]
    return Clips(torch.cat(crops), torch.cat(directions), material, mu, landed, number, runs.fabric[number])


def jittered(crops: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return crops (B, F, H, W) with a gamma, gain, offset and shift of each clip's own, and noise.

    They differ as other exposures and registrations would; values stay about 0 to 1.
    """

    def drawn(deviation: float) -> torch.Tensor:
        return deviation * torch.randn(len(crops), 1, 1, 1, generator=generator)

    changed = crops.clamp(1e-3, 1.0) ** torch.exp(drawn(0.25)) * torch.exp(drawn(0.15)) + drawn(0.05)
    shifts = torch.randint(-1, 2, (len(crops), 2), generator=generator).tolist()
    moved = [torch.roll(clip, shift, (1, 2)) for clip, shift in zip(changed, shifts, strict=True)]
    return torch.stack(moved) + 0.01 * torch.randn(crops.shape, generator=generator)


def _turned(cameras: Cameras, turn: tuple[float, float], spread: float, generator: torch.Generator) -> Cameras:
    drawn = spread * torch.randn(2, len(cameras.focal), generator=generator)
    azimuth, elevation = (torch.deg2rad(angle + random) for angle, random in zip(turn, drawn, strict=True))
    return turned(cameras, azimuth, elevation)


class _FrictionLearner(Learner):
    """Every step draws runs, or meshes between two neighbours in mu, mirrors half of them, and renders them anew."""

    def __init__(
        self,
        train: Runs,
        validation: Runs,
        settings: ClothTraining,
        clips: RenderedClips | None = None,
        start: FrictionModel | None = None,
    ) -> None:
        if len(train) == 0 or len(validation) == 0:
            raise ValueError(f"there must be runs to train on and to validate: {len(train)} and {len(validation)}")
        self.settings = settings
        self.rank = Rank()
        self.frames, self.instants = frames_at(train.instants, settings.instants)
        self.train = train
        self.meshes = torch.from_numpy(np.ascontiguousarray(train.positions[:, self.frames]))
        self.quantities = FABRIC if settings.fabric else ()
        for runs in (train, validation) if settings.fabric else ():
            _check_fabric(runs)
        gap = 0.0 if settings.fabric else settings.gap
        self.pairs = np.array(between(train, gap) + [(run, run) for run in range(len(train))])
        widths = train.mu[self.pairs[:, 1]] - train.mu[self.pairs[:, 0]]
        self.chances = (widths + 0.02) / (widths + 0.02).sum()
        self.rig = training_cameras()
        self.clips = clips
        self.validation = (
            render_clips(validation, 6, settings.seed, spread=settings.turn, wanted=settings.instants)
            if clips is None
            else clips.validation
        )
        self.centers = torch.from_numpy(MU_BINS.centers.astype(np.float32))
        with seeded(settings.seed):
            self.net = PosteriorNet(
                materials=len(train.materials),
                bins=MU_BINS.count,
                frames=len(self.frames),
                width=settings.width,
                quantities=[quantity.bins.count for quantity in self.quantities],
            )
        if start is not None:
            if start.materials != train.materials or start.nets[0].sizes != self.net.sizes:
                raise ValueError(
                    f"the model to start from must know the runs' materials, and be {self.net.sizes}: it knows "
                    f"{', '.join(start.materials)}, and is {start.nets[0].sizes}"
                )
            own = self.net.state_dict()  # heads that the start lacks begin anew
            self.net.load_state_dict(own | {n: t for n, t in start.nets[0].state_dict().items() if n in own})

    def share(self, rank: Rank) -> None:
        if self.settings.batch_size % rank.count:
            raise ValueError(
                f"batch_size must be a multiple of the {rank.count} processes, and is {self.settings.batch_size}"
            )
        self.rank = rank

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(parameters, lr=self.settings.learning_rate, weight_decay=0.02)

    def learning_rate(self, step: int) -> float | None:
        return cosine_rate(self.settings.learning_rate, step, self.settings.steps, 100)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        assert isinstance(net, PosteriorNet)
        crops, direction, material, mu, fabric = self.batch(step)
        first, last = self.settings.smoothing
        deviation = first * (last / first) ** (step / self.settings.steps)
        target = _blurred(self.centers, mu, deviation)
        device = self.settings.device
        seen = net.features(crops.to(device), direction.to(device))
        log_material, log_mu = net.read(seen)
        rows = torch.arange(len(mu), device=device)
        given = log_mu[rows, material.to(device)]
        loss = -(log_material[rows, material.to(device)] + (target.to(device) * given).sum(dim=1)).mean()
        for place, (quantity, told) in enumerate(zip(self.quantities, net.read_quantities(seen), strict=True)):
            bins = quantity.bins
            wide = deviation * (bins.high - bins.low) / (MU_BINS.high - MU_BINS.low)
            centers = torch.from_numpy(bins.centers.astype(np.float32))
            loss = loss - (_blurred(centers, fabric[:, place], wide).to(device) * told).sum(dim=1).mean()
        return torch.as_tensor(loss)

    def batch(self, step: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the crops, directions of view, materials, mu and fabrics of this process's share of a step."""
        seeds = (self.settings.seed, _TRAINING, step, *self.rank.seeds)
        random = np.random.default_rng(seeds)
        generator = torch.Generator().manual_seed(seed_of_step(*seeds))
        count = self.settings.batch_size // self.rank.count
        chosen = self.pairs[random.choice(len(self.pairs), size=count, p=self.chances)]
        share = random.random(count, dtype=np.float32)
        near = torch.from_numpy(share)[:, None, None, None, None]
        meshes = (1 - near) * self.meshes[chosen[:, 0]] + near * self.meshes[chosen[:, 1]]
        mirrored = torch.from_numpy(random.random(count) < 0.5)
        meshes[mirrored] = meshes[mirrored].flip(3) * torch.tensor([1.0, -1.0, 1.0])
        views = [self.rig[place] for place in random.integers(len(self.rig), size=count)]
        cameras = _turned(Cameras.of(views), (0.0, 0.0), self.settings.turn, generator)
        looks = draw_style(count, len(self.frames), generator)
        crops = render_crops(meshes, cameras, self.instants, looks, generator)
        first, second = self.train.mu[chosen[:, 0]], self.train.mu[chosen[:, 1]]
        mu = torch.from_numpy(((1 - share) * first + share * second).astype(np.float32))
        near, far = (self.train.fabric[chosen[:, place]] for place in (0, 1))
        fabric = torch.from_numpy((near + share[:, None] * (far - near)).astype(np.float32))
        rendered = crops, cameras.rotation[:, 2], torch.from_numpy(self.train.material[chosen[:, 0]]), mu, fabric
        if self.clips is None:
            return rendered
        some = self.clips.train[random.integers(len(self.clips.train), size=count // 2)]
        told = (
            jittered(some.crops, generator),
            some.direction,
            torch.from_numpy(some.material),
            torch.from_numpy(some.mu.astype(np.float32)),
            torch.from_numpy(some.fabric.astype(np.float32)),
        )
        both = zip(rendered, told, strict=True)
        a, b, c, d, e = (torch.cat([own[: count - len(some)], given]) for own, given in both)
        return a, b, c, d, e

    def validate(self, net: nn.Module) -> float | None:
        assert isinstance(net, PosteriorNet)
        seen, found = self.validation, features(net, self.validation)
        answers = answer(net, found)
        # A network that is too sure is not worse for it: temperatures mend that in the end.
        temperature = calibrated(*answers, seen.material, seen.mu, MU_BINS)
        posterior = _posterior(*answers, self.train.materials, MU_BINS, temperature)
        loss = -float(posterior.log_likelihood(seen.material, seen.mu).mean())
        for place, (quantity, told) in enumerate(zip(self.quantities, tell(net, found), strict=True)):
            loss += _best_temperature(told, quantity.bins.place(seen.fabric[:, place]))[1]
        return loss


# --- answers --------------------------------------------------------------------------------------------------


def answer(net: PosteriorNet, seen: SingleFloats) -> tuple[SingleFloats, SingleFloats]:
    """Return log p(m), (clips, M), and log p(mu | m), (clips, M, K), of features, (clips, n)."""
    with torch.inference_mode():
        material, mu = net.read(torch.from_numpy(seen).to(next(net.parameters()).device))
    return material.cpu().numpy(), mu.cpu().numpy()


def tell(net: PosteriorNet, seen: SingleFloats) -> tuple[SingleFloats, ...]:
    """Return log p(q) of features, (clips, n): (clips, bins) for each quantity."""
    with torch.inference_mode():
        told = net.read_quantities(torch.from_numpy(seen).to(next(net.parameters()).device))
    return tuple(each.cpu().numpy() for each in told)


def features(net: PosteriorNet, clips: Clips) -> SingleFloats:
    """Return the last features of clips, (clips, n)."""
    device = next(net.parameters()).device
    net.eval()
    with torch.inference_mode():
        parts = [
            net.features(
                clips.crops[first : first + _CHUNK].to(device), clips.direction[first : first + _CHUNK].to(device)
            )
            for first in range(0, len(clips.crops), _CHUNK)
        ]
    return np.asarray(torch.cat(parts).cpu().numpy())


def _posterior(
    material: SingleFloats,
    mu: SingleFloats,
    names: tuple[str, ...],
    bins: Bins,
    temperature: tuple[float, float],
) -> Posterior:
    joint = _softmax(material / temperature[0])[..., None] * _softmax(mu / temperature[1])
    return Posterior(names, bins, joint)


def _softmax(logits: SingleFloats) -> Floats:
    shifted = np.exp((logits - logits.max(axis=-1, keepdims=True)).astype(np.float64))
    return np.asarray(shifted / shifted.sum(axis=-1, keepdims=True))


def covering(
    net: PosteriorNet, clips: Clips, of_material: float, materials: tuple[str, ...], seed: int, share: float = SHARE
) -> float:
    """Return the temperature of mu at which the intervals that should hold `share` hold that share of the truths.

    The most likely temperature is another one where a few clips are far off: it makes all intervals wider. The clips
    are seen with exposures and registrations that differ as those of new clips may.
    """
    generator = torch.Generator().manual_seed(seed_of_step(seed, _VALIDATION, 1))
    answers = answer(net, features(net, replace(clips, crops=jittered(clips.crops, generator))))
    tried = np.geomspace(0.4, 6.0, 55)

    def held(temperature: float) -> float:
        posterior = _posterior(*answers, materials, MU_BINS, (of_material, temperature))
        found = estimates(posterior.mu, MU_BINS, share)
        return float(((found.low <= clips.mu) & (clips.mu <= found.high)).mean())

    return float(tried[int(np.argmin([abs(held(each) - share) for each in tried]))])


def calibrated(
    material: SingleFloats, mu: SingleFloats, true_material: Integers, true_mu: Floats, bins: Bins
) -> tuple[float, float]:
    """Return the temperatures at which known answers are the most likely [Guo et al. 2017], of material and of mu."""
    rows = np.arange(len(true_mu))
    chances = material, true_material
    return _best_temperature(*chances)[0], _best_temperature(mu[rows, true_material], bins.place(true_mu))[0]


def calibrated_quantities(
    quantities: tuple[Quantity, ...], told: tuple[SingleFloats, ...], truth: Floats
) -> tuple[float, ...]:
    """Return the temperature of each quantity, at which log10 of the truth, (clips, 3), is the most likely."""
    places = [quantity.bins.place(truth[:, i]) for i, quantity in enumerate(quantities)]
    return tuple(_best_temperature(own, place)[0] for own, place in zip(told, places, strict=True))


def _best_temperature(logits: SingleFloats, place: Integers) -> tuple[float, float]:
    """Return the temperature at which the true bins `place` (clips,) are the most likely, and -log p there."""
    tried = np.geomspace(0.4, 4.0, 47)
    rows = np.arange(len(place))
    losses = [float(-np.log(_softmax(logits / t)[rows, place] + 1e-12).mean()) for t in tried]
    best = int(np.argmin(losses))
    return float(tried[best]), losses[best]


def _blurred(centers: torch.Tensor, truth: torch.Tensor, deviation: float) -> torch.Tensor:
    """Return histograms (B, bins) of this deviation about the truth, (B,)."""
    target = torch.exp(-0.5 * ((centers - truth[:, None]) / deviation) ** 2)
    return target / target.sum(dim=1, keepdim=True)


def _check_fabric(runs: Runs) -> None:
    for column, quantity in zip(runs.fabric.T, FABRIC, strict=True):
        low, high = quantity.bins.low, quantity.bins.high
        if not ((low <= column) & (column <= high)).all():
            raise ValueError(
                f"{quantity.name} of the runs must be known, from {10**low:.2g} to {10**high:.2g} {quantity.unit}: it "
                f"is from {10 ** column.min():.3g} to {10 ** column.max():.3g}"
            )
