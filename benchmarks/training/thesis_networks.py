"""The thesis's networks on clips of Blender, split by clip and by simulation: what its 98.3 % are worth.

    python benchmarks/training/thesis_networks.py NET SPLIT CLIPS.npz ... --test CLIPS.npz [--steps 1200] [--size 56]
        [--records FILE.jsonl]

NET is `baseline` (blind to the material), `conditional` (told the true one) or `material` [thesis, Tables 4.3 and 4.4].
With SPLIT `by_clip` a tenth of the clips is to test with, as in the thesis: every simulation of the test was seen in
training, with other textures. With `by_simulation` all clips are trained on, and those of `--test` show other
simulations. All are of `blender_clips.py`. Three things are smaller than in the thesis: clips have `--frames` frames,
not 30, pictures are `--size` px wide, not 224, and training is short. Friction has classes of 0.1, as in the thesis,
but the true mu lie anywhere between 0 and 1.6.
"""

import argparse
import json
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stickslip_training.arrays import Array
from stickslip_training.cloth.evaluation import errors, measure
from stickslip_training.cloth.nets import BaselineNet, ConditionalNet
from stickslip_training.cloth.posterior import Estimates
from stickslip_training.engine.fit import EpochReport, FitSettings, Learner, fit, seed_of_step
from torch import nn

CLASSES = 17
"""Of mu: 0, 0.1, ... 1.6."""

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
        self.net = net.to(memory_format=torch.channels_last)

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
            x = clips.pictures[batch].float() / 255
            told = (clips.materials(self.known)[batch],) if self.kind == "conditional" else ()
            return torch.as_tensor(net(x, *told)).float()


def main() -> None:
    """Train, test, print and record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("net", choices=("baseline", "conditional", "material"))
    parser.add_argument("split", choices=("by_clip", "by_simulation"))
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--test", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--size", type=int, default=56)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--records", type=Path)
    args = parser.parse_args()
    clips = Clips(args.clips, args.size, args.frames)
    materials = sorted(set(clips.names))
    order = np.random.default_rng(args.seed).permutation(len(clips.mu))
    tenth = len(order) // 10
    by_clip = args.split == "by_clip"
    train = order[tenth:] if by_clip else order
    test = clips if by_clip else Clips([args.test], args.size, args.frames)
    asked = order[:tenth] if by_clip else np.arange(len(test.mu))
    learner = ThesisLearner(args.net, clips, train, materials, args.seed)
    started = time.process_time()

    def tell(epoch: EpochReport) -> None:
        print(f"step {epoch.step} of {args.steps}: loss {epoch.train_loss:.3f}, {epoch.seconds:.0f} s", flush=True)

    settings = FitSettings(steps=args.steps, epoch=100, seed=args.seed, clip=None, threads=1)
    net = fit(learner, settings, on_epoch=tell).net
    seconds = time.process_time() - started
    with torch.inference_mode():
        parts = [learner.logits(net, test, asked[at : at + _CHUNK]) for at in range(0, len(asked), _CHUNK)]
    answer = torch.cat(parts).argmax(dim=1).numpy()
    record: dict[str, Any] = {
        "net": args.net,
        "split": args.split,
        "steps": args.steps,
        "size": args.size,
        "frames": args.frames,
        "epochs": round(args.steps * BATCH / len(train), 2),
        "trained_on": len(train),
        "cpu_s": round(seconds),
    }
    if args.net == "material":
        right = (answer == test.materials(materials)[asked].numpy()).astype(float)
        record["top_1"] = asdict(measure(right, test.run[asked]))
        print(f"{args.net}, {args.split}: right {measure(right, test.run[asked])}, {seconds:.0f} CPU s")
    else:
        mu = answer / 10
        found = errors(Estimates(mu, mu, mu), test.mu[asked], test.run[asked])
        record["errors"] = asdict(found)
        print(
            f"{args.net}, {args.split}: {found.clips} clips of {found.simulations} simulations, mean error "
            f"{found.mae}, < 0.1 / < 0.2 {found.within_01.value:.1%} / {found.within_02.value:.1%}, {seconds:.0f} CPU s"
        )
    if args.records is not None:
        with args.records.open("a") as file:
            file.write(json.dumps(record) + "\n")


if __name__ == "__main__":
    main()
