"""Training of the curvature network of the thesis on a dataset of rods.

It is compared with methods that need no learning.
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from stickslip_training.arrays import Array, SingleFloats
from stickslip_training.data.reader import DatasetReader, Split
from stickslip_training.engine import fit as engine
from stickslip_training.rods.evaluation import estimate_strains, evaluate, rms, with_white_noise

POINTS = 150
"""Of a centreline that the network takes."""

FEW_RODS = 30
"""With fewer test rods than this, a report warns that its medians mean little."""

TRAINING, VALIDATION, TEST, ORDER = range(4)
"""Streams of random numbers, kept apart."""


@dataclass(frozen=True)
class Rods:
    """Rods in memory: centrelines over L and strains times L, float32 (rods, 150, 3)."""

    centerline: SingleFloats
    strains: SingleFloats

    def __len__(self) -> int:
        return len(self.strains)

    def __getitem__(self, chosen: slice | Array) -> "Rods":
        return Rods(self.centerline[chosen], self.strains[chosen])


def load_splits(reader: DatasetReader, evaluation_rods: int) -> tuple[dict[str, Rods], list[str]]:
    """Read the three splits, of the test split no more than `evaluation_rods`.

    Return them, and notes on them.

    If a split is empty, another one takes its place, with a note.
    """
    if reader.kind != "rod_hang":
        raise ValueError(
            f"kind of the dataset must be rod_hang to train on curvature: it is {reader.kind}"
        )
    points = reader.arrays["centerline"].shape[0]
    if points != POINTS:
        raise ValueError(
            f"centrelines must have {POINTS} points for this network, and have {points}"
        )
    splits: tuple[Split, ...] = ("train", "validation", "test")
    slots = {split: reader.slots(split) for split in splits}
    if not any(map(len, slots.values())):
        raise ValueError(f"dataset {reader.manifest.dataset} has no valid sample to train on")
    notes = []
    if not len(slots["train"]):
        other: Split = "validation" if len(slots["validation"]) > len(slots["test"]) else "test"
        slots["train"] = slots[other]
        notes.append(f"The train split is empty: the network was trained on the {other} split.")
    if not len(slots["validation"]):
        notes.append(
            "The validation split is empty: the model has the last weights, not the best ones."
        )
    if not len(slots["test"]):
        other = "validation" if len(slots["validation"]) else "train"
        slots["test"] = slots[other]
        purpose = "chose the weights" if other == "validation" else "trained the network"
        notes.append(
            f"The test split is empty: errors are those on the {other} split, which {purpose}."
        )
    if set(slots["test"]) & set(slots["train"]):
        notes.append("Test rods were trained on: these errors do not hold for other rods.")
    if len(slots["test"]) > evaluation_rods:
        notes.append(
            f"Evaluated on {evaluation_rods} of {len(slots['test'])} test rods (evaluation_rods)."
        )
        slots["test"] = slots["test"][:evaluation_rods]
    if len(slots["test"]) < FEW_RODS:
        notes.append(
            f"There are only {len(slots['test'])} test rods: take medians and percentiles "
            "as a hint."
        )
    arrays = ("centerline", "curvature")
    return {
        split: Rods(*(reader.read(name, batch) for name in arrays))
        for split, batch in slots.items()
    }, notes


class CurvatureNet(nn.Module):
    """The network of Table 5.1 of the thesis.

    It takes centrelines over L, (B, 150, 3), to strains (twist, bend1, bend2) times L, (B, 150, 3).
    The table is silent on four things. The choices, and why:

    * Convolutions are padded to keep the length: every one of the 150 points is then the middle of
      a filter, the clamp and the free end too, where the rod bears all of its weight and none.
    * Poolings are not padded: a maximum over a window that reaches beyond the end adds nothing to
      the one that does not. With stride 1 they shorten 150 points to 148, 147 and 146.
    * The second block of the name conv2 has weights of its own; with 128 channels in and not 64 it
      could not share.
    * Inputs and outputs are standardised by fixed numbers, buffers and so part of the state: mean
      and deviation at each point for the centreline, for each strain over all points for the
      output. Adadelta starts with steps of about 1e-3, and the strains are of order 10.
    """

    def __init__(self) -> None:
        super().__init__()

        def convolution(channels_in: int, channels_out: int) -> list[nn.Module]:
            return [nn.Conv1d(channels_in, channels_out, kernel_size=3, padding="same"), nn.ReLU()]

        blocks: list[nn.Module] = []
        for before, after, window in ((3, 64, 3), (64, 128, 2), (128, 128, 2)):
            blocks += [
                *convolution(before, after),
                *convolution(after, after),
                nn.MaxPool1d(window, stride=1),
            ]
        self.features = nn.Sequential(*blocks)
        self.head = nn.Sequential(
            nn.Flatten(), nn.Linear(128 * (POINTS - 4), 512), nn.ReLU(), nn.Linear(512, POINTS * 3)
        )
        self.input_mean: torch.Tensor
        self.input_scale: torch.Tensor
        self.output_mean: torch.Tensor
        self.output_scale: torch.Tensor
        self.register_buffer("input_mean", torch.zeros(POINTS, 3))
        self.register_buffer("input_scale", torch.ones(POINTS, 3))
        self.register_buffer("output_mean", torch.zeros(3))
        self.register_buffer("output_scale", torch.ones(3))

    def standardise(self, centerline: torch.Tensor, strains: torch.Tensor, noise: float) -> None:
        """Set the standardisation from the training rods, (rods, 150, 3) each.

        They are seen with `noise` (of L).
        """
        spread = centerline.double().var(dim=0, correction=0) + noise**2
        self.input_mean.copy_(centerline.double().mean(dim=0))
        self.input_scale.copy_(_positive(spread.sqrt()))
        self.output_mean.copy_(strains.double().mean(dim=(0, 1)))
        self.output_scale.copy_(_positive(strains.double().std(dim=(0, 1), correction=0)))

    def forward(self, centerline: torch.Tensor) -> torch.Tensor:
        """Estimate the strains of a batch of centrelines."""
        x = (centerline - self.input_mean) / self.input_scale
        y = self.head(self.features(x.transpose(1, 2)))
        return torch.as_tensor(y.reshape(-1, POINTS, 3) * self.output_scale + self.output_mean)


def root_mean_square_loss(estimate: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the root of the mean square of all differences, the loss of the thesis."""
    return torch.sqrt(torch.mean(torch.square(estimate - truth)))


