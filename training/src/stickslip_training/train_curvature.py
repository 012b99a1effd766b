"""Train the curvature network on a dataset of rods, and measure it against what needs no learning.

A run is a function of its config: the same config, dataset, machine and number of threads give the same weights after
the same number of steps. Every step draws its rods and its noise from the seed and its own number, so a run that is
resumed goes on exactly as if it had not stopped. With a time budget only the number of steps depends on the machine.
"""

import copy
import io
import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import torch
from stickslip_schemas.store import write_durably

from stickslip_training import __version__
from stickslip_training.curvature_baselines import (
    cubic_spline_curvature,
    finite_difference_curvature,
    quintic_spline_curvature,
)
from stickslip_training.curvature_errors import bending, relative_rms_error, rms
from stickslip_training.curvature_net import POINTS, CurvatureNet, root_mean_square_loss
from stickslip_training.noise import with_white_noise
from stickslip_training.reader import DatasetReader, Split

MODEL_NAME = "model.pt"
CHECKPOINT_NAME = "checkpoint.pt"
REPORT_NAME = "report.json"

FEW_RODS = 30
"""With fewer test rods than this, the report warns that its medians mean little."""

_TRAINING, _VALIDATION, _TEST, _ORDER = range(4)  # streams of random numbers, kept apart
_CHECKPOINT_SECONDS = 300.0  # a checkpoint is five times as large as the network: not every epoch
_CHUNK = 256  # rods that go through the network at once outside of training


@dataclass(frozen=True, kw_only=True)
class CurvatureTraining:
    """What a run is told. Exactly one of `minutes` and `epochs` says how long it takes."""

    dataset: str
    """Directory or URL of a dataset of rods."""
    out: Path
    """Directory for the model, the checkpoint and the report."""
    minutes: float | None = None
    """Time for training [min]; reading, and the baselines of the evaluation, come on top."""
    epochs: int | None = None
    """Passes over the training rods."""
    noise: float = 0.005
    """Standard deviation of the white noise on every coordinate of the centreline [L], in training and evaluation."""
    seed: int = 0
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
    threads: int = 2
    device: str = "cpu"
    """Of torch."""
    evaluation_rods: int = 1000
    """The most test rods that are evaluated; the first of the split are taken, and the report says how many."""

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.epochs is None):
            raise ValueError("exactly one of minutes and epochs must be given")
        positive = ("minutes", "epochs", "batch_size", "learning_rate", "threads", "evaluation_rods")
        for name in positive:
            value = getattr(self, name)
            if value is not None and not (0 < value < math.inf):
                raise ValueError(f"{name} must be more than 0 and finite, and is {value}")
        if not 0 <= self.noise < 1:
            raise ValueError(f"noise must be a share of L, from 0 to less than 1, and is {self.noise}")
        if not 0 < self.decay < 1:
            raise ValueError(f"decay must be between 0 and 1, and is {self.decay}")
        if not 0 <= self.averaging < 1:
            raise ValueError(f"averaging must be from 0 to less than 1, and is {self.averaging}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to 2**31 - 1, and is {self.seed}")


