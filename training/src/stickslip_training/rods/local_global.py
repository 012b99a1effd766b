"""Train the network that pools local and global features, with fresh noise on every rod at every step."""

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import nn

from stickslip_training.arrays import SingleFloats
from stickslip_training.engine.files import load_tensors, save_tensors
from stickslip_training.engine.fit import EpochReport, FitSettings, Learner, check_positive, cosine_rate, fit, seeded
from stickslip_training.rods.dataset import ReconstructionNoise
from stickslip_training.rods.nets import LocalGlobalNet, relative_loss

_RODS_FOR_COMPONENTS = 40_000  # at most: their principal components are known well enough
_WARM_UP = 200  # steps: the moments of AdamW know nothing at first


@dataclass(frozen=True, kw_only=True)
class LocalGlobalTraining:
    """How the network is trained. The same settings, rods, machine and threads give the same weights."""

    steps: int = 12_000
    batch_size: int = 256
    learning_rate: float = 1.5e-3
    """Of AdamW at its highest; it falls to nothing like half a cosine."""
    noise: tuple[float, float] = (2e-4, 1e-2)
    """Least and largest standard deviation of white noise [L]; each rod's is drawn between, on a logarithmic scale."""
    reconstructed: float = 0.2
    """Share of the rods that get the noise of a reconstruction instead, where one is given."""
    seed: int = 0
    width: int = 384
    blocks: int = 4
    local: int = 16
    """Channels of the local features."""
    threads: int = 1

    def __post_init__(self) -> None:
        check_positive(self, "steps", "batch_size", "learning_rate", "width", "blocks", "local", "threads")
        low, high = self.noise
        if not 0 < low <= high < 1:
            raise ValueError(f"noise must be two shares of L, 0 < low <= high < 1, and is {self.noise}")
        if not 0 <= self.reconstructed <= 1:
            raise ValueError(f"reconstructed must be from 0 to 1, and is {self.reconstructed}")


def train_local_global(
    centerline: SingleFloats,
    strains: SingleFloats,
    settings: LocalGlobalTraining,
    *,
    reconstruction: ReconstructionNoise | None = None,
    out: Path | None = None,
    resume: bool = False,
    on_epoch: Callable[[EpochReport], None] | None = None,
    every: int = 500,
) -> LocalGlobalNet:
    """Return the network trained on centrelines over L and strains times L, (rods, 150, 3) each.

    `on_epoch` hears of the mean loss of every `every` steps: see `relative_loss`. A checkpoint is kept below `out`,
    where one is given, and `resume` goes on from it.
    """
    if centerline.shape != strains.shape or len(centerline) == 0:
        raise ValueError(f"centerline and strains must be of the same rods: {centerline.shape}, {strains.shape}")
    fitted = fit(
        _LocalGlobalLearner(centerline, strains, settings, reconstruction),
        FitSettings(steps=settings.steps, epoch=every, seed=settings.seed, clip=1.0, threads=settings.threads),
        out=out,
        identity={name: value for name, value in asdict(settings).items() if name != "threads"},
        resume=resume,
        on_epoch=on_epoch,
    )
    return cast(LocalGlobalNet, fitted.net)


class _LocalGlobalLearner(Learner):
    """Rods drawn at random, each with noise of a strength of its own."""

    def __init__(
        self,
        centerline: SingleFloats,
        strains: SingleFloats,
        settings: LocalGlobalTraining,
        reconstruction: ReconstructionNoise | None,
    ) -> None:
        self.settings = settings
        self.reconstruction = reconstruction
        self.x, self.k = torch.from_numpy(centerline), torch.from_numpy(strains)
        with seeded(settings.seed):
            self.net = LocalGlobalNet(width=settings.width, blocks=settings.blocks, local=settings.local)
        some = slice(None, None, -(-len(self.x) // _RODS_FOR_COMPONENTS))
        self.net.standardise(self.x[some], self.k[some], noise=math.sqrt(settings.noise[0] * settings.noise[1]))

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(parameters, lr=self.settings.learning_rate, betas=(0.9, 0.99), weight_decay=1e-4)

    def learning_rate(self, step: int) -> float | None:
        return cosine_rate(self.settings.learning_rate, step, self.settings.steps, _WARM_UP)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        generator = np.random.default_rng((self.settings.seed, step))
        rows = torch.from_numpy(generator.integers(len(self.x), size=self.settings.batch_size))
        noise = torch.from_numpy(draw_noise(self.settings, generator, self.reconstruction))
        return relative_loss(net(self.x[rows] + noise), self.k[rows])


def draw_noise(
    settings: LocalGlobalTraining, generator: np.random.Generator, reconstruction: ReconstructionNoise | None
) -> SingleFloats:
    """Return the noise of a batch, (batch, 150, 3): the reconstruction's first, white noise after it."""
    count = settings.batch_size
    low, high = np.log(settings.noise)
    deviation = np.exp(generator.uniform(low, high, (count, 1, 1))).astype(np.float32)
    noise = deviation * generator.standard_normal((count, 150, 3), dtype=np.float32)
    if reconstruction is not None:
        drawn = round(settings.reconstructed * count)
        noise[:drawn] = reconstruction.draw(drawn, generator)
    return np.asarray(noise, dtype=np.float32)


def save_local_global(path: Path, net: LocalGlobalNet, settings: LocalGlobalTraining) -> None:
    """Write the network; `load_local_global` reads it."""
    save_tensors(path, {"sizes": net.sizes, "net": net.state_dict(), "settings": asdict(settings)})


def load_local_global(path: str | Path) -> LocalGlobalNet:
    """Return the network of a file, ready to estimate."""
    content = load_tensors(path)
    net = LocalGlobalNet(**content["sizes"])
    net.load_state_dict(content["net"])
    return net.eval()
