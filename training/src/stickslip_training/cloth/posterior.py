"""The posterior of material and friction of a clip, a joint histogram, and estimates from it.

    p(m, mu) = p(m) p(mu | m)

Its marginal and its conditional are the thesis's two models: mu of an unknown and of a known
material. A histogram may have two branches, so the estimate of mu is the median of the marginal,
with the shortest interval that holds 80 %.
"""

from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Floats, Integers, SingleFloats

SHARE = 0.8
"""Of the probability that an interval holds."""

_FINE = 8  # steps within a bin: a histogram is constant there


@dataclass(frozen=True)
class Bins:
    """Equal bins of a quantity."""

    low: float
    high: float
    count: int

    @property
    def edges(self) -> Floats:
        """(count + 1,)"""
        return np.linspace(self.low, self.high, self.count + 1)

    @property
    def centers(self) -> Floats:
        return (self.edges[:-1] + self.edges[1:]) / 2

    def place(self, values: Floats) -> Integers:
        """Return the bin of each value, (n,); the first or the last one beyond the ends."""
        places = ((values - self.low) / (self.edges[1] - self.low)).astype(np.int64)
        return np.asarray(np.clip(places, 0, self.count - 1))


MU_BINS = Bins(0.0, 1.6, 64)


@dataclass(frozen=True)
class Estimates:
    """One number for each clip, and how far from it the truth may be."""

    median: Floats
    low: Floats
    high: Floats
    """(clips,) each: `low` to `high` is the shortest interval that holds the share of the
    probability asked for.
    """


@dataclass(frozen=True)
class Posterior:
    """The histograms of some clips."""

    materials: tuple[str, ...]
    bins: Bins
    joint: Floats
    """(clips, materials, bins), each clip's adds up to 1."""

    def __len__(self) -> int:
        return len(self.joint)

    @property
    def material(self) -> Floats:
        """Probabilities of the materials, (clips, materials)."""
        return np.asarray(self.joint.sum(axis=2))

    @property
    def mu(self) -> Floats:
        """Histogram of mu whatever the material, (clips, bins)."""
        return np.asarray(self.joint.sum(axis=1))

    def log_likelihood(self, material: Integers, mu: Floats) -> Floats:
        """Return log p(m, mu) of the truth, (clips,), with mu a density."""
        density = self.joint[np.arange(len(self)), material, self.bins.place(mu)] / (
            self.bins.edges[1] - self.bins.low
        )
        return np.asarray(np.log(density + 1e-12))

    @staticmethod
    def of(
        log_material: SingleFloats,
        log_mu: SingleFloats,
        materials: tuple[str, ...],
        bins: Bins,
        temperature: tuple[float, float],
    ) -> "Posterior":
        """Return the histograms at these temperatures.

        They are of log p(m), (clips, M), and of log p(mu | m), (clips, M, K).
        """
        p_material = softmax(log_material / temperature[0])
        p_mu = softmax(log_mu / temperature[1])
        return Posterior(materials, bins, p_material[..., None] * p_mu)


def softmax(logits: SingleFloats) -> Floats:
    """Return exp(logits) over its sum along the last axis, in double precision."""
    shifted = np.exp((logits - logits.max(axis=-1, keepdims=True)).astype(np.float64))
    return np.asarray(shifted / shifted.sum(axis=-1, keepdims=True))


def estimates(histogram: Floats, bins: Bins, share: float = SHARE) -> Estimates:
    """Return median and shortest interval of histograms (clips, bins)."""
    edges = np.linspace(bins.low, bins.high, _FINE * bins.count + 1)
    cumulated = np.zeros((len(histogram), len(edges)))
    np.cumsum(np.repeat(histogram / _FINE, _FINE, axis=1), axis=1, out=cumulated[:, 1:])
    cumulated /= cumulated[:, -1:]
    median, low, high = (np.empty(len(histogram)) for _ in range(3))
    for clip, c in enumerate(cumulated):
        median[clip] = np.interp(0.5, c, edges)
        ends = np.searchsorted(c, c + share - 1e-12)
        starts = np.flatnonzero(ends < len(edges))
        first = starts[np.argmin(edges[ends[starts]] - edges[starts])]
        low[clip] = edges[first]
        high[clip] = edges[ends[first]]
    return Estimates(median, low, high)
