"""Training of the network that measures friction, on pictures that are rendered while it trains."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Unpack

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from stickslip_training.cloth.calibration import covering_temperature, likeliest_temperatures
from stickslip_training.cloth.clips import (
    CHOICE,
    TRAINING,
    VALIDATION,
    Clips,
    RenderedClips,
    frames_at,
    jittered,
    render_clips,
    training_cameras,
)
from stickslip_training.cloth.crop import Cameras, holder_crops
from stickslip_training.cloth.familiarity import Familiarity, pooled
from stickslip_training.cloth.model import (
    FrictionModel,
    PosteriorNet,
    log_histograms,
    mirrored,
    silhouettes,
)
from stickslip_training.cloth.posterior import MU_BINS, Posterior
from stickslip_training.cloth.render import expose, jitter_cameras, render_crops
from stickslip_training.cloth.runs import Runs, between
from stickslip_training.cloth.style import sample_style
from stickslip_training.cloth.surroundings import cloth_of_clip, sample_surroundings
from stickslip_training.engine.fit import (
    FitSettings,
    Fitted,
    Learner,
    RunOptions,
    check_positive,
    cosine_rate,
    fit,
    seed_of_step,
    seeded,
    torch_threads,
)

SILHOUETTES = 16
"""Of so many clips of a batch one teaches the silhouette of cloth: that is learned sooner than
friction, and costs more.
"""

SETTLED = 2 / 3
"""Share of the steps that teach what cloth is, while the reader sees true silhouettes; then it sees
found ones [1].
"""

FIRST = 8
"""Batches that standardize the units of a new network. 600 steps over dark floors learned mu to
0.08 with it, and to 0.14 without it."""

RECENT_BATCHES = 20
"""Batches of clips that a step chooses from: the newest."""


@dataclass(frozen=True, kw_only=True)
class ClothTraining(FitSettings):
    """Settings of a training.

    The same settings, runs, machine and threads give the same weights.
    """

    steps: int = 1500
    epoch: int = 250
    averaging: float = 0.99
    clip: float | None = 1.0
    threads: int = 1
    batch_size: int = 16
    learning_rate: float = 2e-3
    """Of AdamW at its highest; it falls to nothing like half a cosine."""
    repeats: int = 3
    """Steps for each batch of clips: drawing it, with silhouettes, costs five times as much as
    learning from it.
    """
    dropout: float = 0.2
    """Share of the joined features that a step leaves out [1]; with 0.1 a network learns few
    simulations by heart.
    """
    smoothing: tuple[float, float] = (0.2, 0.02)
    """Standard deviation of the target histogram of mu at the first and at the last step [1]: wide
    targets teach the order of mu first."""
    gap: float = 0.3
    """Neighbours in mu that are no farther apart have meshes between them: see `runs.between`."""
    turn: float = 4.0
    """Standard deviation of the turns of cameras, about the vertical and up [degree]."""
    clip_share: float = 0.5
    """Of a batch, if there are clips of another renderer. A long training needs 2,000: it
    learned 512 by heart.
    """
    worlds: bool = True
    """Sample what is around the cloth: see `surroundings`. Without it a network learns sooner, and
    knows dark floors only.
    """
    width: int = 96

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, "batch_size", "learning_rate", "repeats", "width")
        if self.width % 48:
            raise ValueError(f"width must be a multiple of 48, and is {self.width}")
        for name in ("dropout", "clip_share"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be from 0 to less than 1, and is {getattr(self, name)}"
                )
        if not all(0 < deviation < math.inf for deviation in self.smoothing):
            raise ValueError(
                f"smoothing must be two numbers above 0 and finite, and is {self.smoothing}"
            )
        for name in ("gap", "turn"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be 0 or more and finite, and is {getattr(self, name)}"
                )

    def going_on(self) -> "ClothTraining":
        """Return the settings for a network that goes on from a model, and knows the order of mu.

        Two simulations of one mu are read 0.06 apart: narrower targets teach simulations by heart.
        In fewer than 9,000 steps the average of weights spans the last ninth.
        """
        return replace(self, smoothing=(0.05, 0.05), averaging=0.999)


def train_friction(
    train: Runs,
    validation: Runs,
    settings: ClothTraining,
    *,
    clips: RenderedClips | None = None,
    start: FrictionModel | None = None,
    identity: dict[str, Any] | None = None,
    **run: Unpack[RunOptions],
) -> FrictionModel:
    """Train a network on runs, calibrate it on the runs for validation, and return the model.

    Args:
        train: Simulations to train on.
        validation: Simulations that choose the weights and the temperatures.
        settings: Settings of the training.
        clips: Clips of another renderer to train on, too.
        start: A model whose weights are the first. Its weights of silhouettes stay.
        identity: Names the runs and the clips. A run that is resumed must have the same.
        **run: Checkpoint, resume and reports, as `fit` has them.
    """
    if start is not None and clips is None:
        train, validation = (runs.named(start.materials) for runs in (train, validation))
    with torch_threads(settings.threads):
        learner = FrictionLearner(train, validation, settings, clips, start)
        # The same weights come of any number of threads and any device, or nearly so.
        machine = ("threads", "device")
        decisive = {name: value for name, value in asdict(settings).items() if name not in machine}
        identity = (identity or {}) | decisive
        return learner.calibrated(fit(learner, settings, identity=identity, **run))


class Batch(NamedTuple):
    """Clips to learn from."""

    crops: torch.Tensor
    """(B, F, 72, 88)"""
    direction: torch.Tensor
    """(B, 3): of view."""
    material: torch.Tensor
    """(B,): codes."""
    mu: torch.Tensor
    """(B,)"""
    silhouettes: torch.Tensor
    """(B, F, 18, 22), 0 to 1."""


class FrictionLearner(Learner):
    """Batches are runs, or meshes between two neighbours in mu, that are rendered anew.

    A step learns from clips of the last batches, half of them mirrored.
    """

    net: PosteriorNet

    def __init__(
        self,
        train: Runs,
        validation: Runs,
        settings: ClothTraining,
        clips: RenderedClips | None = None,
        start: FrictionModel | None = None,
    ) -> None:
        if len(train) == 0 or len(validation) == 0:
            raise ValueError(
                f"there must be runs to train on and to validate: {len(train)} and "
                f"{len(validation)}"
            )
        self.settings = settings
        self.frames, self.instants = frames_at(train.instants)
        self.train = train
        self.judged = validation
        self.clips = clips
        self._load(train)
        self.render = partial(
            render_clips, with_surroundings=settings.worlds, device=settings.device
        )
        if clips is None:
            self.validation = self.render(validation, 6, settings.seed, spread=settings.turn)
        else:
            self.validation = clips.validation
        self.centers = torch.from_numpy(MU_BINS.centers.astype(np.float32)).to(settings.device)
        self.batches: dict[int, Batch] = {}
        """The newest batches, by number."""
        self.settled = math.ceil(SETTLED * settings.steps / settings.repeats)
        """Batches that teach the silhouette of cloth."""
        with seeded(settings.seed):
            sizes = {
                "materials": len(train.materials),
                "bins": MU_BINS.count,
                "frames": len(self.frames),
            }
            self.net = PosteriorNet(**sizes, width=settings.width, dropout=settings.dropout)
        self._initialize(start)

    def _load(self, train: Runs) -> None:
        """Put the meshes on the device, and pair runs that have meshes between them."""
        device = self.settings.device
        frames = np.ascontiguousarray(train.positions[:, self.frames])
        self.meshes = torch.from_numpy(frames).to(device)
        with torch.device(device):
            self.rig = Cameras.of(training_cameras())
        # A run is also a pair with itself, so that it is drawn as it is.
        alone = [(run, run) for run in range(len(train))]
        self.pairs = np.array(between(train, self.settings.gap) + alone)
        # Wide pairs stand for more of the range of mu.
        widths = train.mu[self.pairs[:, 1]] - train.mu[self.pairs[:, 0]]
        self.chances = (widths + 0.02) / (widths + 0.02).sum()

    def _initialize(self, start: FrictionModel | None) -> None:
        """Set the first weights: standardized on the first batches, or a model's."""
        if start is None:
            first = [self.batch(number) for number in range(FIRST)]
            crops = torch.cat([batch.crops for batch in first])
            direction = torch.cat([batch.direction for batch in first])
            cover = torch.cat([batch.silhouettes for batch in first])
            self.net.to(self.settings.device).standardize(crops, direction, cover)
            return
        if start.materials != self.train.materials or start.net.sizes != self.net.sizes:
            raise ValueError(
                "the model to start from must know the runs' materials, and be "
                f"{self.net.sizes}: it knows "
                f"{', '.join(start.materials)}, and is {start.net.sizes}"
            )
        # It finds the silhouette of cloth, and keeps those weights.
        self.settled = 0
        self.net.load_state_dict(start.net.state_dict())

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(parameters, lr=self.settings.learning_rate, weight_decay=0.02)

    def learning_rate(self, step: int) -> float | None:
        return cosine_rate(self.settings.learning_rate, step, self.settings.steps, 100)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        assert isinstance(net, PosteriorNet)
        batch = self.sample(step)
        # The target is a histogram about the true mu, which gets narrower with the steps.
        first, last = self.settings.smoothing
        deviation = first * (last / first) ** (step / self.settings.steps)
        target = torch.exp(-0.5 * ((self.centers - batch.mu[:, None]) / deviation) ** 2)
        target = target / target.sum(dim=1, keepdim=True)

        # Cross entropy of the true material, and of mu given that material.
        features = net.features(batch.crops, batch.direction, batch.silhouettes)
        log_material, log_mu = net.read(features)
        rows = torch.arange(len(batch.mu), device=batch.mu.device)
        log_p = log_material[rows, batch.material]
        loss = -(log_p + (target * log_mu[rows, batch.material]).sum(dim=1)).mean()
        if step < self.settled * self.settings.repeats:
            logits = net.silhouettes(batch.crops[::SILHOUETTES])
            truth = batch.silhouettes[::SILHOUETTES]
            loss = loss + functional.binary_cross_entropy_with_logits(logits, truth)
        return torch.as_tensor(loss)

    def sample(self, step: int) -> Batch:
        """Return the batch of a step: clips of the last batches, half of them mirrored."""
        newest = step // self.settings.repeats
        last = range(max(0, newest - RECENT_BATCHES + 1), newest + 1)
        self.batches = {number: self.batches.get(number) or self.batch(number) for number in last}
        random = np.random.default_rng((self.settings.seed, CHOICE, step))
        count = self.settings.batch_size
        clips = random.integers(len(last) * count, size=count).tolist()
        batches = list(self.batches.values())
        # Clip i is number i % count of batch i // count.
        crops, direction, material, mu, silhouettes = (
            torch.stack([batches[clip // count][part][clip % count] for clip in clips])
            for part in range(len(Batch._fields))
        )
        is_mirrored = torch.from_numpy(random.random(count) < 0.5).to(self.settings.device)
        crops[is_mirrored], direction[is_mirrored] = mirrored(
            crops[is_mirrored], direction[is_mirrored]
        )
        silhouettes[is_mirrored] = silhouettes[is_mirrored].flip(3)
        return Batch(crops, direction, material, mu, silhouettes)

    def batch(self, number: int) -> Batch:
        """Return a batch of clips that are rendered anew.

        Silhouettes are the true ones before batch `settled`, and then as the network sees them.
        """
        seeds = (self.settings.seed, TRAINING, number)
        with torch.device(self.settings.device):
            random = np.random.default_rng(seeds)
            generator = torch.Generator(self.settings.device).manual_seed(seed_of_step(*seeds))
            blender_count = 0
            if self.clips is not None:
                blender_count = math.ceil(self.settings.clip_share * self.settings.batch_size)
            batch = self._rendered(self.settings.batch_size - blender_count, random, generator)
            if self.clips is not None and blender_count:
                clips = random.integers(len(self.clips.train), size=blender_count)
                blender_batch = self._composed(self.clips.train[clips], generator)
                both = zip(batch, blender_batch, strict=True)
                batch = Batch(*(torch.cat(parts) for parts in both))
            if number < self.settled:
                return batch._replace(silhouettes=pooled(batch.silhouettes))
            return batch._replace(silhouettes=self.net.seen_silhouettes(batch.crops))

    def _rendered(
        self, count: int, random: np.random.Generator, generator: torch.Generator
    ) -> Batch:
        """Render clips of meshes between neighbours in mu; silhouettes are coverage of pixels."""
        device = self.settings.device
        pairs = self.pairs[random.choice(len(self.pairs), size=count, p=self.chances)]
        fraction = random.random(count, dtype=np.float32)
        alpha = torch.from_numpy(fraction).to(device)[:, None, None, None, None]
        meshes = (1 - alpha) * self.meshes[pairs[:, 0]] + alpha * self.meshes[pairs[:, 1]]

        # The order of these draws is part of what a seed means.
        views = torch.from_numpy(random.integers(len(self.rig.focal), size=count))
        cameras = jitter_cameras(self.rig[views], self.settings.turn, generator)
        style = sample_style(count, len(self.frames), generator)
        surroundings = sample_surroundings(count, generator) if self.settings.worlds else None
        crops, cover = render_crops(meshes, cameras, self.instants, style, generator, surroundings)

        first = self.train.mu[pairs[:, 0]]
        second = self.train.mu[pairs[:, 1]]
        mu = ((1 - fraction) * first + fraction * second).astype(np.float32)
        return Batch(
            crops=crops,
            direction=cameras.rotation[:, 2],
            material=torch.from_numpy(self.train.material[pairs[:, 0]]).to(device),
            mu=torch.from_numpy(mu).to(device),
            silhouettes=cover,
        )

    def _composed(self, clips: Clips, generator: torch.Generator) -> Batch:
        """Return clips of another renderer, each in sampled surroundings."""
        device = self.settings.device
        direction = clips.direction.to(device)
        style = sample_style(len(clips), len(self.frames), generator)
        surroundings = sample_surroundings(len(clips), generator)
        cloth, surroundings, cover = cloth_of_clip(
            clips.crops.to(device), clips.cover.to(device), style, surroundings, generator
        )
        # The cameras of the clips are those of the rig, found by their direction of view.
        cameras = self.rig[torch.cdist(direction, self.rig.rotation[:, 2]).argmin(dim=1)]
        crops = expose(
            cloth,
            cameras,
            holder_crops(cameras, self.instants),
            self.instants,
            style,
            generator,
            surroundings,
        )
        return Batch(
            crops=crops,
            direction=direction,
            material=torch.from_numpy(clips.material).to(device),
            mu=torch.from_numpy(clips.mu).to(device).float(),
            silhouettes=cover,
        )

    def validate(self, net: nn.Module) -> float | None:
        assert isinstance(net, PosteriorNet)
        clips = self.validation
        log_p = log_histograms(net, self.validation)
        # Overconfidence does not count: temperatures correct it in the end.
        temperature = likeliest_temperatures(*log_p, clips.material, clips.mu, MU_BINS)
        posterior = Posterior.of(*log_p, self.train.materials, MU_BINS, temperature)
        return -float(posterior.log_likelihood(clips.material, clips.mu).mean())

    def calibrated(self, fitted: Fitted) -> FrictionModel:
        """Return the model of a trained network, calibrated on the clips for validation."""
        net = fitted.net.cpu()
        assert isinstance(net, PosteriorNet)
        settings = self.settings
        train = self.train
        clips = self.validation
        # Exposures and registrations differ as those of new clips may.
        generator = torch.Generator().manual_seed(seed_of_step(settings.seed, VALIDATION, 1))
        varied = replace(clips, crops=jittered(clips.crops, generator))
        good = Clips.joined([varied, self.render(self.judged, 6, settings.seed + 2)])
        log_p = log_histograms(net, good)
        # mu gets the temperature that covers. The likeliest one widens all for a few large errors.
        of_material, _ = likeliest_temperatures(*log_p, good.material, good.mu, MU_BINS)
        of_mu = covering_temperature(*log_p, good.mu, MU_BINS, of_material)
        good_silhouettes = silhouettes(net, Clips.joined([clips, varied]))
        familiarity = Familiarity.of(train, settings.seed + 1, good_silhouettes, settings.device)
        card = {
            "settings": asdict(settings),
            "training_runs": len(train),
            "validation_runs": len(self.judged),
            "training_clips": 0 if self.clips is None else len(self.clips.train),
            **fitted.facts(),
        }
        return FrictionModel(
            net=net,
            materials=train.materials,
            instants=self.instants,
            bins=MU_BINS,
            temperature=(of_material, of_mu),
            familiarity=familiarity,
            card=card,
        )