@dataclass(frozen=True, kw_only=True)
class MethodReport:
    """How well one method finds the curvature of the test rods. Errors are of |kappa|: see `curvature_errors`."""

    method: str
    rms: float
    """RMS error of |kappa| L over all points of all rods [rad]."""
    relative_median: float
    """Median over the rods of the RMS relative error."""
    relative_p90: float
    """90th percentile over the rods of the RMS relative error."""
    seconds_per_rod: float


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """One pass over the training rods. Losses are the root mean square over the strains times L [rad]."""

    epoch: int
    step: int
    seconds: float
    """Training time so far [s]."""
    train_loss: float
    validation_loss: float | None


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """What came out of a run."""

    dataset: str
    version: int
    manifest: str
    """SHA-256 of the manifest."""
    certificate: str | None
    config: dict[str, Any]
    rods: dict[str, int]
    """Number of rods used for training, validation and test."""
    parameters: int
    """Number of weights of the network."""
    steps: int
    seconds: float
    """Training time [s]."""
    history: tuple[EpochReport, ...]
    best_step: int
    """The step whose weights are the model."""
    test_loss: float
    """The loss on the test rods, all three strains [rad]."""
    methods: tuple[MethodReport, ...]
    notes: tuple[str, ...]
    """What a reader of the numbers has to know: splits that were missing, few rods."""
    versions: dict[str, str]

    def to_json(self) -> str:
        """Return the report as JSON."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"


@dataclass(frozen=True)
class Rods:
    """Rods in memory: centrelines over L and strains times L, float32 (rods, 150, 3), and their slots."""

    slots: npt.NDArray[np.int64]
    centerline: npt.NDArray[np.float32]
    strains: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.slots)

    def __getitem__(self, chosen: slice | npt.NDArray[np.int64]) -> "Rods":
        return Rods(self.slots[chosen], self.centerline[chosen], self.strains[chosen])


@dataclass
class _State:
    """What changes during a run, besides the weights and the optimiser."""

    step: int
    seconds: float
    history: list[EpochReport]
    epoch_losses: list[float]
    best_step: int
    best_loss: float
    best: dict[str, torch.Tensor]


def train_curvature(
    config: CurvatureTraining, *, resume: bool = False, on_epoch: Callable[[EpochReport], None] | None = None
) -> TrainingReport:
    """Train and evaluate; write the model, a checkpoint and the report below `config.out`.

    With `resume`, go on from the checkpoint there, of a run with the same config but for its length; its training time
    counts. `on_epoch` hears of every epoch.
    """
    with DatasetReader(config.dataset) as reader:
        rods, notes = load_splits(reader, config)
        manifest, digest = reader.manifest, reader.manifest_digest
    threads = torch.get_num_threads()
    torch.set_num_threads(config.threads)
    try:
        net, state = _train(config, rods, digest, resume, on_epoch)
        net.load_state_dict(state.best)
        methods, test_loss = evaluate(config, net, rods["test"])
    finally:
        torch.set_num_threads(threads)
    report = TrainingReport(
        dataset=manifest.dataset,
        version=manifest.version,
        manifest=digest,
        certificate=manifest.certificate,
        config={**asdict(config), "out": str(config.out)},
        rods={name: len(part) for name, part in rods.items()},
        parameters=sum(parameter.numel() for parameter in net.parameters()),
        steps=state.step,
        seconds=round(state.seconds, 3),
        history=tuple(state.history),
        best_step=state.best_step,
        test_loss=test_loss,
        methods=methods,
        notes=tuple(notes),
        versions={
            "stickslip-training": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
    )
    _save(config.out / MODEL_NAME, {"net": net.state_dict(), "noise": config.noise, "manifest": digest})
    write_durably(config.out / REPORT_NAME, report.to_json().encode())
    return report


def train_on_rods(config: CurvatureTraining, train: Rods, validation: Rods) -> CurvatureNet:
    """Train on rods in memory instead of a dataset, and return the network; `config.dataset` is only a name."""
    threads = torch.get_num_threads()
    torch.set_num_threads(config.threads)
    try:
        net, state = _train(config, {"train": train, "validation": validation}, "", False, None)
    finally:
        torch.set_num_threads(threads)
    net.load_state_dict(state.best)
    return net.eval()


def load_model(path: str | Path) -> CurvatureNet:
    """Return the network of a `model.pt`, ready to estimate."""
    net = CurvatureNet()
    net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["net"])
    return net.eval()


def estimate_strains(net: torch.nn.Module, centerline: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the strains (twist, bend1, bend2) times L of centrelines over L, both (rods, 150, 3)."""
    device = next(net.parameters()).device
    with torch.inference_mode():
        parts = [
            net(torch.from_numpy(centerline[start : start + _CHUNK]).to(device)).cpu().numpy()
            for start in range(0, len(centerline), _CHUNK)
        ]
    return np.concatenate(parts)


# --- data -----------------------------------------------------------------------------------------------------


def read_rods(reader: DatasetReader, slots: npt.NDArray[np.int64]) -> Rods:
    """Read the rods in `slots` into memory."""
    return Rods(slots, reader.read("centerline", slots), reader.read("curvature", slots))


def read_test_rods(config: CurvatureTraining) -> tuple[Rods, npt.NDArray[np.float32]]:
    """Return the rods that a run with `config` is evaluated on, and their centrelines as all methods see them."""
    with DatasetReader(config.dataset) as reader:
        rods = load_splits(reader, config, only="test")[0]["test"]
    return rods, _noisy_test(config, rods)


def _noisy_test(config: CurvatureTraining, rods: Rods) -> npt.NDArray[np.float32]:
    return with_white_noise(rods.centerline, config.noise, (config.seed, _TEST))


