"""Calibration of a trained network: temperatures of its histograms.

A temperature T widens a histogram [Guo et al. 2017]:

    p_T ~ p^(1/T)
"""

import numpy as np

from stickslip_training.arrays import Floats, Integers, SingleFloats
from stickslip_training.cloth.posterior import SHARE, Bins, Posterior, estimates, softmax


def likeliest_temperatures(
    material: SingleFloats, mu: SingleFloats, true_material: Integers, true_mu: Floats, bins: Bins
) -> tuple[float, float]:
    """Return the temperatures at which the truth is the most likely.

    They belong to log p(m), (clips, M), and log p(mu | m), (clips, M, K).
    """
    rows = np.arange(len(true_mu))
    tried = np.geomspace(0.4, 4.0, 47)

    def likeliest(log_p: SingleFloats, place: Integers) -> float:
        losses = [float(-np.log(softmax(log_p / t)[rows, place] + 1e-12).mean()) for t in tried]
        return float(tried[int(np.argmin(losses))])

    return likeliest(material, true_material), likeliest(
        mu[rows, true_material], bins.place(true_mu)
    )


def covering_temperature(
    material: SingleFloats,
    mu: SingleFloats,
    true_mu: Floats,
    bins: Bins,
    of_material: float,
    share: float = SHARE,
) -> float:
    """Return the temperature of mu at which intervals hold the truth as often as they should.

    `share` is the probability that an interval should hold, and the fraction of the truths that it
    then holds.

    A few large errors raise the likeliest temperature, which then widens all intervals; they hardly
    change this one.
    """
    tried = np.geomspace(0.4, 6.0, 55)

    def held(temperature: float) -> float:
        interval = estimates(
            Posterior.of(material, mu, (), bins, (of_material, temperature)).mu, bins, share
        )
        return float(((interval.low <= true_mu) & (true_mu <= interval.high)).mean())

    return float(tried[int(np.argmin([abs(held(each) - share) for each in tried]))])
