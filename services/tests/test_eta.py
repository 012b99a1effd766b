"""The time that is left: each term of its mean and variance, against numbers worked by hand."""

from math import sqrt

import pytest
from stickslip_schemas.base import Stage
from stickslip_services.queue.eta import MODEL_ERROR, QUANTILE_80, StageTimings, StageWork, estimate


def half_width(left: int, timings: StageTimings, slots: int) -> float:
    """Return the half width of the interval, of one stage."""
    eta = estimate({Stage.simulate: [StageWork(left, timings)]}, slots=slots)
    assert eta is not None
    return eta.high - eta.seconds


def timings(*durations: float) -> StageTimings:
    return StageTimings(len(durations), sum(durations), sum(duration**2 for duration in durations))


def test_mean_and_variance_are_those_of_the_sample() -> None:
    measured = timings(2.0, 4.0, 9.0)
    assert (measured.mean, measured.variance) == (5.0, 13.0)  # (9 + 1 + 16) / 2
    assert timings(3.0).variance == 9.0


@pytest.mark.parametrize("left", [1, 7, 400])
@pytest.mark.parametrize("count", [2, 10, 1000])
@pytest.mark.parametrize("slots", [1, 4])
def test_every_term_of_the_variance(left: int, count: int, slots: int) -> None:
    # Half of the tasks took 1 s and half 5 s: mean 3, variance 4 n / (n - 1).
    measured = StageTimings(count, 3.0 * count, 13.0 * count)
    spread = 4.0 * count / (count - 1)
    to_come = left * spread
    of_the_mean = left**2 * spread / count
    of_the_model = (left * 3.0 * MODEL_ERROR) ** 2
    expected = QUANTILE_80 * sqrt(to_come + of_the_mean + of_the_model) / slots
    assert half_width(left, measured, slots) == pytest.approx(expected, rel=1e-12)


def test_the_spread_of_what_is_to_come_counts_by_itself() -> None:
    """Known to the last digit (very many measured), one task left: its own spread remains."""
    measured = StageTimings(10**12, 3.0 * 10**12, 13.0 * 10**12)
    without = QUANTILE_80 * 3.0 * MODEL_ERROR
    assert half_width(1, measured, 1) == pytest.approx(
        QUANTILE_80 * sqrt(4.0 + (3.0 * MODEL_ERROR) ** 2), rel=1e-6
    )
    assert half_width(1, measured, 1) > 2.0 * without


def test_the_error_of_a_mean_of_few_grows_with_what_is_left() -> None:
    few, many = (
        timings(1.0, 5.0),
        StageTimings(10**12, 3.0 * 10**12, 17.0 * 10**12),
    )  # variance 8 both
    assert few.variance == pytest.approx(8.0)
    assert many.variance == pytest.approx(8.0)
    ratio = half_width(1000, few, 1) / half_width(1000, many, 1)
    expected = sqrt((8e3 + 8e6 / 2 + (3e3 * MODEL_ERROR) ** 2) / (8e3 + (3e3 * MODEL_ERROR) ** 2))
    assert ratio == pytest.approx(expected, rel=1e-6)
    assert ratio > 4.0


def test_stages_add_up_and_one_waits_for_the_other() -> None:
    work = {
        Stage.simulate: [StageWork(4, timings(10.0, 10.0))],
        Stage.render: [StageWork(2, timings(3.0, 3.0))],
    }
    eta = estimate(work, slots=2)
    assert eta is not None
    assert eta.seconds == pytest.approx((40.0 + 6.0) / 2)
    eta = estimate(work, slots=100)
    assert eta is not None
    assert eta.seconds == pytest.approx(13.0)
    assert (eta.high - eta.seconds) == pytest.approx(
        QUANTILE_80 * MODEL_ERROR * sqrt(40.0**2 + 6.0**2) / 100
    )
