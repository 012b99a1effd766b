"""Tasks of test sets, one for each kind of dataset: questions, and scoring of answers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from stickslip_schemas.base import sha256

from stickslip_training.arrays import Array, Floats, Integers
from stickslip_training.cloth.clips import truth_of_slots
from stickslip_training.cloth.crop import grey
from stickslip_training.cloth.evaluation import BANDS, score_predictions
from stickslip_training.data.reader import DatasetReader
from stickslip_training.rods.evaluation import bending, relative_rms_error, with_white_noise

NOISES = (0.001, 0.005, 0.01)
"""Standard deviation of every coordinate of a centreline, over L."""

_FRAMES = 3  # frames of a clip that are compared
_BLOCK = 14  # pixels along a side of an averaged block
_EVERY = 15  # points of a rod of which one is compared
_DRAWS = 1000


class Task(ABC):
    """Questions about datasets of one kind."""

    label_names: tuple[str, ...]
    """Labels that follow from the spec, with equal bits in every making of a set."""
    columns: tuple[str, ...]
    """Of the table of results, besides the method and who entered it."""
    tolerances: ClassVar[Mapping[str, float]]
    """Tolerances of the arrays of `control_values` between two makings of one set."""

    def labels(self, reader: DatasetReader, slots: Integers) -> list[dict[str, Any]]:
        """Return the slots and labels of samples as plain values; a category by its name."""
        columns: dict[str, list[Any]] = {"slot": slots.tolist()}
        for label in self.label_names:
            names = reader.categories(label)
            values = reader.label(label)[slots].tolist()
            columns[label] = [names[code] for code in values] if names else values
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    @abstractmethod
    def control_values(self, reader: DatasetReader, slots: Integers) -> dict[str, Array]:
        """Return a small part of the input of a method, and of a computed truth, for slots."""

    @abstractmethod
    def inputs(self, reader: DatasetReader, slots: Integers, secret: bytes) -> dict[str, Array]:
        """Return the input of a method, with noise from a secret.

        Raise ValueError if the input is the dataset itself.
        """

    @abstractmethod
    def score(
        self, reader: DatasetReader, slots: Integers, answers: Sequence[Any]
    ) -> dict[str, Any]:
        """Return the scores of answers as plain values.

        Raise ValueError, which names the answer, if one is none.
        """

    @abstractmethod
    def row(self, scores: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the cells of `columns`."""

    @abstractmethod
    def rank(self, scores: Mapping[str, Any]) -> float:
        """Return a number that is smaller for a better entry."""


class ClothTask(Task):
    """Friction and material of every clip.

    Answers have the form of `stickslip-train cloth predict --json`.
    """

    label_names = ("mu", "material", "texture", "viewpoint", "lighting")
    columns = (
        "mean error of mu",
        "interval score",
        "< 0.1 / < 0.2",
        "material",
        "in 80 % sets",
        *(f"mu {low:g} to {high:g}" for low, high in BANDS),
    )
    tolerances: ClassVar[Mapping[str, float]] = {"frames": 1.5}
    """In levels of 255, of means over 14 x 14 pixels."""

    def control_values(self, reader: DatasetReader, slots: Integers) -> dict[str, Array]:
        # A few frames inside the clip, and means of blocks: small, and equal on all machines.
        last = reader.arrays["video"].shape[0] - 1
        frames = np.linspace(0, last, _FRAMES + 2).round().astype(int)[1:-1]
        means = []
        for slot in slots.tolist():
            pictures = torch.from_numpy(reader.read("video", [slot])[0][frames])
            means.append(torch.nn.functional.avg_pool2d(grey(pictures), _BLOCK))
        return {"frames": (255 * torch.stack(means)).round().to(torch.uint8).numpy()}

    def inputs(self, reader: DatasetReader, slots: Integers, secret: bytes) -> dict[str, Array]:
        raise ValueError(
            "a method is given the clips themselves: read the array video of the dataset"
        )

    def score(
        self, reader: DatasetReader, slots: Integers, answers: Sequence[Any]
    ) -> dict[str, Any]:
        truth = truth_of_slots(reader, slots)
        return asdict(
            score_predictions(answers, reader.categories("material"), slots.tolist(), truth)
        )

    def row(self, scores: Mapping[str, Any]) -> tuple[str, ...]:
        blind = scores["blind"]
        bands = scores["bands"]

        def error(part: Mapping[str, Any]) -> str:
            return f"{part['mae']['value']:.3f}"

        # A band without a clip has an empty cell.
        names = [f"{low:g} to {high:g}" for low, high in BANDS]
        band_cells = [error(bands[name]) if name in bands else "" for name in names]
        return (
            f"{error(blind)} ({blind['mae']['low']:.3f} to {blind['mae']['high']:.3f})",
            f"{blind['interval']['value']:.3f}" if "interval" in blind else "",
            f"{blind['within_01']['value']:.0%} / {blind['within_02']['value']:.0%}",
            f"{scores['top_1']['value']:.0%}",
            f"{blind['coverage']['value']:.0%}",
            *band_cells,
        )

    def rank(self, scores: Mapping[str, Any]) -> float:
        return float(scores["blind"]["mae"]["value"])


