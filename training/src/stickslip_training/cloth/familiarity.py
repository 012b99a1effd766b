"""Whether a clip has an answer: the distance of its silhouettes from the training's.

The network sees a silhouette in every frame, pooled to 4 x 4 pixels. The six of a clip are one
point, x. With d the mean distance of x from the `NEAREST` clips of dragged cloth that were trained
on, and b that from the `NEAREST` clips without an answer (cloth that hangs free, is glued down, is
of another size, or moves out of phase), the oddness of x is

    s = d^3 / b

and its familiarity is the share of good validation clips, as they are and with other exposures and
places, that are at least as odd. A clip of a familiarity below `ALARMS` has no answer. Distances
are along the principal components of the known silhouettes [Pearson 1901].
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.distance import cdist

from stickslip_training.arrays import Array, Floats, Integers, SingleFloats
from stickslip_training.cloth.clips import INSTANTS, frames_at, render_clips
from stickslip_training.cloth.crop import holder_path
from stickslip_training.cloth.runs import Runs

ALARMS = 0.05
"""Share of good validation clips without an answer."""

NEAREST = 4
"""Clips whose distances are averaged: one clip may be near by chance."""

COMPONENTS = 64
"""Principal components of six silhouettes that are kept: 0.99 of the variance."""

POOLED = 4
"""Pixels of a crop along a side of a pixel of a silhouette."""

UNKNOWN = "looks like no square of cloth that was trained on"

_LYING = 0.004  # height below which cloth counts as on the floor [m]


def pooled(cover: torch.Tensor) -> torch.Tensor:
    """Return coverage (clips, F, 72, 88) as silhouettes (clips, F, 18, 22)."""
    return torch.nn.functional.avg_pool2d(cover, POOLED).clamp(0.0, 1.0)


def holders_at(instants: tuple[float, ...]) -> SingleFloats:
    """Return the middle of the holders, (F, 1, 1, 3) [m]."""
    x, z = holder_path(instants)
    return np.stack([x, np.zeros_like(x), z], axis=-1, dtype=np.float32)[:, None, None]


def hanging(meshes: SingleFloats, held: SingleFloats) -> SingleFloats:
    """Return cloth that hangs straight down.

    Meshes are (runs, F, side, side, 3) [m], `held` as of `holders_at`.
    """
    side = meshes.shape[2]
    flat = np.zeros((side, side, 3), dtype=np.float32)
    flat[..., 1] = np.linspace(-0.1, 0.1, side)
    flat[..., 2] = np.linspace(-0.2, 0.0, side)[:, None]
    return np.broadcast_to(held + flat, meshes.shape).copy()


def glued(meshes: SingleFloats, held: SingleFloats) -> SingleFloats:
    """Return cloth that sticks to the floor with the part that first lies on it."""
    first = meshes[:, :1]
    return np.where(first[..., 2:] < _LYING, first, meshes)


def sized(meshes: SingleFloats, held: SingleFloats, factor: float) -> SingleFloats:
    """Return cloth of another size, on a floor as high."""
    other = held + np.float32(factor) * (meshes - held)
    other[..., 2] = np.maximum(other[..., 2], 1e-3)
    return np.asarray(other)


def reordered(meshes: SingleFloats, held: SingleFloats, frames: list[int]) -> SingleFloats:
    """Return the shapes of other frames at the holders."""
    return meshes[:, frames] - held[frames] + held


WITHOUT_ANSWER = (
    ("never touches the floor", hanging),
    ("does not slide", glued),
    ("is not a square of 20 cm", partial(sized, factor=0.8)),
    ("is not a square of 20 cm", partial(sized, factor=1.25)),
    ("moves out of phase", partial(reordered, frames=[2, 3, 0, 1, 2, 3])),
    ("moves out of phase", partial(reordered, frames=[5, 4, 3, 2, 1, 0])),
)
"""Sorts of clips that hold no answer: the reason, and how they are made from runs."""


@dataclass(frozen=True, eq=False)
class Familiarity:
    """Silhouettes that are known, and how odd good clips are."""

    mean: SingleFloats
    """(pixels,): of all known clips."""
    components: Array
    """(COMPONENTS, pixels)"""
    known: Array
    """(clips, COMPONENTS)"""
    sort: Integers
    """(clips,): 0 for dragged cloth, or the place in `WITHOUT_ANSWER` from 1 on."""
    good_oddness: Floats
    """(validation clips,): ascending."""

    @staticmethod
    def of(train: Runs, seed: int, good: SingleFloats, device: str = "cpu") -> "Familiarity":
        """Render the known clips from runs.

        `good` are silhouettes that a network sees in good validation clips.
        """
        runs = replace(
            train, positions=train.positions[:, frames_at(train.instants)[0]], instants=INSTANTS
        )
        held = holders_at(INSTANTS)
        sorts = [
            runs,
            *(
                replace(runs, positions=placed(runs.positions, held))
                for _, placed in WITHOUT_ANSWER
            ),
        ]
        silhouettes = [
            render_clips(
                group, 1 if place else 4, seed + place, with_surroundings=True, device=device
            ).cover
            for place, group in enumerate(sorts)
        ]
        pixels = pooled(torch.cat(silhouettes)).flatten(1).numpy()
        mean = pixels.mean(axis=0)
        components = np.linalg.svd(pixels - mean, full_matrices=False)[2][:COMPONENTS]
        sort = np.repeat(np.arange(len(sorts)), [len(each) for each in silhouettes])
        known = ((pixels - mean) @ components.T).astype(np.float16)
        familiarity = Familiarity(mean, components.astype(np.float16), known, sort, np.zeros(1))
        return replace(familiarity, good_oddness=np.sort(familiarity.measure(good)[0]))

    def measure(self, silhouettes: SingleFloats) -> tuple[Floats, Integers]:
        """Return the oddness of silhouettes (clips, F, 18, 22), and the sort of the nearest clip.

        The nearest clip is one of the known clips.
        """
        coordinates = (silhouettes.reshape(len(silhouettes), -1) - self.mean) @ self.components.T
        far = cdist(coordinates, self.known)
        parts = (far[:, chosen] for chosen in (self.sort == 0, self.sort > 0))
        good, bad = (np.partition(part, NEAREST - 1)[:, :NEAREST].mean(axis=1) for part in parts)
        return good**3 / np.maximum(bad, 1e-9), self.sort[far.argmin(axis=1)]

    def judge(self, silhouettes: SingleFloats) -> tuple[Floats, list[str | None]]:
        """Return the familiarity of silhouettes (clips, F, 18, 22), and the reason of a refusal.

        The reason is None if the clip has an answer.
        """
        odd, sort = self.measure(silhouettes)
        share = 1.0 - np.searchsorted(self.good_oddness, odd) / len(self.good_oddness)
        reasons = [WITHOUT_ANSWER[place - 1][0] if place else UNKNOWN for place in sort.tolist()]
        return share, [
            reason if low else None for reason, low in zip(reasons, share < ALARMS, strict=True)
        ]
