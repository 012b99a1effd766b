"""The forward model of a fit: from gamma and natural curvature to the hung centreline.

The model hangs two chains whose nodes include the P points. It extrapolates their centrelines by
(4 r_h - r_2h) / 3, with an error O(h^4). Its derivatives are exact, because it differentiates each
chain through its equilibrium (rods/chain.hpp).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import (
    CLAMP_FRAME,
    ELEMENT_TURN_MAX,
    RodSolution,
    clamp_quaternions,
    finite_array,
    rod_stiffness,
    solve_general_rods,
)
from stickslip_sim_core.rotations import vectors_of_quaternions
from stickslip_sim_core.splines import bspline_matrix, interpolation_matrix

ELEMENTS_MIN = 96
"""Least number of elements of the coarser chain."""

ITERATIONS_MAX = 40
"""Largest number of accepted and refused steps of a minimisation together."""


@dataclass(frozen=True, eq=False)
class HungRod:
    """A hung rod, with its extrapolated centreline (P, 3).

    Spline coefficients are (B, 3); each chain has its frames.
    """

    gamma: float
    coefficients: Floats
    frames: tuple[Floats, ...]
    centerline: Floats

    def residual(self, data: Floats) -> Floats:
        return (self.centerline - data).ravel()


@dataclass(frozen=True, eq=False)
class HungRodModel:
    """From gamma and spline coefficients to the hung centreline at P points."""

    stiffness: Floats
    clamp_frame: Floats  # R(0), (3, 3)
    intervals: int | None  # None: constant
    strides: tuple[int, ...]  # of the chains, in elements per point
    bases: tuple[Floats, ...]  # spline values in the middles of each chain's elements

    @staticmethod
    def of(
        points: int,
        stiffness: ArrayLike,
        intervals: int | None,
        clamp_frame: ArrayLike = CLAMP_FRAME,
    ) -> "HungRodModel":
        # Both chains have nodes at the P points. The second has elements of half the length.
        stride = -(-ELEMENTS_MIN // (points - 1))
        strides = (stride, 2 * stride)
        bases = []
        for k in strides:
            n = k * (points - 1)
            middles = (np.arange(n) + 0.5) / n
            bases.append(
                np.ones((n, 1)) if intervals is None else bspline_matrix(intervals, middles)
            )
        K = rod_stiffness(stiffness, 1)[0]
        clamp = finite_array("clamp_frame", clamp_frame, (3, 3))
        # A matrix that is no rotation is refused now, and not when the first rod hangs.
        clamp_quaternions(clamp, 1)
        return HungRodModel(K, clamp, intervals, strides, tuple(bases))

    def relax(
        self, gamma: float, coefficients: Floats, frames: tuple[Floats, ...]
    ) -> HungRod | None:
        """Hang the rod from `frames` on, or return None without a stable equilibrium nearby."""
        hung = []
        curves = []
        for k, basis, start in zip(self.strides, self.bases, frames, strict=True):
            q, stable = _sim_core.relax_chain(gamma, self.stiffness, basis @ coefficients, start)
            if not stable:
                return None
            hung.append(q)
            curves.append(_sim_core.chain_centerline(q)[::k])
        return HungRod(gamma, coefficients, tuple(hung), (4.0 * curves[1] - curves[0]) / 3.0)

    def hang(self, gamma: float, coefficients: Floats, curvature: Floats) -> HungRod | None:
        """Hang the rod from a shape of this curvature, (m, 3) at uniform arc length."""
        clamp = clamp_quaternions(self.clamp_frame, 1)[0]
        frames = []
        for basis in self.bases:
            n = len(basis)
            middles = interpolation_matrix(len(curvature), (np.arange(n) + 0.5) / n) @ curvature
            frames.append(_sim_core.chain_frames(middles, clamp))
        return self.relax(gamma, coefficients, tuple(frames))

    def jacobian(self, state: HungRod) -> Floats:
        """Return derivatives of the centreline by log gamma and the coefficients: (3 P, 1 + 3 B).

        Coefficients are ordered component by component.
        """
        parts = [
            _sim_core.chain_jacobian(
                state.gamma, self.stiffness, basis @ state.coefficients, q, basis, k
            )
            for k, basis, q in zip(self.strides, self.bases, state.frames, strict=True)
        ]
        jacobian = (4.0 * parts[1] - parts[0]) / 3.0
        # From the derivative by gamma to the derivative by log gamma.
        jacobian[:, 0] *= state.gamma
        return jacobian

    def moved(self, state: HungRod, step: Floats) -> HungRod | None:
        """Hang the rod again after a step of (log gamma, coefficients)."""
        # Derivatives say nothing about a rod whose weight differs by more than a factor of e.
        if abs(step[0]) > 1.0:
            return None
        coefficients = state.coefficients + step[1:].reshape(3, -1).T
        return self.relax(state.gamma * float(np.exp(step[0])), coefficients, state.frames)

    def solution(self, state: HungRod, points: int) -> RodSolution:
        """Solve the fitted rod with the general solver, from the frames of the fit."""
        s = np.linspace(0.0, 1.0, points)
        B = np.ones((points, 1)) if self.intervals is None else bspline_matrix(self.intervals, s)
        natural = B @ state.coefficients
        start = _chain_curvature(state.frames[0])
        # Elements must turn by less than the solver's limit, both naturally and in the hung shape.
        largest = max(np.linalg.norm(f, axis=1).max() for f in (natural, start))
        elements = 4 * int(np.ceil(max(largest / (0.8 * ELEMENT_TURN_MAX), 32)))
        return solve_general_rods(
            natural[None],
            [state.gamma],
            stiffness=self.stiffness,
            clamp_frame=self.clamp_frame,
            start_curvature=start[None],
            elements=elements,
            points=points,
        )


def minimise(
    model: HungRodModel,
    state: HungRod,
    data: Floats,
    free: NDArray[np.int64],
    penalty: Floats,
    tolerance: float,
) -> HungRod:
    """Minimise |residual|^2 + c^T penalty c by damped Gauss-Newton steps.

    `free` are the indices of the parameters (log gamma, coefficients) that may change.
    """

    def cost(rod: HungRod) -> float:
        c = parameters_of(rod)
        return float((rod.residual(data) ** 2).sum() + c @ penalty @ c)

    value = cost(state)
    damping = 0.0
    fresh = True
    for _ in range(ITERATIONS_MAX):
        # After a refused step the derivatives at the state are still valid.
        if fresh:
            J = model.jacobian(state)[:, free]
            normal = J.T @ J
            hessian = normal + penalty[np.ix_(free, free)]
            gradient = J.T @ state.residual(data) + (penalty @ parameters_of(state))[free]

        # Damping bends the step towards the gradient and shortens it.
        diagonal = np.diag(damping * np.diag(normal))
        step = np.zeros(len(penalty))
        step[free] = -np.linalg.solve(hessian + diagonal + ridge(normal), gradient)

        # A step without an equilibrium counts as a step that does not lower the cost.
        trial = model.moved(state, step)
        fresh = trial is not None and (trial_value := cost(trial)) <= value
        if fresh:
            assert trial is not None
            change = root_mean_square(trial.centerline - state.centerline)
            state = trial
            value = trial_value
            damping = 0.0 if damping < 1e-4 else 0.1 * damping
            if change <= tolerance:
                break
        else:
            # Only rounding is left.
            if root_mean_square(J @ step[free]) <= tolerance:
                break
            damping = max(1e-3, 10.0 * damping)
    return state


def _chain_curvature(quaternions: Floats) -> Floats:
    """Return the curvature of a chain at its nodes, shape (N + 1, 3).

    A node has the mean curvature of its two elements. A node at an end has the curvature of its
    only element.
    """
    # The quaternion (w, v) from one frame to the next is the turn of an element.
    p = quaternions[:-1]
    q = quaternions[1:]
    w = (p * q).sum(axis=1)
    v = p[:, :1] * q[:, 1:] - q[:, :1] * p[:, 1:] - np.cross(p[:, 1:], q[:, 1:])
    kappa = len(p) * vectors_of_quaternions(np.column_stack([w, v]))
    return np.concatenate([kappa[:1], 0.5 * (kappa[1:] + kappa[:-1]), kappa[-1:]])


def parameters_of(state: HungRod) -> Floats:
    """Return log gamma and the coefficients, component by component: shape (1 + 3 B,)."""
    return np.concatenate([[np.log(state.gamma)], state.coefficients.T.ravel()])


def ridge(normal: Floats) -> Floats:
    """Return a small diagonal matrix that keeps a normal matrix from being singular."""
    return np.asarray(1e-13 * np.trace(normal) * np.eye(len(normal)))


def root_mean_square(f: Floats) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt((f**2).mean()))
