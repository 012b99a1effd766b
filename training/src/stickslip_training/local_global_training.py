"""Train the network that pools local and global features, with fresh noise on every rod at every step."""

import io
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from stickslip_schemas.store import write_durably

from stickslip_training.local_global_net import LocalGlobalNet, relative_loss
from stickslip_training.noise import Floats, ReconstructionNoise


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
        for name in ("steps", "batch_size", "learning_rate", "width", "blocks", "local", "threads"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be more than 0 and finite, and is {value}")
        low, high = self.noise
        if not 0 < low <= high < 1:
            raise ValueError(f"noise must be two shares of L, 0 < low <= high < 1, and is {self.noise}")
        if not 0 <= self.reconstructed <= 1:
            raise ValueError(f"reconstructed must be from 0 to 1, and is {self.reconstructed}")


@dataclass(frozen=True)
class StepReport:
    """How far a run is."""

    step: int
    seconds: float
    """CPU time of the process since it began."""
    loss: float
    """Mean since the last report: see `relative_loss`."""


def train_local_global(
    centerline: Floats,
    strains: Floats,
    settings: LocalGlobalTraining,
    *,
    reconstruction: ReconstructionNoise | None = None,
    on_step: Callable[[StepReport], None] | None = None,
    every: int = 500,
) -> LocalGlobalNet:
    """Return the network trained on centrelines over L and strains times L, (rods, 150, 3) each."""
    if centerline.shape != strains.shape or len(centerline) == 0:
        raise ValueError(f"centerline and strains must be of the same rods: {centerline.shape}, {strains.shape}")
    threads = torch.get_num_threads()
    torch.set_num_threads(settings.threads)
    try:
        return _train(centerline, strains, settings, reconstruction, on_step, every)
    finally:
        torch.set_num_threads(threads)


def _train(
    centerline: Floats,
    strains: Floats,
    settings: LocalGlobalTraining,
    reconstruction: ReconstructionNoise | None,
    on_step: Callable[[StepReport], None] | None,
    every: int,
) -> LocalGlobalNet:
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        net = LocalGlobalNet(width=settings.width, blocks=settings.blocks, local=settings.local)
    x, k = torch.from_numpy(centerline), torch.from_numpy(strains)
    some = slice(None, None, -(-len(x) // _RODS_FOR_COMPONENTS))
    net.standardise(x[some], k[some], noise=math.sqrt(settings.noise[0] * settings.noise[1]))
    optimizer = torch.optim.AdamW(net.parameters(), lr=settings.learning_rate, betas=(0.9, 0.99), weight_decay=1e-4)
    generator = np.random.default_rng(settings.seed)
    started = time.process_time()
    losses: list[float] = []
    net.train()
    for step in range(settings.steps):
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * _schedule(step, settings.steps)
        rows = torch.from_numpy(generator.integers(len(x), size=settings.batch_size))
        noise = torch.from_numpy(draw_noise(settings, generator, reconstruction))
        loss = relative_loss(net(x[rows] + noise), k[rows])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
        if on_step is not None and ((step + 1) % every == 0 or step + 1 == settings.steps):
            on_step(StepReport(step + 1, time.process_time() - started, float(np.mean(losses))))
            losses = []
    return net.eval()


def draw_noise(
    settings: LocalGlobalTraining, generator: np.random.Generator, reconstruction: ReconstructionNoise | None
) -> Floats:
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
    buffer = io.BytesIO()
    torch.save({"sizes": net.sizes, "net": net.state_dict(), "settings": asdict(settings)}, buffer)
    write_durably(path, buffer.getvalue())


def load_local_global(path: str | Path) -> LocalGlobalNet:
    """Return the network of a file, ready to estimate."""
    content = torch.load(path, map_location="cpu", weights_only=True)
    net = LocalGlobalNet(**content["sizes"])
    net.load_state_dict(content["net"])
    return net.eval()


_RODS_FOR_COMPONENTS = 40_000  # at most: their principal components are known well enough
_WARM_UP = 200  # steps: the moments of AdamW know nothing at first


def _schedule(step: int, steps: int) -> float:
    return min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1.0 + math.cos(math.pi * step / steps))
