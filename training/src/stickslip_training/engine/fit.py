"""The training loop of every model: steps, averaged weights, validation, checkpoints, resume.

A `Learner` decides the task. A run is a function of its settings: every step draws its
batch from the seed and its own number, and torch's generator is seeded with both, so the same
settings, data, machine and number of threads give the same weights, and a run that is resumed goes
on exactly as if it had not stopped.
"""

import copy
import io
import json
import math
import platform
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import scipy
import torch
from stickslip_schemas.store import write_durably
from torch import nn

from stickslip_training import __version__

CHECKPOINT_NAME = "checkpoint.pt"

_CHECKPOINT_SECONDS = 300.0  # a checkpoint is several times as large as the network


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Settings of a run."""

    steps: int
    epoch: int = 1
    """Steps after which the network is validated and a report made."""
    seed: int = 0
    averaging: float = 0.0
    """Decay of the running average over steps that is the model's weights; 0 takes the last weights
    as they are.
    """
    clip: float | None = None
    """The largest norm of a step's gradient; longer ones are shortened to it."""
    threads: int = 2
    """Of torch."""
    device: str = "cpu"
    """Of torch."""

    def __post_init__(self) -> None:
        check_positive(self, "steps", "epoch", "clip", "threads")
        if not 0 <= self.averaging < 1:
            raise ValueError(f"averaging must be from 0 to less than 1, and is {self.averaging}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to 2**31 - 1, and is {self.seed}")
        check_device(self.device)