class RodTask(Task):
    """Curvature of hanging rods from noisy centrelines, and gamma, weight over stiffness.

    A method is given the centrelines of the split test under white noise of three strengths, drawn
    from a secret. Its answers are a list with

        {"slot": 7, "noise": 0.005, "bending": [...], "gamma": 812.0}

    for every rod and noise. `bending` has 150 numbers, |kappa| L from the clamp on. It is null if a
    method has no answer, which counts as infinitely wrong. `gamma` may be left out.
    """

    label_names = ("gamma", "phi0", "phi1")
    columns = (
        *(f"{100 * noise:g} %: error of \\|κ\\|, median; p95" for noise in NOISES),
        f"error of gamma at {100 * NOISES[1]:g} %, median; p95",
    )
    tolerances: ClassVar[Mapping[str, float]] = {"centerline": 1e-5, "bending": 1e-3}

    def control_values(self, reader: DatasetReader, slots: Integers) -> dict[str, Array]:
        exact = reader.read("centerline", slots)
        return {
            "centerline": exact[:, ::_EVERY],
            "bending": _truth(reader, slots)[:, ::_EVERY].astype(np.float32),
        }

    def inputs(self, reader: DatasetReader, slots: Integers, secret: bytes) -> dict[str, Array]:
        """Return the slots, (n,), the noises, (3,), and the centrelines over L, (3, n, 150, 3).

        The secret keeps a method from drawing the noise again and subtracting it.
        """
        exact = reader.read("centerline", slots)
        seed = int(sha256(secret), 16)
        noisy = [
            with_white_noise(exact, noise, (seed, number)) for number, noise in enumerate(NOISES)
        ]
        lines = np.stack(noisy)
        return {"slot": slots, "noise": np.array(NOISES), "centerline": lines}

    def score(
        self, reader: DatasetReader, slots: Integers, answers: Sequence[Any]
    ) -> dict[str, Any]:
        truth = _truth(reader, slots)
        gamma = reader.label("gamma")[slots]
        estimated, weights = _parsed(answers, slots, truth.shape[1])
        scores = {}
        for number, noise in enumerate(NOISES):
            bending_errors = relative_rms_error(estimated[number], truth)
            gamma_errors = np.abs(weights[number] / gamma - 1.0)
            # gamma is optional: it has no score if a method gives none at all.
            has_gamma = np.isfinite(weights[number]).any()
            scores[f"{noise:g}"] = {
                "rods": len(slots),
                "failed": int(np.isnan(estimated[number, :, 0]).sum()),
                "bending": _quantiles(bending_errors),
                "gamma": _quantiles(gamma_errors) if has_gamma else None,
            }
        return scores

    def row(self, scores: Mapping[str, Any]) -> tuple[str, ...]:
        cells = []
        for noise in NOISES:
            part = scores[f"{noise:g}"]
            failures = f" ({part['failed']} fail)" if part["failed"] else ""
            cells.append(_cell(part["bending"]) + failures)
        gamma = scores[f"{NOISES[1]:g}"]["gamma"]
        return (*cells, "" if gamma is None else _cell(gamma))

    def rank(self, scores: Mapping[str, Any]) -> float:
        median = scores[f"{NOISES[1]:g}"]["bending"]["median"]
        return float("inf") if median is None else float(median["value"])