def load_splits(
    reader: DatasetReader, config: CurvatureTraining, only: Split | None = None
) -> tuple[dict[str, Rods], list[str]]:
    """Read the three splits; where one is empty, take what there is and say so."""
    if reader.kind != "rod_hang":
        raise ValueError(f"kind of the dataset must be rod_hang to train on curvature: it is {reader.kind}")
    points = reader.arrays["centerline"].shape[0]
    if points != POINTS:
        raise ValueError(f"centrelines must have {POINTS} points for this network, and have {points}")
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
        notes.append("The validation split is empty: the model has the last weights, not the best ones.")
    if not len(slots["test"]):
        other = "validation" if len(slots["validation"]) else "train"
        slots["test"] = slots[other]
        seen = "chose the weights" if other == "validation" else "trained the network"
        notes.append(f"The test split is empty: errors are those on the {other} split, which {seen}.")
    if set(slots["test"]) & set(slots["train"]):
        notes.append("Test rods were trained on: the network's errors say nothing about rods it has not seen.")
    if len(slots["test"]) > config.evaluation_rods:
        notes.append(f"Evaluated on {config.evaluation_rods} of {len(slots['test'])} test rods (evaluation_rods).")
        slots["test"] = slots["test"][: config.evaluation_rods]
    if len(slots["test"]) < FEW_RODS:
        notes.append(f"There are only {len(slots['test'])} test rods: take medians and percentiles as a hint.")
    return {split: read_rods(reader, slots[split]) for split in splits if only in (None, split)}, notes


# --- training -------------------------------------------------------------------------------------------------


