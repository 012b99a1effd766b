"""Coulomb's law of a contact, its derivatives, and its rows of Newton's system."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import _testing as core

Floats = NDArray[np.float64]

K, KAPPA, LAMBDA = 3.0, 20.0, 40.0
OPEN, SLIP, STICK = 0, 1, 2


def frame(seed: int) -> tuple[Floats, Floats, Floats]:
    """A normal and two directions across it."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q[0], q[1], q[2]


def law(
    gap: float,
    n: Floats,
    slip: Floats,
    force: Floats,
    mu: float,
    proximal: tuple[float, float] = (KAPPA, LAMBDA),
    smoothing: float = 0.0,
) -> tuple[int, Floats, Floats, Floats, float]:
    mode, stiffness, symmetric, change, error, _ = core.pair_row(
        gap, n, slip, force, mu, K, *proximal, smoothing
    )
    return mode, stiffness, symmetric, change, error


@pytest.mark.parametrize("seed", range(3))
def test_roots(seed: int) -> None:
    n, t, _ = frame(seed)
    zero = np.zeros(3)
    roots = [
        (OPEN, 0.1, zero, zero),
        (STICK, 0.0, zero, 2.0 * n + 0.9 * t),
        (SLIP, 0.0, -0.3 * t, 2.0 * n + 1.0 * t),
    ]
    for mode, gap, slip, force in roots:
        branch, _, _, correction, error = law(gap, n, slip, force, 0.5)
        assert branch == mode
        assert correction == pytest.approx(zero, abs=1e-12)
        assert error == pytest.approx(0.0, abs=1e-24)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.0, np.pi / 2, 2.5])
def test_the_cone_of_friction_is_round(angle: float) -> None:
    """In the axes of space, so that no other norm passes."""
    n, along = np.array([0.0, 0.0, 1.0]), np.array([np.cos(angle), np.sin(angle), 0.0])
    for size, mode in ((0.999, STICK), (1.001, SLIP)):
        assert law(0.0, n, np.zeros(3), 2.0 * n + size * along, 0.5)[0] == mode


@pytest.mark.parametrize(("friction", "mode"), [(0.9, STICK), (1.1, SLIP)])
def test_what_opens_a_little_sticks_by_the_force_that_it_still_has(
    friction: float, mode: int
) -> None:
    """The gap asks for a normal force of 1.7, and 2 presses: friction up to 1 holds, not 0.85."""
    n, t, _ = frame(2)
    assert law(0.1, n, np.zeros(3), 2.0 * n + friction * t, 0.5)[0] == mode


@pytest.mark.parametrize(
    ("gap", "slip", "force", "error"),
    [
        (0.1, 0.0, (0.0, 0.2), 0.2**2),  # a pull at a distance
        (-0.1, 0.0, (0.0, 0.0), (K * 0.1) ** 2),  # sinks in
        (0.0, 0.0, (2.0, 1.5), 0.5**2),  # beyond the cone
        (0.0, 0.1, (2.0, 0.0), (K * 0.1) ** 2),  # slips without friction
        (0.0, -1.0, (2.0, -1.0), 2.0**2),  # friction along the slip: 1 against -1
    ],
)
def test_error_is_the_force_by_which_the_law_is_missed(
    gap: float, slip: float, force: tuple[float, float], error: float
) -> None:
    n, t, _ = frame(1)
    assert law(gap, n, slip * t, force[0] * n + force[1] * t, 0.5)[4] == pytest.approx(error)


def test_a_pair_without_a_force_sticks_as_far_as_it_sinks_in() -> None:
    """At no force it would be frictionless, and cloth would slide away."""
    n, t, _ = frame(2)
    assert law(-0.1, n, 0.04 * t, np.zeros(3), 0.5)[0] == STICK
    mode, stiffness, _, _, _ = law(-0.1, n, 0.06 * t, np.zeros(3), 0.5)
    assert mode == SLIP
    assert stiffness @ n == pytest.approx(KAPPA * (n - 0.5 * t))  # with friction against the slip
    assert law(-0.1, n, 0.04 * t, np.zeros(3), 0.0)[0] == SLIP


