import numpy as np
import pytest
from stickslip_training.cloth.calibration import ALARMS, TrainingFeatures


def test_distance_is_that_of_mahalanobis_to_the_nearest_material():
    generator = np.random.default_rng(0)
    spread = np.array([[1.5, 0.0], [0.4, 1.0]])
    material = np.arange(4000) % 2
    centers = np.array([[0.0, 0.0], [9.0, -3.0]])
    features = centers[material] + generator.normal(size=(4000, 2)) @ spread.T
    known = TrainingFeatures.of(features, material, features[:400], 3)
    point = np.array([10.0, 1.0])
    exact = min(np.sqrt((point - c) @ np.linalg.inv(spread @ spread.T) @ (point - c)) for c in centers)
    assert known.ood_score(point[None])[0] * known.limit == pytest.approx(
        exact, rel=0.1
    )  # the covariance is shrunk a little
    assert np.isnan(known.means[2]).all()


def test_few_known_clips_and_nearly_all_others_have_an_ood_score_above_1():
    generator = np.random.default_rng(1)
    features = generator.normal(size=(900, 5))
    known = TrainingFeatures.of(features[:500], np.zeros(500, dtype=int), features[500:700], 1)
    assert (known.ood_score(features[700:]) > 1).mean() == pytest.approx(ALARMS, abs=0.05)
    assert (known.ood_score(features[700:] + 6.0) > 1).all()