def _train(
    config: CurvatureTraining,
    rods: dict[str, Rods],
    manifest: str,
    resume: bool,
    on_epoch: Callable[[EpochReport], None] | None,
) -> tuple[CurvatureNet, _State]:
    device = torch.device(config.device)
    with torch.random.fork_rng():
        torch.manual_seed(config.seed)
        net = CurvatureNet()
    train = rods["train"]
    net.standardise(torch.from_numpy(train.centerline), torch.from_numpy(train.strains), config.noise)
    net.to(device)
    averaged = copy.deepcopy(net).eval()
    optimizer = torch.optim.Adadelta(net.parameters(), lr=config.learning_rate, rho=config.decay)
    state = _State(0, 0.0, [], [], 0, math.inf, {})
    if resume:
        _restore(config, manifest, net, averaged, optimizer, state)
    steps_per_epoch = -(-len(train) // config.batch_size)
    noisy_validation = with_white_noise(rods["validation"].centerline, config.noise, (config.seed, _VALIDATION))
    checkpointed = state.seconds
    started = time.perf_counter() - state.seconds
    epoch = state.step // steps_per_epoch
    order = _order(config, epoch, len(train))
    net.train()
    while not _is_over(config, state, steps_per_epoch):
        epoch, position = divmod(state.step, steps_per_epoch)
        if position == 0:
            order = _order(config, epoch, len(train))
        batch = train[order[position * config.batch_size : (position + 1) * config.batch_size]]
        noisy = with_white_noise(batch.centerline, config.noise, (config.seed, _TRAINING, state.step))
        loss = root_mean_square_loss(
            net(torch.from_numpy(noisy).to(device)), torch.from_numpy(batch.strains).to(device)
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimizer.step()
        _average(averaged, net, config.averaging, state.step)
        state.epoch_losses.append(loss.item())
        state.step += 1
        state.seconds = time.perf_counter() - started
        if position == steps_per_epoch - 1:
            _end_epoch(averaged, rods["validation"], noisy_validation, state, epoch + 1, on_epoch)
            state.seconds = time.perf_counter() - started
            if state.seconds - checkpointed > _CHECKPOINT_SECONDS:
                _checkpoint(config, manifest, net, averaged, optimizer, state)
                checkpointed = state.seconds
    _checkpoint(config, manifest, net, averaged, optimizer, state)
    if state.epoch_losses:
        # The time was up in the middle of an epoch. That is news for this run's report and model, and not for the
        # checkpoint: a run that goes on from it will end the epoch.
        _end_epoch(averaged, rods["validation"], noisy_validation, state, epoch + 1, on_epoch)
    return net, state


def _average(averaged: CurvatureNet, net: CurvatureNet, decay: float, step: int) -> None:
    """Move the average towards the weights; faster at first, so that it forgets where they began."""
    share = 1.0 - min(decay, (1 + step) / (10 + step))
    with torch.no_grad():
        for mean, weight in zip(averaged.parameters(), net.parameters(), strict=True):
            mean.lerp_(weight, share)


def _is_over(config: CurvatureTraining, state: _State, steps_per_epoch: int) -> bool:
    if config.epochs is not None:
        return state.step >= config.epochs * steps_per_epoch
    assert config.minutes is not None
    return state.step > 0 and state.seconds >= 60 * config.minutes


def _order(config: CurvatureTraining, epoch: int, count: int) -> npt.NDArray[np.int64]:
    return np.random.default_rng((config.seed, _ORDER, epoch)).permutation(count)


def _end_epoch(
    averaged: CurvatureNet,
    validation: Rods,
    noisy: npt.NDArray[np.float32],
    state: _State,
    epoch: int,
    on_epoch: Callable[[EpochReport], None] | None,
) -> None:
    """Validate, keep the weights if they are the best so far (or if there is nothing to choose them by), report."""
    validation_loss = None
    if len(validation):
        validation_loss = rms(estimate_strains(averaged, noisy) - validation.strains)
    report = EpochReport(
        epoch=epoch,
        step=state.step,
        seconds=round(state.seconds, 3),
        train_loss=float(np.mean(state.epoch_losses)),
        validation_loss=validation_loss,
    )
    state.history.append(report)
    state.epoch_losses = []
    if validation_loss is None or validation_loss < state.best_loss:
        state.best_loss = math.inf if validation_loss is None else validation_loss
        state.best_step = state.step
        state.best = {name: tensor.detach().cpu().clone() for name, tensor in averaged.state_dict().items()}
    if on_epoch is not None:
        on_epoch(report)


# --- evaluation -----------------------------------------------------------------------------------------------


def evaluate(config: CurvatureTraining, net: torch.nn.Module, rods: Rods) -> tuple[tuple[MethodReport, ...], float]:
    """Let every method see the same noisy centrelines; return how each did, and the network's loss."""
    noisy = _noisy_test(config, rods)
    truth = bending(rods.strains)
    net.eval()
    started = time.perf_counter()
    strains = estimate_strains(net, noisy)
    reports = [_method("network", bending(strains), truth, started)]
    baselines = {
        "quintic spline": quintic_spline_curvature,
        "cubic spline": cubic_spline_curvature,
        "finite differences": finite_difference_curvature,
    }
    for name, method in baselines.items():
        method(noisy[:1])  # the splines' basis is made once, whatever the number of rods
        started = time.perf_counter()
        reports.append(_method(name, method(noisy), truth, started))
    return tuple(reports), rms(strains - rods.strains)


def _method(
    name: str, estimate: npt.NDArray[np.float64], truth: npt.NDArray[np.float64], started: float
) -> MethodReport:
    seconds = (time.perf_counter() - started) / len(truth)
    errors = relative_rms_error(estimate, truth)
    return MethodReport(
        method=name,
        rms=rms(estimate - truth),
        relative_median=float(np.median(errors)),
        relative_p90=float(np.quantile(errors, 0.9)),
        seconds_per_rod=seconds,
    )


# --- files ----------------------------------------------------------------------------------------------------


def _save(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all; `torch.load(weights_only=True)` reads them."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_durably(path, buffer.getvalue())


def _identity(config: CurvatureTraining, manifest: str) -> dict[str, Any]:
    """What must be the same for a run to go on from a checkpoint."""
    names = ("noise", "seed", "batch_size", "learning_rate", "decay", "averaging")
    return {"manifest": manifest, **{name: getattr(config, name) for name in names}}


def _checkpoint(
    config: CurvatureTraining,
    manifest: str,
    net: CurvatureNet,
    averaged: CurvatureNet,
    optimizer: torch.optim.Optimizer,
    state: _State,
) -> None:
    content = {
        "identity": _identity(config, manifest),
        "net": net.state_dict(),
        "averaged": averaged.state_dict(),
        "optimizer": optimizer.state_dict(),
        "state": {**vars(state), "history": [asdict(report) for report in state.history]},
    }
    _save(config.out / CHECKPOINT_NAME, content)


def _restore(
    config: CurvatureTraining,
    manifest: str,
    net: CurvatureNet,
    averaged: CurvatureNet,
    optimizer: torch.optim.Optimizer,
    state: _State,
) -> None:
    path = config.out / CHECKPOINT_NAME
    if not path.exists():
        raise ValueError(f"{path} is not there: there is nothing to resume")
    content = torch.load(path, map_location=config.device, weights_only=True)
    for name, value in _identity(config, manifest).items():
        if content["identity"].get(name) != value:
            raise ValueError(
                f"{name} must be that of the run that is resumed, {content['identity'].get(name)}, and is {value}"
            )
    net.load_state_dict(content["net"])
    averaged.load_state_dict(content["averaged"])
    optimizer.load_state_dict(content["optimizer"])
    for name, value in content["state"].items():
        setattr(state, name, value)
    state.history = [EpochReport(**report) for report in content["state"]["history"]]
    state.best = {name: tensor.cpu() for name, tensor in state.best.items()}