def test_without_friction_it_never_sticks() -> None:
    n, _, _ = frame(3)
    mode, stiffness, _, force, _ = law(-0.1, n, np.zeros(3), 2.0 * n, 0.0)
    assert mode == SLIP
    assert stiffness == pytest.approx(KAPPA * np.outer(n, n))
    assert force == pytest.approx(KAPPA * 0.1 * n)


def test_sticking_row() -> None:
    n, t, s = frame(4)
    gap, slip = -0.01, 0.02 * t - 0.01 * s
    mode, stiffness, symmetric, force, _ = law(gap, n, slip, 2.0 * n, 0.5)
    assert mode == STICK
    assert stiffness == pytest.approx(
        KAPPA * np.outer(n, n) + LAMBDA * (np.outer(t, t) + np.outer(s, s))
    )
    assert symmetric == pytest.approx(stiffness)
    assert force == pytest.approx(-KAPPA * gap * n - LAMBDA * slip)


@pytest.mark.parametrize("seed", range(5))
def test_slipping_row_is_newtons(seed: int) -> None:
    """The row solves the linearised law r_T = mu r_N tau/|tau|, by finite differences.

    The proximal stiffness across is large, so that its term is left out.
    """
    rng = np.random.default_rng(seed)
    n, t, s = frame(seed)
    mu, gap = 0.4, -0.01
    force = 2.0 * n + 0.3 * t + 0.5 * s
    slip = -0.9 * t + 0.4 * s
    across = np.stack([t, s])

    def missed(r: Floats, u: Floats) -> Floats:
        tau = across @ (r - K * u)
        return across @ r - mu * (r @ n) * tau / np.linalg.norm(tau)

    mode, stiffness, symmetric, rhs, _ = law(gap, n, slip, force, mu, (KAPPA, 1e12))
    assert mode == SLIP
    v = 0.01 * rng.normal(size=3)
    dr = rhs - stiffness @ v
    assert dr @ n == pytest.approx(-KAPPA * (gap + v @ n))  # the proximal row
    step = 1e-6
    derivative = np.zeros(2)
    for direction, of_force in ((dr, True), (v - (v @ n) * n, False)):
        plus = missed(force + step * direction * of_force, slip + step * direction * (not of_force))
        minus = missed(
            force - step * direction * of_force, slip - step * direction * (not of_force)
        )
        derivative += (plus - minus) / (2.0 * step)
    assert missed(force, slip) + derivative == pytest.approx(np.zeros(2), abs=1e-8)
    assert symmetric == pytest.approx(symmetric.T)
    unsymmetric = stiffness - symmetric
    assert np.linalg.matrix_rank(unsymmetric) == 1
    assert unsymmetric @ n == pytest.approx(
        mu
        * KAPPA
        * (across @ (force - K * slip))
        @ across
        / np.linalg.norm(across @ (force - K * slip))
    )


def smoothed_missed(
    gap: float, n: Floats, slip: Floats, force: Floats, mu: float, epsilon: float
) -> Floats:
    """By what a force misses the smoothed law, with rho by bisection."""
    pressing = force @ n
    z = pressing - K * gap
    wanted = 0.5 * (z + np.hypot(z, 2.0 * np.sqrt(K * epsilon)))
    tau = force - pressing * n - K * slip
    size, bound = np.linalg.norm(tau), mu * wanted
    low, high = 0.0, min(size, bound)
    for _ in range(200):
        rho = 0.5 * (low + high)
        if rho + 2.0 * K * epsilon * rho / (bound**2 - rho**2) < size:
            low = rho
        else:
            high = rho
    return np.asarray(force - wanted * n - low * tau / size)