def _positive(scale: torch.Tensor) -> torch.Tensor:
    """Return `scale`, and 1 where it is 0.

    A number that is always the same, for example the position of the clamp, then stays 0.
    """
    return torch.where(scale > 1e-12, scale, torch.ones_like(scale))


@dataclass(frozen=True, kw_only=True)
class CurvatureTraining(engine.FitSettings):
    """Settings of a run; an epoch is a pass over the training rods."""

    dataset: str
    """Directory or URL of a dataset of rods."""
    out: Path
    """Directory for the model, the checkpoint and the report."""
    steps: int = 1000
    """Of training, with a batch each."""
    noise: float = 0.005
    """Standard deviation of the white noise on every coordinate of the centreline [L], in training
    and evaluation.
    """
    batch_size: int = 16
    """After six passes over 1,985 rods, 16 had a test loss of 0.50 rad, and 64 of 1.75."""
    learning_rate: float = 1.0
    """Learning rate of Adadelta [Zeiler 2012]; it and the decay stand in the thesis (4.4)."""
    decay: float = 0.95
    averaging: float = 0.98
    """Decay of the running average over steps that is the model's weights; 0 takes the last weights
    as they are.

    Not in the thesis. Steps of Adadelta at this rate do not get smaller, and leave the network a
    constant off, now this way, now that: the average had half the error and less of the last
    weights (README).
    """
    evaluation_rods: int = 1000
    """The most test rods that are evaluated; the first of the split are taken."""

    def __post_init__(self) -> None:
        super().__post_init__()
        engine.check_positive(self, "batch_size", "learning_rate", "evaluation_rods")
        if not 0 <= self.noise < 1:
            raise ValueError(
                f"noise must be a share of L, from 0 to less than 1, and is {self.noise}"
            )
        if not 0 < self.decay < 1:
            raise ValueError(f"decay must be between 0 and 1, and is {self.decay}")