class Learner(ABC):
    """Interface of a model to the loop: its network, its optimiser, and the loss of a step."""

    net: nn.Module

    @abstractmethod
    def optimizer(self, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
        """Return the optimiser, new."""

    @abstractmethod
    def loss(self, net: nn.Module, step: int) -> torch.Tensor:
        """Return the loss of the batch of `step`.

        It must depend on nothing but the seed and `step`.
        """

    def learning_rate(self, step: int) -> float | None:
        """Return the learning rate of `step`; None leaves that of the optimiser."""
        return None

    def validate(self, net: nn.Module) -> float | None:
        """Return the validation loss; None if there are no such data."""
        return None


@dataclass(frozen=True, kw_only=True)
class EpochReport:
    """One epoch of a run."""

    epoch: int
    step: int
    seconds: float
    """Training time so far [s]."""
    train_loss: float
    """Mean over the steps of the epoch."""
    validation_loss: float | None


@dataclass
class Progress:
    """State of a run, besides the weights and the optimiser."""

    step: int = 0
    seconds: float = 0.0
    history: list[EpochReport] = field(default_factory=list)
    epoch_losses: list[float] = field(default_factory=list)
    best_step: int = 0
    """The step whose averaged weights validated best."""
    best_loss: float = math.inf
    best: dict[str, torch.Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Fitted:
    """Result of a run."""

    net: nn.Module
    """With the best averaged weights, ready to estimate."""
    run: Progress

    def facts(self) -> dict[str, Any]:
        """Return the facts that a report states of every run, as plain values.

        They include the versions on which its numbers depend.
        """
        return {
            "steps": self.run.step,
            "best_step": self.run.best_step,
            "seconds": round(self.run.seconds, 3),
            "history": [asdict(report) for report in self.run.history],
            "parameters": sum(parameter.numel() for parameter in self.net.parameters()),
            "versions": {"stickslip-training": __version__, "python": platform.python_version()}
            | {library.__name__: str(library.__version__) for library in (torch, np, scipy)},
        }


class RunOptions(TypedDict, total=False):
    """Options of a run that do not change its result."""

    out: Path | None
    """Directory of the checkpoint; None writes none."""
    resume: bool
    """Continue from the checkpoint in `out`."""
    on_epoch: Callable[[EpochReport], None] | None
    """Called with the report of every epoch."""


def fit(
    learner: Learner,
    settings: FitSettings,
    *,
    out: Path | None = None,
    identity: Mapping[str, Any] | None = None,
    resume: bool = False,
    on_epoch: Callable[[EpochReport], None] | None = None,
) -> Fitted:
    """Train the network of `learner`.

    A checkpoint is kept below `out`, if that is given. With `resume` the run goes on from it;
    `identity` and the settings but for the length, threads and device must be those of the run that
    is resumed, or ValueError is raised.
    """
    with torch_threads(settings.threads), torch.random.fork_rng():
        return _Run(learner, settings, out, dict(identity or {}), on_epoch).go(resume)


@dataclass
class _Run:
    learner: Learner
    settings: FitSettings
    out: Path | None
    identity: dict[str, Any]
    on_epoch: Callable[[EpochReport], None] | None

    def __post_init__(self) -> None:
        names = ("epoch", "seed", "averaging", "clip")
        self.identity |= {name: getattr(self.settings, name) for name in names}
        self.net = self.learner.net.to(
            self.settings.device
        )  # the learner sees it move, and puts its batches there
        self.averaged = copy.deepcopy(self.net).eval()
        self.optimizer = self.learner.optimizer(self.net.parameters())
        self.state = Progress()

    def go(self, resume: bool) -> Fitted:
        if resume:
            self._restore()
        state = self.state
        checkpointed = state.seconds
        started = time.perf_counter() - state.seconds
        while state.step < self.settings.steps:
            self._step()
            state.seconds = time.perf_counter() - started
            if state.step % self.settings.epoch == 0:
                self._end_epoch()
            if state.seconds - checkpointed > _CHECKPOINT_SECONDS:
                self._checkpoint()
                checkpointed = state.seconds
        self._checkpoint()
        if state.epoch_losses:
            # The steps ended in the middle of an epoch. That is news for this run's report and
            # model, and not for the checkpoint: a run that goes on from it will end the epoch.
            self._end_epoch()
        self.averaged.load_state_dict(state.best)
        return Fitted(self.averaged.eval(), state)

    def _step(self) -> None:
        state = self.state
        torch.manual_seed(seed_of_step(self.settings.seed, state.step))
        rate = self.learner.learning_rate(state.step)
        if rate is not None:
            for group in self.optimizer.param_groups:
                group["lr"] = rate
        self.net.train()
        loss = self.learner.loss(self.net, state.step)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        if self.settings.clip is not None:
            nn.utils.clip_grad_norm_(self.net.parameters(), self.settings.clip)
        self.optimizer.step()
        self._average()
        state.epoch_losses.append(loss.item())
        state.step += 1

    def _average(self) -> None:
        """Move the average towards the weights.

        Faster at first, so that it forgets the first weights.
        """
        step = self.state.step
        share = 1.0 - min(self.settings.averaging, (1 + step) / (10 + step))
        with torch.no_grad():
            for mean, weight in zip(self.averaged.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(weight, share)
            for held, value in zip(self.averaged.buffers(), self.net.buffers(), strict=True):
                held.copy_(value)

    def _end_epoch(self) -> None:
        """Validate, keep the weights if they are the best so far, and report.

        Without a validation the last weights are the best.
        """
        state = self.state
        validation = self.learner.validate(self.averaged.eval())
        report = EpochReport(
            epoch=-(-state.step // self.settings.epoch),
            step=state.step,
            seconds=round(state.seconds, 3),
            train_loss=float(np.mean(state.epoch_losses)),
            validation_loss=validation,
        )
        state.history.append(report)
        state.epoch_losses = []
        if validation is None or validation < state.best_loss:
            state.best_loss = math.inf if validation is None else validation
            state.best_step = state.step
            state.best = {
                name: tensor.detach().cpu().clone()
                for name, tensor in self.averaged.state_dict().items()
            }
        if self.on_epoch is not None:
            self.on_epoch(report)

    # --- checkpoints
    # ------------------------------------------------------------------------------------------

    def _checkpoint(self) -> None:
        if self.out is None:
            return
        content = {
            "identity": self.identity,
            "net": self.net.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "state": {
                **vars(self.state),
                "history": [asdict(report) for report in self.state.history],
            },
        }
        save_tensors(self.out / CHECKPOINT_NAME, content)

    def _restore(self) -> None:
        path = None if self.out is None else self.out / CHECKPOINT_NAME
        if path is None or not path.exists():
            raise ValueError(f"there is nothing to resume: {path} does not exist")
        content = load_tensors(path, device=self.settings.device)
        for name, value in self.identity.items():
            if (stored := content["identity"].get(name)) != value:
                raise ValueError(
                    f"{name} must be that of the run that is resumed, {stored}, and is {value}"
                )
        self.net.load_state_dict(content["net"])
        self.averaged.load_state_dict(content["averaged"])
        self.optimizer.load_state_dict(content["optimizer"])
        for name, value in content["state"].items():
            setattr(self.state, name, value)
        self.state.history = [EpochReport(**report) for report in content["state"]["history"]]
        self.state.best = {name: tensor.cpu() for name, tensor in self.state.best.items()}


# --- files
# --------------------------------------------------------------------------------------------------


def save_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_durably(path, buffer.getvalue())


def load_tensors(path: str | Path, *, device: str = "cpu") -> dict[str, Any]:
    """Return the content of a file of `save_tensors`; only tensors and plain values are loaded."""
    content: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    return content


def write_report(out: Path, report: Mapping[str, Any]) -> None:
    """Write `report.json` below `out`, whole or not at all.

    A number that is none raises ValueError.
    """
    write_durably(
        out / "report.json", f"{json.dumps(report, indent=2, allow_nan=False)}\n".encode()
    )


# --- for learners
# ---------------------------------------------------------------------------------------------


def seed_of_step(*numbers: int) -> int:
    """Return a seed for torch that depends on all `numbers`."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Let torch draw from `seed` within the block, and restore its state after it."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cosine_rate(highest: float, step: int, steps: int, warm_up: int) -> float:
    """Return a learning rate that rises for `warm_up` steps, and falls to nothing at `steps`.

    It falls like half a cosine.
    """
    return highest * min(1.0, (step + 1) / warm_up) * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def check_device(name: str) -> None:
    """Raise ValueError if torch cannot compute on the device `name`."""
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(
            f"device must be one that torch can use here, and is {name}: "
            f"{str(error).splitlines()[0]}"
        ) from None


def check_positive(settings: object, *names: str) -> None:
    """Raise ValueError if one of the attributes is not more than 0 and finite; None passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not (0 < value < math.inf):
            raise ValueError(f"{name} must be more than 0 and finite, and is {value}")
