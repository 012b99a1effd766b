import json
from dataclasses import asdict

import numpy as np
import pytest
from stickslip_training.cloth.evaluation import (
    Scores,
    Truth,
    errors,
    measure,
    predictions,
    score_predictions,
)
from stickslip_training.cloth.posterior import Bins, Estimates, Posterior, estimates

BINS = Bins(0.0, 1.6, 64)

ALL_KNOWN = np.ones(3), [None] * 3


def answers(mu, deviation, material, certain=0.9):
    weight = np.exp(-0.5 * ((BINS.centers - np.asarray(mu)[:, None]) / deviation) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    shares = np.where(np.arange(3) == np.asarray(material)[:, None], certain, (1 - certain) / 2)
    return Posterior(("a", "b", "c"), BINS, shares[..., None] * weight[:, None])


def truth(mu, material=None, run=None):
    count = len(mu)
    return Truth(
        material=np.zeros(count, int) if material is None else np.asarray(material),
        mu=np.asarray(mu, dtype=float),
        run=np.arange(count) if run is None else np.asarray(run),
    )


def score(posterior, expected) -> Scores:
    """Score answers as they are printed."""
    slots = range(len(posterior))
    predicted = predictions(posterior, slots, (np.ones(len(posterior)), [None] * len(posterior)))
    return score_predictions(predicted, posterior.materials, slots, expected)


def test_a_neighbour_in_the_grid_of_the_thesis_is_never_below_a_tenth():
    grid = np.linspace(0, 1.5, 16)
    assert (np.abs(np.diff(grid)) < 0.1).any()  # what a plain comparison says
    relative_errors = errors(Estimates(grid[1:], grid[1:], grid[1:]), grid[:-1], np.arange(15))
    assert relative_errors.within_01.value == 0.0
    assert relative_errors.within_02.value == 1.0


def test_scores_of_known_answers():
    mu = np.array([0.2, 0.6, 1.0, 1.4])
    scores = score(answers(mu + np.array([0.0, 0.05, -0.15, 0.0]), 0.06, [0, 0, 1, 2]), truth(mu))
    assert scores.blind.mae.value == pytest.approx(0.05, abs=2e-3)
    assert (scores.blind.within_01.value, scores.blind.within_02.value) == (0.75, 1.0)
    assert scores.blind.coverage.value == 0.75
    assert (scores.top_1.value, scores.top_2.value) == (
        0.5,
        0.5,
    )  # where two materials tie, the true one is behind
    assert set(scores.bands) == {"0 to 0.4", "0.4 to 0.8", "0.8 to 1.2", "1.2 to 1.6"}
    assert scores.bands["0.8 to 1.2"].mae.value == pytest.approx(0.15, abs=2e-3)
    json.dumps(asdict(scores))


def test_calibrated_answers_are_reliable_and_overconfident_ones_are_not():
    generator = np.random.default_rng(2)
    mu = generator.uniform(0.4, 1.2, 1000)
    measured = mu + generator.normal(0, 0.1, 1000)
    good, bold = (answers(measured, deviation, np.zeros(1000, int)) for deviation in (0.1, 0.05))
    assert 0.75 < score(good, truth(mu)).blind.coverage.value < 0.85
    assert score(bold, truth(mu)).blind.coverage.value < 0.55
    material = np.zeros(1000, int)
    assert bold.log_likelihood(material, mu).mean() < good.log_likelihood(material, mu).mean()


def test_uncertainty_counts_simulations_and_not_clips():
    values = np.repeat(np.random.default_rng(3).normal(size=10), 50)
    few, many = measure(values, np.repeat(np.arange(10), 50)), measure(values, np.arange(500))
    assert few.value == many.value
    assert few.high - few.low > 5 * (many.high - many.low)
    expected = 2 * 1.645 * values[::50].std() / np.sqrt(10)
    assert few.high - few.low == pytest.approx(expected, rel=0.15)


def test_printed_predictions_score_as_the_posteriors_do():
    mu, material = np.array([0.2, 0.6, 1.0]), np.array([0, 1, 2])
    posterior = answers(mu + 0.03, 0.06, [0, 1, 1])
    document = json.loads(json.dumps(predictions(posterior, [4, 7, 9], ALL_KNOWN)))
    assert set(document[0]) == {"slot", "material", "mu", "familiarity", "no_answer"}
    assert sum(document[0]["material"].values()) == pytest.approx(1.0, abs=1e-5)
    scores = score_predictions(document, posterior.materials, [4, 7, 9], truth(mu, material))
    direct = errors(estimates(posterior.mu, BINS), mu, np.arange(3))
    assert scores.blind.mae.value == pytest.approx(direct.mae.value, abs=1e-5)
    assert scores.blind.coverage.value == direct.coverage.value
    assert scores.top_1.value == (posterior.material.argmax(axis=1) == material).mean()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop(), "every slot of the test set must be answered, and 1 are not, 9 first"),
        (lambda a: a.append(a[0]), "slot 4 is answered twice"),
        (lambda a: a[0].update(slot=5), "slot of answer 0 must be one of the test set, and is 5"),
        (
            lambda a: a[1].update(mu={"median": 2.0, "low": 0.0, "high": 1.0}),
            "low <= median <= high",
        ),
        (lambda a: a[1].pop("mu"), "answer 1 must have slot, material and mu"),
        (lambda a: a[1].update(material={"silk": 1.0}), "must give probabilities of a, b, c"),
    ],
)
def test_a_file_of_predictions_is_checked(change, message):
    predicted = predictions(answers([0.2, 0.6, 1.0], 0.06, [0, 1, 1]), [4, 7, 9], ALL_KNOWN)
    change(predicted)
    with pytest.raises(ValueError, match=message):
        score_predictions(predicted, ("a", "b", "c"), [4, 7, 9], truth([0.5] * 3))


def test_an_interval_that_reaches_the_largest_known_mu_says_above():
    joint = np.zeros((2, 1, 64))
    joint[0, 0, 60:] = 0.25
    joint[1, 0, 30:34] = 0.25
    predicted = predictions(Posterior(("cloth",), BINS, joint), [0, 1], (np.ones(2), [None] * 2))
    assert [answer["mu"]["above"] for answer in predicted] == [1.6, None]


def test_a_clip_without_an_answer_has_no_mu_and_scores_as_the_prior():
    predicted = predictions(
        answers([0.2, 0.6, 1.0], 0.06, [0, 1, 1]),
        [4, 7, 9],
        (np.array([1, 0.01, 1]), [None, "glued", None]),
    )
    assert [(each["mu"] is None, each["no_answer"]) for each in predicted] == [
        (False, None),
        (True, "glued"),
        (False, None),
    ]
    scores = score_predictions(predicted, ("a", "b", "c"), [4, 7, 9], truth([0.2, 0.6, 1.0]))
    assert scores.blind.mae.value == pytest.approx((0.0 + 0.2 + 0.0) / 3, abs=0.01)


def test_the_interval_score_is_the_width_and_ten_times_what_is_beyond():
    estimated = Estimates(np.array([0.5, 0.5]), np.array([0.4, 0.4]), np.array([0.6, 0.6]))
    assert errors(estimated, np.array([0.5, 0.7]), np.arange(2)).interval.value == pytest.approx(
        (0.2 + 0.2 + 10 * 0.1) / 2
    )