@pytest.mark.parametrize("epsilon", [1e-2, 1e-5, 1e-12])
def test_smoothed_roots(epsilon: float) -> None:
    """r_N g = epsilon, and within the cone u = -2 epsilon r_T/((mu r_N)^2 - |r_T|^2)."""
    n, t, _ = frame(5)
    mu, pressing = 0.5, 2.0
    for friction in (0.0, 0.3, 0.99):
        force = pressing * n + friction * t
        slip = -2.0 * epsilon * friction / (mu**2 * pressing**2 - friction**2) * t
        _, _, _, correction, error = law(epsilon / pressing, n, slip, force, mu, smoothing=epsilon)
        assert error == pytest.approx(0.0, abs=1e-24)
        assert correction == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_smoothed_row_is_newtons(seed: int) -> None:
    """Without the proximal term, dr = force - stiffness v solves the linearised smoothed law, by
    finite differences.
    """
    rng = np.random.default_rng(seed)
    n, t, s = frame(seed)
    mu, epsilon, gap = 0.4, 10.0 ** rng.uniform(-4.0, -1.0), 0.1 * rng.normal()
    force = 2.0 * rng.uniform() * n + 0.3 * t + 0.2 * s
    slip = 0.2 * rng.normal() * t + 0.2 * rng.normal() * s
    _, stiffness, symmetric, rhs, error = law(gap, n, slip, force, mu, (1e12, 1e12), epsilon)
    at = smoothed_missed(gap, n, slip, force, mu, epsilon)
    assert error == pytest.approx(at @ at)
    v = 0.01 * rng.normal(size=3)
    dr, across, step = rhs - stiffness @ v, v - (v @ n) * n, 1e-7
    plus = smoothed_missed(
        gap + step * float(v @ n), n, slip + step * across, force + step * dr, mu, epsilon
    )
    minus = smoothed_missed(
        gap - step * float(v @ n), n, slip - step * across, force - step * dr, mu, epsilon
    )
    assert at + (plus - minus) / (2.0 * step) == pytest.approx(np.zeros(3), abs=1e-6)
    assert symmetric == pytest.approx(symmetric.T)
    assert np.linalg.eigvalsh(symmetric).min() >= 0.0


def test_smoothing_tends_to_the_law() -> None:
    n, t, s = frame(6)
    force, slip = 2.0 * n + 0.3 * t + 0.5 * s, -0.9 * t + 0.4 * s
    exact = law(0.0, n, slip, force, 0.4)
    off = [
        abs(law(0.0, n, slip, force, 0.4, smoothing=epsilon)[4] - exact[4])
        for epsilon in (1e-4, 1e-6, 1e-8)
    ]
    assert off[0] > 10.0 * off[1] > 100.0 * off[2] > 0.0


def exact(contact: tuple[float, Floats, Floats, Floats], mu: float) -> Floats:
    """Return the force that the exact law asks for, written from its definition."""
    gap, n, slip, force = contact
    normal_force = float(force @ n)
    asked = force - K * (gap * n + slip)
    if asked @ n <= 0.0:
        return np.zeros(3)
    friction = asked - (asked @ n) * n
    bound = mu * max(normal_force, 0.0)
    factor = min(1.0, bound / float(np.linalg.norm(friction)))
    return np.asarray((asked @ n) * n + friction * factor)


def contact_of(mode: int, seed: int) -> tuple[float, Floats, Floats, Floats]:
    """Return gap, normal, slip and force of a contact on a branch, at mu 0.5."""
    n, t, s = frame(seed)
    rng = np.random.default_rng(seed)
    noise = 0.02 * rng.normal(size=3)
    noise -= (noise @ n) * n
    if mode == OPEN:
        return 1.0, n, noise, 2.0 * n + 0.3 * t
    friction = 0.4 * t + 0.3 * s if mode == STICK else 1.2 * t + 0.9 * s
    return -0.01, n, noise, 2.0 * n + friction


