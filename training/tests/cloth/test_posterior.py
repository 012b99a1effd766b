import numpy as np
import pytest
from stickslip_training.cloth.posterior import Bins, Posterior, estimates

BINS = Bins(0.0, 1.6, 64)


def normal(center, deviation):
    weight = np.exp(-0.5 * ((BINS.centers - np.asarray(center)[:, None]) / deviation) ** 2)
    return weight / weight.sum(axis=1, keepdims=True)


def test_median_and_interval_of_a_normal_distribution():
    estimated = estimates(normal([0.5, 0.803], 0.1), BINS)
    assert estimated.median == pytest.approx([0.5, 0.803], abs=2e-3)
    assert estimated.high - estimated.low == pytest.approx(2 * 1.2816 * 0.1, abs=6e-3)
    assert (estimated.low + estimated.high) / 2 == pytest.approx(
        [0.5, 0.803], abs=BINS.edges[1] / 2
    )


def test_the_interval_is_the_shortest_and_not_the_central_one():
    weight = np.exp(-BINS.centers / 0.2)[None]
    estimated = estimates(weight / weight.sum(), BINS)
    assert estimated.low[0] == 0.0
    assert estimated.high[0] == pytest.approx(0.2 * np.log(5), abs=0.01)


def test_two_branches_are_not_averaged():
    both = 0.9 * normal([0.1], 0.02) + 0.1 * normal([1.3], 0.02)
    estimated = estimates(both, BINS)
    assert estimated.median[0] == pytest.approx(0.1, abs=0.02)
    assert estimated.high[0] < 0.2


def test_the_share_is_that_asked_for():
    generator = np.random.default_rng(0)
    histogram = generator.dirichlet(np.full(64, 0.3), size=50)
    for share in (0.5, 0.8):
        estimated = estimates(histogram, BINS, share)
        cumulated = np.concatenate([np.zeros((50, 1)), histogram.cumsum(axis=1)], axis=1)
        held = [
            np.interp(b, BINS.edges, c) - np.interp(a, BINS.edges, c)
            for a, b, c in zip(estimated.low, estimated.high, cumulated, strict=True)
        ]
        assert min(held) >= share - 1e-9
        assert np.mean(held) < share + 0.03


def test_the_joint_histogram_has_material_mu_and_the_likelihood_of_both():
    joint = np.zeros((2, 2, 64))
    joint[:, 0], joint[:, 1] = 0.25 * normal([0.3], 0.05), 0.75 * normal([0.6], 0.05)
    posterior = Posterior(("denim", "interlock"), BINS, joint)
    assert posterior.material == pytest.approx(np.array([[0.25, 0.75]] * 2))
    assert posterior.mu.sum(axis=1) == pytest.approx([1.0, 1.0])
    densities = np.exp(posterior.log_likelihood(np.array([0, 1]), np.array([0.3, 0.6])))
    assert densities[1] / densities[0] == pytest.approx(3.0, rel=1e-3)
    assert densities[1] == pytest.approx(0.75 / (0.05 * np.sqrt(2 * np.pi)), rel=0.05)