def _truth(reader: DatasetReader, slots: Integers) -> Floats:
    return bending(reader.read("curvature", slots))


@dataclass(frozen=True)
class _Answer:
    """An answer to one rod at one noise."""

    slot: int
    noise: float
    bending: Floats | None
    """|kappa| L, (points,); None if the method failed."""
    gamma: float | None


def _parsed_answer(number: int, document: Any, points: int) -> _Answer:
    """Return an answer of a file; raise ValueError, with its number in the file, if it is none."""
    try:
        bending = document["bending"]
        gamma = document.get("gamma")
        answer = _Answer(
            slot=int(document["slot"]),
            noise=float(document["noise"]),
            bending=None if bending is None else np.array(bending, dtype=np.float64),
            gamma=None if gamma is None else float(gamma),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"answer {number} must have slot, noise and bending, and may have gamma: "
            f"{type(error).__name__}: {error}"
        ) from None
    values = answer.bending
    if values is not None:
        is_valid = values.shape == (points,) and bool((np.isfinite(values) & (values >= 0)).all())
        if not is_valid:
            raise ValueError(
                f"bending of answer {number} must be {points} finite numbers of 0 or more, or null"
            )
    if answer.gamma is not None and not 0 < answer.gamma < np.inf:
        raise ValueError(
            f"gamma of answer {number} must be more than 0 and finite, and is {answer.gamma}"
        )
    return answer


def _parsed(answers: Sequence[Any], slots: Integers, points: int) -> tuple[Floats, Floats]:
    """Return |kappa| L, (noises, rods, points), and gamma, (noises, rods).

    Values are NaN if a method gives none.
    """
    rows = {int(slot): row for row, slot in enumerate(slots)}
    estimated = np.full((len(NOISES), len(slots), points), np.nan)
    gamma = np.full((len(NOISES), len(slots)), np.nan)
    is_answered = np.zeros(gamma.shape, dtype=bool)
    for number, document in enumerate(answers):
        answer = _parsed_answer(number, document, points)
        if answer.slot not in rows or answer.noise not in NOISES:
            noises = ", ".join(f"{noise:g}" for noise in NOISES)
            raise ValueError(
                f"slot and noise of answer {number} must be of the test set, whose noises are "
                f"{noises}: they are {answer.slot} and {answer.noise:g}"
            )
        index = NOISES.index(answer.noise), rows[answer.slot]
        if is_answered[index]:
            raise ValueError(
                f"slot {answer.slot} is answered twice at noise {answer.noise:g}, "
                f"at {number} for the second time"
            )
        is_answered[index] = True
        if answer.bending is not None:
            estimated[index] = answer.bending
        if answer.gamma is not None:
            gamma[index] = answer.gamma
    # A method must not leave out the rods that it cannot do.
    if not is_answered.all():
        noise, row = np.argwhere(~is_answered)[0]
        raise ValueError(
            "every slot of the test set must be answered at every noise, and "
            f"{(~is_answered).sum()} are not, {slots[row]} at {NOISES[noise]:g} first"
        )
    return estimated, gamma


def _quantiles(errors: Floats) -> dict[str, Any]:
    """Return median and 95 % quantile, each with its 90 % interval over rods.

    None if it is infinite.
    """
    errors = np.where(np.isfinite(errors), errors, np.inf)
    draws = np.random.default_rng(0).integers(len(errors), size=(_DRAWS, len(errors)))
    resampled = errors[draws]
    quantiles: dict[str, Any] = {}
    for name, level in (("median", 0.5), ("p95", 0.95)):
        value = float(np.quantile(errors, level, method="higher"))
        estimates = np.quantile(resampled, level, axis=1, method="higher")
        low, high = np.quantile(estimates, (0.05, 0.95), method="nearest")
        numbers = {"value": value, "low": float(low), "high": float(high)}
        # JSON has no infinity.
        finite = {key: number if np.isfinite(number) else None for key, number in numbers.items()}
        quantiles[name] = finite if np.isfinite(value) else None
    return quantiles


def _cell(quantiles: Mapping[str, Any]) -> str:
    percents = [None if each is None else 100.0 * each["value"] for each in quantiles.values()]
    return "; ".join(
        "-" if p is None else f"{p:,.0f} %" if p >= 9.95 else f"{p:.2g} %" for p in percents
    )