@pytest.mark.parametrize("mode", [OPEN, SLIP, STICK])
@pytest.mark.parametrize("seed", range(4))
def test_four_derivatives_are_those_of_the_law(mode: int, seed: int) -> None:
    """By finite differences, in the form that contact/coulomb_law.hpp states."""
    mu = 0.5
    gap, n, slip, force = contact_of(mode, seed)
    branch, asked, t, (a, along, across, coupling) = core.coulomb_law(gap, n, slip, force, mu, K)
    assert branch == mode
    assert asked == pytest.approx(exact((gap, n, slip, force), mu), abs=1e-12)
    rng = np.random.default_rng(100 + seed)
    d_gap, d_slip, d_force = rng.normal(), rng.normal(size=3), rng.normal(size=3)
    d_slip -= (d_slip @ n) * n
    step = 1e-6
    plus, minus = (
        exact((gap + e * d_gap, n, slip + e * d_slip, force + e * d_force), mu)
        for e in (step, -step)
    )
    tangential = d_force - (d_force @ n) * n - K * d_slip
    by_formula = (
        a * n * (d_force @ n - K * d_gap)
        + along * t * (t @ tangential)
        + across * (tangential - t * (t @ tangential))
        + coupling * t * (d_force @ n)
    )
    assert (plus - minus) / (2.0 * step) == pytest.approx(by_formula, abs=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_smoothed_derivatives_are_those_of_the_law(seed: int) -> None:
    """The same of the smoothed law, whose bound follows its own normal force P_N."""
    mu, epsilon = 0.5, 1e-2
    rng = np.random.default_rng(seed)
    n, t, s = frame(seed)
    gap, slip = 0.1 * rng.normal(), 0.2 * rng.normal() * t + 0.1 * rng.normal() * s
    force = 1.5 * n + 0.4 * t - 0.3 * s
    _, asked, along_t, (a, along, across, coupling) = core.coulomb_law(
        gap, n, slip, force, mu, K, epsilon
    )
    assert force - asked == pytest.approx(smoothed_missed(gap, n, slip, force, mu, epsilon))
    d_gap, d_slip, d_force = rng.normal(), rng.normal(size=3), rng.normal(size=3)
    d_slip -= (d_slip @ n) * n
    step = 1e-6
    plus, minus = (
        (force + e * d_force)
        - smoothed_missed(gap + e * d_gap, n, slip + e * d_slip, force + e * d_force, mu, epsilon)
        for e in (step, -step)
    )
    tangential = d_force - (d_force @ n) * n - K * d_slip
    d_normal = a * (d_force @ n - K * d_gap)
    by_formula = (
        n * d_normal
        + along * along_t * (along_t @ tangential)
        + across * (tangential - along_t * (along_t @ tangential))
        + coupling * along_t * d_normal
    )
    assert (plus - minus) / (2.0 * step) == pytest.approx(by_formula, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_nodes_and_pairs_obey_one_law(seed: int) -> None:
    """With a stiff proximal term the row of a pair is that of a node.

    The same motions close it, and the same forces are left in the free directions.
    """
    mu, stiff = 0.5, 1e9
    gap, n, slip, force = contact_of(SLIP, seed)
    mode, t, node_force, correction, coupling, turn_stiffness = core.node_row(
        gap, n, slip, force, mu, K, 1e12
    )
    row_mode, stiffness, _, pair_force, _ = law(gap, n, slip, force, mu, (stiff, stiff))
    assert mode == row_mode == SLIP
    assert coupling == mu
    assert correction == pytest.approx(-gap * n)
    s = np.cross(n, t)
    v = np.random.default_rng(seed).normal(size=3)
    v += (correction @ n - v @ n) * n  # the motion that contact prescribes along the normal
    change = pair_force - stiffness @ v
    assert s @ change == pytest.approx(s @ node_force - turn_stiffness * (s @ v), rel=1e-6)
    # Along t friction is on its cone at the new normal force, which a node leaves to its residual.
    assert t @ (force + change) == pytest.approx(mu * n @ (force + change), abs=1e-5)
    assert t @ node_force == pytest.approx(mu * (force @ n) - t @ force)


@pytest.mark.parametrize("pull", [-0.05, -0.2])
def test_what_sinks_in_while_it_pulls_rubs_by_its_new_normal_force(pull: float) -> None:
    """r_N < 0 and z_N > 0: friction is on the cone at r_N + dr_N, for pairs and for nodes.

    Until this rule, pairs took mu dr_N, up to 6 % too much, and nodes took no friction at all.
    """
    n, t, _ = frame(7)
    mu, gap = 0.5, -0.2
    force = pull * n + 0.8 * t
    mode, stiffness, _, rhs, _ = law(gap, n, -0.6 * t, force, mu)
    assert mode == SLIP
    v = -gap * n + 0.3 * t - 0.05 * n  # sinks in by 0.05 less than the gap: it bears
    after = force + rhs - stiffness @ v
    assert after @ n == pytest.approx(pull + KAPPA * 0.05)
    assert after @ t == pytest.approx(mu * (after @ n))
    _, _, node_force, _, coupling, _ = core.node_row(gap, n, -0.6 * t, force, mu, K, 1e12)
    assert coupling == mu
    assert node_force @ t == pytest.approx(mu * pull - 0.8)


# ---- Pairs: the normal that turns, and the motion that closes ------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_friction_of_a_pair_turns_with_its_normal(seed: int) -> None:
    """The change of the force by the turn of the normal keeps the law, by finite differences.

    At contact and without a slip, so that the law is a matter of the force and the normal alone.
    The proximal stiffness is large, so that its term is left out.
    """
    mu = 0.5
    n, t, s = frame(seed)
    force = 2.0 * n + 1.2 * t + 0.9 * s
    stiff = 1e12
    mode, _, _, _, _, force_by_normal = core.pair_row(
        0.0, n, np.zeros(3), force, mu, K, stiff, stiff
    )
    assert mode == SLIP

    def missed(normal: Floats, r: Floats) -> Floats:
        friction = r - (r @ normal) * normal
        return np.asarray(friction - mu * (r @ normal) * friction / np.linalg.norm(friction))

    rng = np.random.default_rng(seed)
    turn = 0.3 * rng.normal() * t + 0.3 * rng.normal() * s  # of the normal
    change = force_by_normal @ turn
    step = 1e-6
    plus, minus = (missed(n + e * turn, force + e * change) for e in (step, -step))
    derivative = (plus - minus) / (2.0 * step)
    assert np.linalg.norm(change) > 0.1, "friction turns"
    assert [derivative @ t, derivative @ s] == pytest.approx([0.0, 0.0], abs=1e-7)


def test_a_pair_that_sticks_holds_its_force_while_its_normal_turns() -> None:
    n, t, _ = frame(1)
    stuck = core.pair_row(0.0, n, np.zeros(3), 2.0 * n + 0.4 * t, 0.5, K, 1e12, 1e12)
    assert stuck[0] == STICK
    assert stuck[5] == pytest.approx(np.zeros((3, 3)))


@pytest.mark.parametrize("seed", range(3))
def test_matrix_of_a_pair_moves_force_and_weights(seed: int) -> None:
    """The force on a node is w_c r. Motions change r, and they slide the closest points, so w_c."""
    rng = np.random.default_rng(seed)
    weights, displacements = rng.normal(size=(4, 3)), 0.1 * rng.normal(size=(4, 3))
    displacements = displacements.astype(np.float32).astype(float)
    force, row_force, row_stiffness = (
        rng.normal(size=3),
        rng.normal(size=3),
        rng.normal(size=(3, 3)),
    )
    sliding, force_by_motions = rng.normal(size=(2, 9)), rng.normal(size=(3, 9))
    motions, change, stiffness = core.pair_changes(
        weights, force, row_force, row_stiffness, sliding, force_by_motions, displacements
    )
    assert motions == pytest.approx((weights.T @ displacements).ravel())
    assert change == pytest.approx(
        row_force - row_stiffness @ motions[:3] + force_by_motions @ motions
    )

    slides = sliding @ motions
    of_weights = weights[:, 1:] @ slides
    expected = np.outer(weights[:, 0], change) + np.outer(of_weights, force)
    right_side = np.concatenate([row_force, np.zeros(6)]) - stiffness @ motions
    assert weights @ right_side.reshape(3, 3) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("gap", "approach", "slip", "mode"),
    [
        (0.1, 0.3, 0.09, STICK),  # sinks in by 0.2: up to 0.1 it sticks
        (0.1, 0.3, 0.11, SLIP),
        (0.1, 0.05, 0.001, SLIP),  # does not arrive, so it bears nothing
        (-0.1, 0.1, 0.09, STICK),  # is in by 0.1 already
        (-0.1, 0.1, 0.11, SLIP),
        (-0.1, -0.3, 0.001, SLIP),  # leaves
    ],
)
def test_a_motion_that_closes_a_pair_sticks_as_far_as_it_sinks_in(
    gap: float, approach: float, slip: float, mode: int
) -> None:
    n, t, s = frame(3)
    before = 0.5 * slip * t
    motion = -approach * n + 0.5 * slip * t
    branch, direction = core.closing(gap, n, before, np.zeros(3), 0.5, K, motion)
    assert branch == mode
    if mode == SLIP:
        assert direction == pytest.approx(-t), "friction is against the slip at the end"
    assert core.closing(gap, n, before, np.zeros(3), 0.0, K, motion)[0] == SLIP
    assert abs(float(direction @ s)) < 1.0
