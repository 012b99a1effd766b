"""Training of the network that measures friction, on pictures that are rendered while it trains."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Unpack

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
"""Of so many clips of a batch one teaches what cloth is: that is learned sooner than friction, and
costs more.
"""

SETTLED = 2 / 3
"""Share of the steps that teach what cloth is, while the reader sees true silhouettes; then it sees
found ones [1].
"""

FIRST = 8
"""Batches that standardize the units of a new network. 600 steps over dark floors learned mu to
0.08 with it, and to 0.14 without it."""

KEPT = 20
"""Batches of clips that a step chooses from, the last ones."""


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
    """Of a batch, where there are clips of another renderer. A long training needs 2,000: it
    learned 512 by heart.
    """
    worlds: bool = True
    """Draw what stands about the cloth: see `world`. Without it a network learns sooner, and knows
    dark floors only.
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
        start: A model whose weights are the first. What cloth is, it knows: its silhouettes stay.
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
        self.meshes = torch.from_numpy(np.ascontiguousarray(train.positions[:, self.frames])).to(
            settings.device
        )
        self.pairs = np.array(
            between(train, settings.gap) + [(run, run) for run in range(len(train))]
        )
        widths = train.mu[self.pairs[:, 1]] - train.mu[self.pairs[:, 0]]
        self.chances = (widths + 0.02) / (widths + 0.02).sum()
        with torch.device(settings.device):
            self.rig = Cameras.of(training_cameras())
        self.clips = clips
        self.render = partial(
            render_clips, with_surroundings=settings.worlds, device=settings.device
        )
        self.validation = (
            self.render(validation, 6, settings.seed, spread=settings.turn)
            if clips is None
            else clips.validation
        )
        self.centers = torch.from_numpy(MU_BINS.centers.astype(np.float32)).to(settings.device)
        with seeded(settings.seed):
            sizes = {
                "materials": len(train.materials),
                "bins": MU_BINS.count,
                "frames": len(self.frames),
            }
            self.net = PosteriorNet(**sizes, width=settings.width, dropout=settings.dropout)
        self.drawn: dict[int, tuple[torch.Tensor, ...]] = {}
        self.settled = math.ceil(
            SETTLED * settings.steps / settings.repeats
        )  # batches that teach what cloth is
        if start is None:
            crops, direction, _, _, cover = map(
                torch.cat, zip(*map(self.batch, range(FIRST)), strict=True)
            )
            self.net.to(settings.device).standardize(crops, direction, cover)
        elif start.materials != train.materials or start.net.sizes != self.net.sizes:
            raise ValueError(
                "the model to start from must know the runs' materials, and be "
                f"{self.net.sizes}: it knows "
                f"{', '.join(start.materials)}, and is {start.net.sizes}"
            )
        else:
            self.settled = 0
            self.net.load_state_dict(start.net.state_dict())

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(parameters, lr=self.settings.learning_rate, weight_decay=0.02)

    def learning_rate(self, step: int) -> float | None:
        return cosine_rate(self.settings.learning_rate, step, self.settings.steps, 100)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        assert isinstance(net, PosteriorNet)
        crops, direction, material, mu, silhouettes = self.chosen(step)
        first, last = self.settings.smoothing
        deviation = first * (last / first) ** (step / self.settings.steps)
        target = torch.exp(-0.5 * ((self.centers - mu[:, None]) / deviation) ** 2)
        target = target / target.sum(dim=1, keepdim=True)
        log_material, log_mu = net.read(net.features(crops, direction, silhouettes))
        rows = torch.arange(len(mu), device=mu.device)
        loss = -(log_material[rows, material] + (target * log_mu[rows, material]).sum(dim=1)).mean()
        if step < self.settled * self.settings.repeats:
            found = net.silhouettes(crops[::SILHOUETTES])
            loss = loss + functional.binary_cross_entropy_with_logits(
                found, silhouettes[::SILHOUETTES]
            )
        return torch.as_tensor(loss)

    def chosen(self, step: int) -> tuple[torch.Tensor, ...]:
        """Return the batch of a step: clips of the last batches, half of them mirrored."""
        newest = step // self.settings.repeats
        last = range(max(0, newest - KEPT + 1), newest + 1)
        self.drawn = {number: self.drawn.get(number) or self.batch(number) for number in last}
        random = np.random.default_rng((self.settings.seed, CHOICE, step))
        count = self.settings.batch_size
        drawn = list(self.drawn.values())
        places = random.integers(len(last) * count, size=count).tolist()
        parts = zip(
            *([part[at % count] for part in drawn[at // count]] for at in places), strict=True
        )
        crops, direction, material, mu, silhouettes = map(torch.stack, parts)
        turned = torch.from_numpy(random.random(count) < 0.5).to(self.settings.device)
        crops[turned], direction[turned] = mirrored(crops[turned], direction[turned])
        silhouettes[turned] = silhouettes[turned].flip(3)
        return crops, direction, material, mu, silhouettes

    def batch(self, number: int) -> tuple[torch.Tensor, ...]:
        """Return crops, directions of view, materials, mu and silhouettes.

        Silhouettes are the true ones before batch `settled`.
        """
        device = self.settings.device
        seeds = (self.settings.seed, TRAINING, number)
        with torch.device(device):
            random = np.random.default_rng(seeds)
            generator = torch.Generator(device).manual_seed(seed_of_step(*seeds))
            some = (
                0
                if self.clips is None
                else math.ceil(self.settings.clip_share * self.settings.batch_size)
            )
            count = self.settings.batch_size - some
            chosen = self.pairs[random.choice(len(self.pairs), size=count, p=self.chances)]
            share = random.random(count, dtype=np.float32)
            near = torch.from_numpy(share).to(device)[:, None, None, None, None]
            meshes = (1 - near) * self.meshes[chosen[:, 0]] + near * self.meshes[chosen[:, 1]]
            views = torch.from_numpy(random.integers(len(self.rig.focal), size=count))
            cameras = jitter_cameras(self.rig[views], self.settings.turn, generator)
            looks = sample_style(count, len(self.frames), generator)
            world = sample_surroundings(count, generator) if self.settings.worlds else None
            crops, cover = render_crops(meshes, cameras, self.instants, looks, generator, world)
            first = self.train.mu[chosen[:, 0]]
            second = self.train.mu[chosen[:, 1]]
            mu = torch.from_numpy(((1 - share) * first + share * second).astype(np.float32)).to(
                device
            )
            codes = torch.from_numpy(self.train.material[chosen[:, 0]])
            parts = [crops, cameras.rotation[:, 2], codes.to(device), mu, cover]
            if self.clips is not None and some:
                given = self.elsewhere(
                    self.clips.train[random.integers(len(self.clips.train), size=some)], generator
                )
                parts = [torch.cat(both) for both in zip(parts, given, strict=True)]
            *parts, cover = parts
            return *parts, pooled(cover) if number < self.settled else self.net.seen_silhouettes(
                parts[0]
            )

    def elsewhere(self, clips: Clips, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
        """Return clips of another renderer as part of a batch, each in a drawn world."""
        device = self.settings.device
        shown, cover, direction = (
            part.to(device) for part in (clips.crops, clips.cover, clips.direction)
        )
        looks = sample_style(len(clips), len(self.frames), generator)
        world = sample_surroundings(len(clips), generator)
        cloth, world, cover = cloth_of_clip(shown, cover, looks, world, generator)
        cameras = self.rig[torch.cdist(direction, self.rig.rotation[:, 2]).argmin(dim=1)]
        crops = expose(
            cloth,
            cameras,
            holder_crops(cameras, self.instants),
            self.instants,
            looks,
            generator,
            world,
        )
        material, mu = (torch.from_numpy(part).to(device) for part in (clips.material, clips.mu))
        return crops, direction, material, mu.float(), cover

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
        of_material, _ = likeliest_temperatures(*log_p, good.material, good.mu, MU_BINS)
        of_mu = covering_temperature(*log_p, good.mu, MU_BINS, of_material)
        seen = silhouettes(net, Clips.joined([clips, varied]))
        known = Familiarity.of(train, settings.seed + 1, seen, settings.device)
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
            familiarity=known,
            card=card,
        )
