"""Each bad argument is refused with its field, its rule and its value."""

import signal
import threading

import numpy as np
import pytest

from stickslip_sim_core import solve_rods

GOOD = {"gamma": [100.0, 200.0], "phi0": [1.0, 2.0], "phi1": [6.0, 7.0]}


@pytest.mark.parametrize("field", ["gamma", "phi0", "phi1"])
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0, np.nan], r"must be finite, got nan at index 1"),
        ([np.inf, 1.0], r"must be finite, got inf at index 0"),
        ([[1.0, 2.0]], r"must have shape \(any\), got shape \(1, 2\)"),
        (["a", "b"], r"must be real numbers, got dtype <U1"),
        ([1j, 2.0], r"must be real numbers, got dtype complex128"),
        ([1.0, 2.0, 3.0], r"lengths must be equal, got "),
    ],
)
def test_bad_field(field: str, values: object, message: str) -> None:
    with pytest.raises(ValueError, match=f"{field}.*: {message}"):
        solve_rods(**{**GOOD, field: values})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("poisson", -1.0, r"poisson: must be in \(-1, 0.5\], got -1.0"),
        ("poisson", 0.51, r"poisson: must be in \(-1, 0.5\], got 0.51"),
        ("poisson", float("nan"), r"poisson: must be in \(-1, 0.5\], got nan"),
        ("elements", 126, r"elements: must be a multiple of 4 and at least 12, got 126"),
        ("elements", 8, r"elements: must be a multiple of 4 and at least 12, got 8"),
        ("elements", 0, r"elements: must be a multiple of 4 and at least 12, got 0"),
        ("elements", -4, r"elements: must be in 0 ... 2\^24, got -4"),
        ("elements", 128.0, r"elements: must be an integer, got 128.0"),
        ("points", 1, r"points: must be at least 2, got 1"),
        ("points", 2**40, r"points: must be in 0 ... 2\^24, got 1099511627776"),
        ("points", True, r"points: must be an integer, got True"),
    ],
)
def test_bad_option(option: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solve_rods(**GOOD, **{option: value})  # type: ignore[arg-type]


def test_negative_weight() -> None:
    with pytest.raises(ValueError, match=r"gamma: must be >= 0, got -1.0"):
        solve_rods([1.0, -1.0], [1.0, 1.0], [1.0, 1.0])


def test_too_few_elements_for_the_natural_turns() -> None:
    with pytest.raises(
        ValueError, match=r"elements: must be at least .*, got 48 for \|natural curvature\| = 50"
    ):
        solve_rods([100.0], [30.0], [40.0], elements=48)
    assert solve_rods([100.0], [30.0], [40.0], elements=80).stable.all()


def test_integers_and_strided_arrays_are_welcome() -> None:
    by_integers = solve_rods([100], [1], [6])
    strided = np.array([[100.0, 1.0, 6.0], [9.0, 9.0, 9.0]])[:1]
    assert by_integers.energy[0] == solve_rods(*strided.T).energy[0]


def test_interrupt_stops_a_long_solve() -> None:
    class Interrupted(Exception):  # noqa: N818  # it is a signal here, not an error
        pass

    def stop(number: int, frame: object) -> None:
        raise Interrupted

    many = np.full(200_000, 500.0)
    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(Interrupted):
            solve_rods(many, many / 100, many / 50, points=2)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_other_threads_run_meanwhile() -> None:
    """The GIL is free during the solve: a thread that only counts gets on."""
    counted, finished = [0], threading.Event()

    def count() -> None:
        while not finished.is_set():
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    start = counted[0]
    solve_rods(np.full(4000, 500.0), np.full(4000, 5.0), np.full(4000, 10.0), points=2)
    progress = counted[0] - start
    finished.set()
    thread.join()
    assert progress > 1000


def test_numbers_are_a_single_rod() -> None:
    single, same = solve_rods(500, 4, 12), solve_rods([500.0], [4.0], [12.0])
    assert single.centerline.shape == (1, 150, 3)
    assert (single.centerline == same.centerline).all()
