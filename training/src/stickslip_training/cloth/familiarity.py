"""Whether a clip is like those that a network was trained on, or shows what it cannot know: a new fabric, a new scene.

With f the network's last features, f_m their mean over training clips of material m, and S their covariance about it,

    d^2 = min_m (f - f_m)^T S^-1 (f - f_m)                          [Lee et al. 2018, Eq. 2]

A clip is unfamiliar where d exceeds that of all but 5 % of the validation clips.
"""

from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Array, Floats, Integers

ALARMS = 0.05
"""Share of the validation clips that are called unfamiliar."""

_SHRUNK = 0.05  # of the covariance's mean eigenvalue is added: a few hundred clips do not fill every direction


@dataclass(frozen=True, eq=False)
class Familiarity:
    """Where the features of training clips lie."""

    means: Floats
    """(materials, features): NaN where a material was not trained on."""
    precision: Floats
    """(features, features): S^-1."""
    limit: float
    """Of the distance d."""

    @staticmethod
    def of(training: Array, material: Integers, validation: Array, materials: int) -> "Familiarity":
        """Fit to features of training clips (clips, features), and set the limit by those of validation clips."""
        features = np.asarray(training, dtype=np.float64)
        means = np.full((materials, features.shape[1]), np.nan)
        for code in np.unique(material):
            means[code] = features[material == code].mean(axis=0)
        apart = features - means[material]
        covariance = apart.T @ apart / len(apart)
        covariance += _SHRUNK * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
        found = Familiarity(means, np.linalg.inv(covariance), np.inf)
        return Familiarity(means, found.precision, float(np.quantile(found.distance(validation), 1.0 - ALARMS)))

    def distance(self, features: Array) -> Floats:
        """Return d of features, (clips,)."""
        apart = np.asarray(features, dtype=np.float64)[:, None] - self.means[~np.isnan(self.means[:, 0])]
        return np.asarray(np.sqrt(np.einsum("cmi,ij,cmj->cm", apart, self.precision, apart).min(axis=1)))
