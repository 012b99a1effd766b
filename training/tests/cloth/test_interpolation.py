import numpy as np
import pytest
from stickslip_training.cloth.evaluation import score
from stickslip_training.cloth.interpolation import Curves, Observation, oracle, silhouette_fit
from stickslip_training.cloth.posterior import estimates
from stickslip_training.cloth.runs import Runs, split_runs
from stickslip_training.cloth.training import render_clips, training_cameras

RIG = training_cameras()


def made(mu, material, landed=None):
    count = len(mu)
    landed = np.ones(count, int) if landed is None else np.asarray(landed)
    meshes, fabric = np.zeros((count, 1, 2, 2, 3), np.float32), np.full((count, 3), np.nan)
    return Runs(meshes, (0,), ("a", "b"), np.asarray(material), np.asarray(mu), landed, fabric)


def test_a_curve_is_followed_between_known_runs_and_not_beyond():
    mu = np.array([0.2, 0.5, 0.8, 1.4])
    features = np.stack([mu, mu**2], axis=1)
    curves = Curves.through(features, made(mu, [0, 0, 0, 0]))
    known = np.isfinite(curves.features[0, 1, :, 0])
    centers = curves.bins.centers
    assert known.tolist() == ((centers >= 0.2) & (centers <= 0.8)).tolist()  # 0.8 and 1.4 are too far apart
    found = estimates(curves.posterior(np.array([[0.65, 0.445]]), 1e-4).mu, curves.bins)
    assert found.median[0] == pytest.approx(0.65, abs=0.02)


def test_two_fabrics_that_look_alike_share_the_probability():
    mu = np.array([0.2, 0.5, 0.8] * 2)
    features = np.stack([mu, np.repeat([0.0, 0.01], 3)], axis=1)
    posterior = Curves.through(features, made(mu, [0] * 3 + [1] * 3)).posterior(np.array([[0.4, 0.0]]), 1e-2)
    assert posterior.material[0] == pytest.approx([0.5, 0.5], abs=0.01)
    clear = Curves.through(features, made(mu, [0] * 3 + [1] * 3)).posterior(np.array([[0.4, 0.0]]), 1e-6)
    assert clear.material[0, 0] > 0.99


def test_the_variance_is_fitted_to_what_is_known():
    mu = np.linspace(0, 1.6, 17)
    curves = Curves.through(mu[:, None], made(mu, [0] * 17))
    generator = np.random.default_rng(0)
    truth = generator.uniform(0.3, 1.3, 400)
    seen = (truth + generator.normal(0, 0.1, 400))[:, None]
    assert curves.fitted_variance(seen, np.zeros(400, int), truth) == pytest.approx(0.01, rel=0.5)


def test_the_oracle_finds_friction_and_registration_mends_a_camera_that_is_off(runs):
    """Over eight splits, for a split has six or so test simulations of 0.4 to 1.4."""

    def mae(**seen):
        off = []
        for seed in range(8):
            train, validation, test = split_runs(runs, (0.12, 0.25), seed)
            middle = test[(test.mu > 0.4) & (test.mu < 1.4)]
            posterior = oracle(Runs.joined(train, validation), middle, RIG[0], Observation(**seen), seed)
            off.append(np.abs(estimates(posterior.mu, posterior.bins).median - middle.mu))
        return np.concatenate(off).mean()

    assert mae(registered=False) <= 0.03
    registered = mae(shift=1.0, scale=0.004)
    assert registered <= 0.05
    assert mae(shift=1.0, scale=0.004, registered=False) > 2 * registered


def test_silhouettes_tell_something_without_learning(runs):
    train, validation, test = split_runs(runs, (0.12, 0.25), 0)
    tuned, clips = render_clips(validation, 3, 5), render_clips(test, 3, 6)
    found = score(silhouette_fit(train, tuned, clips, RIG), clips.truth())
    blind = np.abs(np.median(train.mu) - clips.mu).mean()
    assert found.blind.mae.value < 0.75 * blind
    assert found.blind.coverage.value > 0.5
