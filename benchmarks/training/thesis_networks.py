"""The thesis's networks on clips of Blender, split by clip and by simulation: what its 98.3 % are worth.

    python benchmarks/training/thesis_networks.py NET SPLIT CLIPS.npz ... --test CLIPS.npz [--steps 1200] [--size 56]
        [--records FILE.jsonl]

NET is `baseline` (blind to the material), `conditional` (told the true one) or `material` [thesis, Tables 4.3 and 4.4],
or `posterior`: our `PosteriorNet`, on the same clips and nothing else.
With SPLIT `by_clip` a tenth of the clips is to test with, as in the thesis: every simulation of the test was seen in
training, with other textures. With `by_simulation` all clips are trained on, and those of `--test` show other
simulations. All are of `blender_clips.py`. Three things are smaller than in the thesis: clips have `--frames` frames,
not 30, pictures are `--size` px wide, not 224, and training is short. Friction has classes of 0.1, as in the thesis,
but the true mu lie anywhere between 0 and 1.6.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stickslip_training.arrays import Array
from stickslip_training.cloth.clips import clips_of_file
from stickslip_training.cloth.evaluation import Errors, Measure, errors, measure
from stickslip_training.cloth.nets import BaselineNet, ConditionalNet, PosteriorNet
from stickslip_training.cloth.posterior import MU_BINS, Estimates, estimates
from stickslip_training.cloth.training import Clips as Crops
from stickslip_training.cloth.training import answer, features, jittered, load_friction
from stickslip_training.engine.fit import EpochReport, FitSettings, Learner, cosine_rate, fit, seed_of_step
from torch import nn

CLASSES = 17
"""Of mu: 0, 0.1, ... 1.6."""

MEAN, DEVIATION = 60.0, 60.0
"""By which levels are centred, of 255."""

BATCH = 16
_CHUNK = 32


class Clips:
    """Clips in memory, and what is true of them."""

    def __init__(self, files: list[Path], size: int, frames: int) -> None:
        """Read `frames` frames of each clip, evenly spread, and make pictures `size` px wide by means over pixels."""
        pictures, about = [], []
        for path in files:
            with np.load(path) as file:
                about += [json.loads(str(line)) for line in file["about"]]
                shown = np.linspace(0, len(file["instants"]) - 1, frames).round().astype(int)
                for clip in file["video"]:
                    levels = torch.from_numpy(clip[shown]).permute(0, 3, 1, 2).float()
                    pictures.append(nn.functional.adaptive_avg_pool2d(levels, size).round().to(torch.uint8))
        self.pictures = torch.stack(pictures)
        """(clips, F, 3, size, size)"""
        self.mu = np.array([clip["mu"] for clip in about])
        self.run = np.array([clip["run"] for clip in about])
        self.names = [clip["material"] for clip in about]

    def materials(self, known: list[str]) -> torch.Tensor:
        """Return the codes of the materials, (clips,)."""
        return torch.tensor([known.index(name) for name in self.names])


class ThesisLearner(Learner):
    """One of the networks, trained as the thesis does: Adadelta, 1.0, decay 0.95, cross-entropy."""

    def __init__(self, kind: str, clips: Clips, chosen: Array, materials: list[str], seed: int) -> None:
        """Take the clips `chosen` of `clips`."""
        self.kind, self.clips, self.chosen, self.known, self.seed = kind, clips, chosen, materials, seed
        own = clips.materials(materials)
        self.target = own if kind == "material" else torch.from_numpy(np.round(10 * clips.mu).astype(int))
        torch.manual_seed(seed)
        classes = len(materials) if kind == "material" else CLASSES
        net = ConditionalNet(classes, len(materials)) if kind == "conditional" else BaselineNet(classes)
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stub lacks it

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.Adadelta(parameters, lr=1.0, rho=0.95)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        random = np.random.default_rng(seed_of_step(self.seed, 0, step))
        batch = self.chosen[random.integers(len(self.chosen), size=BATCH)]
        logits = self.logits(net, self.clips, batch)
        return nn.functional.cross_entropy(logits, self.target[batch])

    def logits(self, net: nn.Module, clips: Clips, batch: Array) -> torch.Tensor:
        """Return the logits of some clips, computed in bfloat16 with float32 weights."""
        with torch.autocast("cpu", torch.bfloat16):
            x = (clips.pictures[batch].float() - MEAN) / DEVIATION
            told = (clips.materials(self.known)[batch],) if self.kind == "conditional" else ()
            return torch.as_tensor(net(x, *told)).float()


class PosteriorLearner(Learner):
    """`PosteriorNet` on the crops of clips, without pictures that are rendered while it trains."""

    def __init__(self, clips: Crops, chosen: Array, count: int, settings: FitSettings) -> None:
        """Take the clips `chosen` of `clips`, of `count` materials."""
        assert settings.steps is not None
        self.clips, self.chosen, self.seed, self.steps = clips, chosen, settings.seed, settings.steps
        torch.manual_seed(settings.seed)
        self.net = PosteriorNet(materials=count, bins=MU_BINS.count, frames=clips.crops.shape[1])
        place = np.clip((clips.mu / (MU_BINS.edges[1] - MU_BINS.edges[0])).astype(int), 0, MU_BINS.count - 1)
        self.place, self.material = torch.from_numpy(place), torch.from_numpy(clips.material)

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(parameters, lr=1e-3, weight_decay=0.02)

    def learning_rate(self, step: int) -> float | None:
        return cosine_rate(1e-3, step, self.steps, 100)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        seed = seed_of_step(self.seed, 0, step)
        batch = self.chosen[np.random.default_rng(seed).integers(len(self.chosen), size=BATCH)]
        crops = jittered(self.clips.crops[batch], torch.Generator().manual_seed(seed))
        log_material, log_mu = net(crops, self.clips.direction[batch])
        material, rows = self.material[batch], torch.arange(BATCH)
        return torch.as_tensor(-(log_material[rows, material] + log_mu[rows, material, self.place[batch]]).mean())


def posterior(args: argparse.Namespace) -> None:
    """Train and test `PosteriorNet`, print and record."""
    materials = load_friction().materials
    clips = Crops.joined([clips_of_file(path, materials)[0] for path in args.clips])
    train, asked = parted(len(clips), args)
    test = clips[asked] if args.split == "by_clip" else clips_of_file(args.test, materials)[0]
    settings = FitSettings(steps=args.steps, epoch=500, seed=args.seed, averaging=0.99, clip=1.0, threads=1)
    started = time.process_time()
    net = fit(PosteriorLearner(clips, train, len(materials), settings), settings, on_epoch=tell(args.steps)).net
    assert isinstance(net, PosteriorNet)
    log_material, log_mu = answer(net, features(net, test))
    joint = np.exp(log_material)[:, :, None] * np.exp(log_mu)
    found = errors(estimates(joint.sum(axis=1), MU_BINS), test.mu, test.run)
    right = measure((log_material.argmax(axis=1) == test.material).astype(float), test.run)
    finish(args, len(train), time.process_time() - started, found, right)


def parted(count: int, args: argparse.Namespace) -> tuple[Array, Array]:
    """Return the numbers of the clips to train on, and of the tenth to test with where the split is by clip."""
    order = np.random.default_rng(args.seed).permutation(count)
    tenth = count // 10 if args.split == "by_clip" else 0
    return order[tenth:], order[:tenth]


def tell(steps: int) -> Callable[[EpochReport], None]:
    """Return what prints how far a run is."""
    return lambda epoch: print(
        f"step {epoch.step} of {steps}: loss {epoch.train_loss:.3f}, {epoch.seconds:.0f} s", flush=True
    )


def finish(args: argparse.Namespace, trained: int, seconds: float, found: Errors | None, right: Measure | None) -> None:
    """Print and record what a network got right."""
    record: dict[str, Any] = {
        **{key: getattr(args, key) for key in ("net", "split", "steps", "size", "frames")},
        "epochs": round(args.steps * BATCH / trained, 2),
        "trained_on": trained,
        "cpu_s": round(seconds),
        "errors": None if found is None else asdict(found),
        "top_1": None if right is None else asdict(right),
    }
    if args.net == "posterior":  # it has crops of all six frames
        record |= {"size": None, "frames": 6}
    told = (
        []
        if found is None
        else [
            f"{found.clips} clips of {found.simulations} simulations, mean error {found.mae}, < 0.1 / < 0.2 "
            f"{found.within_01.value:.1%} / {found.within_02.value:.1%}"
        ]
    )
    told += [] if right is None else [f"material {right.value:.1%}"]
    print(f"{args.net}, {args.split}: {', '.join(told)}, {seconds:.0f} CPU s")
    if args.records is not None:
        with args.records.open("a") as file:
            file.write(json.dumps(record) + "\n")


def main() -> None:
    """Train, test, print and record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("net", choices=("baseline", "conditional", "material", "posterior"))
    parser.add_argument("split", choices=("by_clip", "by_simulation"))
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--size", type=int, default=56)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--records", type=Path)
    args = parser.parse_args()
    if args.net == "posterior":
        posterior(args)
        return
    clips = Clips(args.clips, args.size, args.frames)
    materials = sorted(set(clips.names))
    train, asked = parted(len(clips.mu), args)
    test = clips if args.split == "by_clip" else Clips([args.test], args.size, args.frames)
    asked = asked if args.split == "by_clip" else np.arange(len(test.mu))
    learner = ThesisLearner(args.net, clips, train, materials, args.seed)
    started = time.process_time()
    settings = FitSettings(steps=args.steps, epoch=100, seed=args.seed, threads=1)
    net = fit(learner, settings, on_epoch=tell(args.steps)).net
    seconds = time.process_time() - started
    with torch.inference_mode():
        parts = [learner.logits(net, test, asked[at : at + _CHUNK]) for at in range(0, len(asked), _CHUNK)]
    code = torch.cat(parts).argmax(dim=1).numpy()
    if args.net == "material":
        right = (code == test.materials(materials)[asked].numpy()).astype(float)
        finish(args, len(train), seconds, None, measure(right, test.run[asked]))
    else:
        mu = code / 10
        finish(args, len(train), seconds, errors(Estimates(mu, mu, mu), test.mu[asked], test.run[asked]), None)


if __name__ == "__main__":
    main()
