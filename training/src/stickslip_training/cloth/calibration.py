"""Calibration of a trained network: temperatures of its histograms, and the limit of its OOD score.

A temperature T widens a histogram [Guo et al. 2017]:

    p_T ~ p^(1/T)

With f the network's last features, f_m their mean over the training clips of material m, and S their covariance about
it, the Mahalanobis distance of a clip from the training clips is

    d^2 = min_m (f - f_m)^T S^-1 (f - f_m)                          [Lee et al. 2018, Eq. 2]

and its out-of-distribution (OOD) score is d over the 95 % quantile of d over the validation clips. A clip with a score
above 1 is unlike the training clips: a new fabric, or a new scene.
"""

from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Array, Floats, Integers, SingleFloats
from stickslip_training.cloth.posterior import SHARE, Bins, Posterior, estimates, softmax

ALARMS = 0.05
"""Share of the validation clips with an OOD score above 1."""

_SHRUNK = 0.05  # of the covariance's mean eigenvalue is added: a few hundred clips do not fill every direction


def likeliest_temperature(log_p: SingleFloats, place: Integers) -> float:
    """Return the temperature of histograms (clips, bins) at which the true bins `place` (clips,) are likeliest."""
    tried = np.geomspace(0.4, 4.0, 47)
    rows = np.arange(len(place))
    losses = [float(-np.log(softmax(log_p / t)[rows, place] + 1e-12).mean()) for t in tried]
    return float(tried[int(np.argmin(losses))])


def likeliest_temperatures(
    material: SingleFloats, mu: SingleFloats, true_material: Integers, true_mu: Floats, bins: Bins
) -> tuple[float, float]:
    """Return the temperatures of log p(m), (clips, M), and log p(mu | m), (clips, M, K), at which the truth is the most
    likely."""
    given = mu[np.arange(len(true_mu)), true_material]
    return likeliest_temperature(material, true_material), likeliest_temperature(given, bins.place(true_mu))


def covering_temperature(
    material: SingleFloats, mu: SingleFloats, true_mu: Floats, bins: Bins, of_material: float, share: float = SHARE
) -> float:
    """Return the temperature of mu at which the intervals that should hold `share` of the truths hold that share.

    A few large errors raise the likeliest temperature, which then widens all intervals; they hardly change this one.
    """
    tried = np.geomspace(0.4, 6.0, 55)

    def held(temperature: float) -> float:
        found = estimates(Posterior.of(material, mu, (), bins, (of_material, temperature)).mu, bins, share)
        return float(((found.low <= true_mu) & (true_mu <= found.high)).mean())

    return float(tried[int(np.argmin([abs(held(each) - share) for each in tried]))])


@dataclass(frozen=True, eq=False)
class TrainingFeatures:
    """The distribution of the features of training clips."""

    means: Floats
    """(materials, features): NaN where a material was not trained on."""
    precision: Floats
    """(features, features): S^-1."""
    limit: float
    """The distance d with an OOD score of 1."""

    @staticmethod
    def of(training: Array, material: Integers, validation: Array, materials: int) -> "TrainingFeatures":
        """Fit to features of training clips (clips, features), and set the limit by those of validation clips."""
        features = np.asarray(training, dtype=np.float64)
        means = np.full((materials, features.shape[1]), np.nan)
        for code in np.unique(material):
            means[code] = features[material == code].mean(axis=0)
        apart = features - means[material]
        covariance = apart.T @ apart / len(apart)
        covariance += _SHRUNK * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
        precision = np.linalg.inv(covariance)
        limit = np.quantile(TrainingFeatures(means, precision, 1.0).ood_score(validation), 1.0 - ALARMS)
        return TrainingFeatures(means, precision, float(limit))

    def ood_score(self, features: Array) -> Floats:
        """Return the OOD score of features (clips, features), (clips,)."""
        apart = np.asarray(features, dtype=np.float64)[:, None] - self.means[~np.isnan(self.means[:, 0])]
        return np.asarray(np.sqrt(np.einsum("cmi,ij,cmj->cm", apart, self.precision, apart).min(axis=1))) / self.limit