def train_curvature(
    config: CurvatureTraining,
    *,
    resume: bool = False,
    on_epoch: Callable[[engine.EpochReport], None] | None = None,
) -> dict[str, Any]:
    """Train and evaluate.

    Write the model, a checkpoint and the report below `config.out`, and return the report.

    It has the dataset, `config`, the number of `rods` of each split, the run, its `test_loss` over
    all three strains [rad], how each of the `methods` did, and `notes` that a reader of the numbers
    must know.

    With `resume`, go on from the checkpoint there, of a run with the same config but for its
    length; its training time counts. `on_epoch` hears of every epoch.
    """
    with DatasetReader(config.dataset) as reader:
        rods, notes = load_splits(reader, config.evaluation_rods)
        manifest = reader.manifest
        digest = reader.manifest_digest
    learner = _CurvatureLearner(config, rods["train"], rods["validation"])
    names = ("noise", "batch_size", "learning_rate", "decay")
    identity = {"manifest": digest, **{name: getattr(config, name) for name in names}}
    config = replace(config, epoch=learner.steps_per_epoch)
    fitted = engine.fit(
        learner, config, out=config.out, identity=identity, resume=resume, on_epoch=on_epoch
    )
    with engine.torch_threads(config.threads):
        noisy = with_white_noise(rods["test"].centerline, config.noise, (config.seed, TEST))
        methods, test_loss = evaluate(fitted.net, noisy, rods["test"].strains)
    report = {
        "dataset": manifest.dataset,
        "version": manifest.version,
        "manifest": digest,
        "certificate": manifest.certificate,
        "config": {**asdict(config), "out": str(config.out)},
        "rods": {name: len(part) for name, part in rods.items()},
        **fitted.facts(),
        "test_loss": test_loss,
        "methods": methods,
        "notes": notes,
    }
    content = {"net": fitted.net.state_dict(), "noise": config.noise, "manifest": digest}
    engine.save_tensors(config.out / "model.pt", content)
    engine.write_report(config.out, report)
    return report


def load_model(path: str | Path) -> CurvatureNet:
    """Return the network of a `model.pt`, ready to estimate."""
    net = CurvatureNet()
    net.load_state_dict(engine.load_tensors(path)["net"])
    return net.eval()


class _CurvatureLearner(engine.Learner):
    """Passes over the training rods in random orders; noise is drawn afresh at every step."""

    def __init__(self, config: CurvatureTraining, train: Rods, validation: Rods) -> None:
        self.config = config
        self.train = train
        self.validation = validation
        self.noisy_validation = with_white_noise(
            validation.centerline, config.noise, (config.seed, VALIDATION)
        )
        self.steps_per_epoch = -(-len(train) // config.batch_size)
        with engine.seeded(config.seed):
            self.net = CurvatureNet()
        self.net.standardise(
            torch.from_numpy(train.centerline), torch.from_numpy(train.strains), config.noise
        )

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.Adadelta(parameters, lr=self.config.learning_rate, rho=self.config.decay)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        config = self.config
        epoch, position = divmod(step, self.steps_per_epoch)
        order = np.random.default_rng((config.seed, ORDER, epoch)).permutation(len(self.train))
        batch = self.train[order[position * config.batch_size : (position + 1) * config.batch_size]]
        noisy = with_white_noise(batch.centerline, config.noise, (config.seed, TRAINING, step))
        estimate = net(torch.from_numpy(noisy).to(config.device))
        return root_mean_square_loss(estimate, torch.from_numpy(batch.strains).to(config.device))

    def validate(self, net: nn.Module) -> float | None:
        if not len(self.validation):
            return None
        return rms(estimate_strains(net, self.noisy_validation) - self.validation.strains)
