"""Material and friction of dragged cloth from clips: answers are what `stickslip-train cloth predict --json` prints."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from stickslip_training.arrays import Array, Integers
from stickslip_training.benchmark.task import Task
from stickslip_training.cloth.clips import truth_of_slots
from stickslip_training.cloth.crop import grey
from stickslip_training.cloth.evaluation import BANDS, score_predictions
from stickslip_training.data.reader import DatasetReader

_LOOKS = ("texture", "viewpoint", "lighting")
_SHOWN = 3  # frames of a clip that are compared
_BLOCK = 14  # pixels along a side of an averaged block


class ClothTask(Task):
    """Friction and material of every clip."""

    columns = (
        "mean error of mu",
        "interval score",
        "< 0.1 / < 0.2",
        "material",
        "in 80 % sets",
        *(f"mu {low:g} to {high:g}" for low, high in BANDS),
    )
    tolerances = {"frames": 1.5}  # noqa: RUF012  # levels of 255, of means over 14 x 14 pixels

    def labels(self, reader: DatasetReader, slots: Integers) -> list[dict[str, Any]]:
        codes = {name: (reader.categories(name), reader.label(name)[slots]) for name in ("material", *_LOOKS)}
        mu = reader.label("mu")[slots].tolist()
        return [
            {"slot": slot, "mu": mu[place], **{name: names[code[place]] for name, (names, code) in codes.items()}}
            for place, slot in enumerate(slots.tolist())
        ]

    def seen(self, reader: DatasetReader, slots: Integers) -> dict[str, Array]:
        shown = np.linspace(0, reader.arrays["video"].shape[0] - 1, _SHOWN + 2).round().astype(int)[1:-1]
        means = [
            torch.nn.functional.avg_pool2d(grey(torch.from_numpy(reader.read("video", [slot])[0][shown])), _BLOCK)
            for slot in slots.tolist()
        ]
        return {"frames": (255 * torch.stack(means)).round().to(torch.uint8).numpy()}

    def inputs(self, reader: DatasetReader, slots: Integers, secret: bytes) -> dict[str, Array]:
        raise ValueError("a method is given the clips themselves: read the array video of the dataset")

    def score(self, reader: DatasetReader, slots: Integers, answers: Sequence[Any]) -> dict[str, Any]:
        return score_predictions(
            answers, reader.categories("material"), slots.tolist(), truth_of_slots(reader, slots)
        ).as_dict()

    def row(self, scores: Mapping[str, Any]) -> tuple[str, ...]:
        blind, bands = scores["blind"], scores["bands"]

        def error(part: Mapping[str, Any]) -> str:
            return f"{part['mae']['value']:.3f}"

        return (
            f"{error(blind)} ({blind['mae']['low']:.3f} to {blind['mae']['high']:.3f})",
            f"{blind['interval']['value']:.3f}" if "interval" in blind else "",
            f"{blind['within_01']['value']:.0%} / {blind['within_02']['value']:.0%}",
            f"{scores['top_1']['value']:.0%}",
            f"{blind['coverage']['value']:.0%}",
            *(error(bands[name]) if name in bands else "" for name in (f"{low:g} to {high:g}" for low, high in BANDS)),
        )

    def rank(self, scores: Mapping[str, Any]) -> float:
        return float(scores["blind"]["mae"]["value"])
