"""Time stepping of cloth in contact with bodies, itself and surfaces.

The module is a thin layer over the C++ solver.
"""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import (
    ClothSolver,
    PairForces,
    SensitivityReport,
    StepReport,
    sheet_count,
    step_iterations_max,
)
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import (
    BEARING,
    THICKNESS,
    Body,
    BodyTuple,
    SelfContact,
    Surface,
)
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.history import StepHistory
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.sensitivities import Parameter, RatesTuple

KERNEL_VARIABLE = "STICKSLIP_CLOTH_KERNEL"
"""Environment variable that sets the level of the kernels."""

PASSED_ON = (
    "newton_max",
    "krylov_tolerance",
    "refactor_after",
    "newton_before_halving",
    "halvings_max",
    "second_order",
    "finest",
)
"""Settings that the C++ solver takes as they are."""

RESIDUAL_PATCH = 0.005**2
"""Area whose weight is the unit of residuals [m^2]. It does not depend on the mesh."""

EXTENT_MAX = 20.0
"""Largest length and width of all sheets at rest [m]: larger ones are a mistake in the unit."""

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

Motion = Callable[[float], tuple[Floats, ArrayLike, Sequence[Body]]]
"""Function of the time [s] that returns gravity, held vertices and bodies.

Gravity is (V, 3) [m/s^2]. The positions of the held vertices are (K, 3) [m].
"""

Path = Callable[[Floats], tuple[ArrayLike, ArrayLike]]
"""Function of times (T,) [s] that returns held vertices and poses of bodies.

The positions of the held vertices are (T, K, 3) [m]. The poses are (T, B, 3, 4) [m].
"""


class Cloth:
    """Cloth with its state and solver settings: a sheet, or several in one mesh.

    Args:
        mesh: The cloth at rest. `meshes.together` puts several sheets into one mesh.
        fabric: Material of the cloth, or of each sheet. Sheets are the connected pieces of the
            mesh, in the order of their first vertices.
        preset: Solver settings.
        held: Vertices whose positions are prescribed: (K,).
        self_contact: Contact within and between sheets. Without it the cloth passes through
            itself.
        surfaces: Triangles that the cloth touches.
        force_scale: Unit of residual forces [N]. None is the weight of 25 mm^2 of the lightest
            fabric.
        kernel: Level of the kernels, one of `_sim_core.kernels()`. Levels differ in the last
            digits. None takes the environment variable STICKSLIP_CLOTH_KERNEL, or else the widest
            level that this processor runs.

    Raises:
        ValueError: An argument breaks its rule.
    """

    def __init__(
        self,
        mesh: Mesh,
        fabric: Fabric | Sequence[Fabric],
        preset: SolverSettings,
        *,
        held: ArrayLike = (),
        self_contact: SelfContact | None = None,
        surfaces: Sequence[Surface] = (),
        force_scale: float | None = None,
        kernel: str | None = None,
    ) -> None:
        self.mesh, self.preset = mesh, preset
        self.fabrics = (fabric,) if isinstance(fabric, Fabric) else tuple(fabric)
        """One fabric, or one for each sheet."""
        self.held = np.asarray(held, dtype=np.int32).reshape(-1)
        sheets = sheet_count(mesh.rest, mesh.triangles)
        extent = float(np.ptp(mesh.rest, axis=0).max())
        if extent > EXTENT_MAX:
            raise ValueError(
                f"mesh: must be at most {EXTENT_MAX:g} m long and wide, got {extent:g} m"
            )
        self.surfaces = tuple(surfaces)
        self.self_contact = self_contact
        self.time = 0.0
        """Time at the end of the last step [s]."""
        # The lightest fabric gives the smallest unit, so no sheet converges too early.
        patch_weight = (
            min((fabric.density for fabric in self.fabrics), default=np.nan)
            * RESIDUAL_PATCH
            * GRAVITY
        )
        self.force_scale = patch_weight if force_scale is None else force_scale
        """Unit of residual forces [N]: the weight of 25 mm^2, unless the caller gives another."""
        # The C++ solver has one list of vertices for all surfaces, one surface after the other.
        self._surface_sizes = [len(surface.at(self.time)) for surface in self.surfaces]
        kernel = os.environ.get(KERNEL_VARIABLE, "") if kernel is None else kernel
        # `hold` makes a new solver with other held vertices, and all else as here.
        self._make = partial(
            ClothSolver,
            mesh.rest,
            mesh.triangles,
            [_solver_fabric(fabric) for fabric in self.fabrics],
            kernel=kernel,
            **self._solver_settings(),
            **self._solver_contact(sheets),
        )
        self._solver = self._make(held=self.held.tolist())
        # Time, positions and velocities before the last step. The time inf stands for no step yet.
        self._before = (np.inf, np.empty((0, 3)), np.empty((0, 3)))
        self._parameters: tuple[Parameter, ...] = ()
        # Derivatives of positions and velocities before the last step, as `_before`.
        self._before_sensitivities = (self._no_sensitivities(), self._no_sensitivities())
        self.total = StepReport()
        """Report of all steps: counts, least distances, and in `seen` the values for `checks`."""
        self.history = StepHistory()
        """Measured numbers of each step, for `checks` that judge the worst stretch of a run."""
        self.spent = 0.0
        """Most iterations of Newton's method over those that are allowed.

        The allowed ones are 1,000 for a step, and the preset's `newton_per_second` in a second of
        scene time. Beyond 1, `advance` stops.
        """
        self._spent = 0.0
        self.gravity = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))

    def _solver_settings(self) -> dict[str, Any]:
        """Return what the C++ solver takes from the preset."""
        preset = self.preset
        settings = {name: getattr(preset, name) for name in PASSED_ON}
        settings["tolerance"] = preset.tolerance * self.force_scale
        # A fixed step has no error to keep, and `advance` takes it as the longest step.
        settings["step_error"] = preset.step_error or np.inf
        settings["longest_step"] = preset.longest_step if preset.step_error else preset.time_step
        return settings

    def _solver_contact(self, sheets: int) -> dict[str, Any]:
        """Return what the C++ solver takes about contact of sheets and surfaces."""
        mu, mu_static, thickness = self._touch(sheets)
        bearing = self.self_contact.bearing if self.self_contact else "all"
        edge_fraction, second_fraction = BEARING[bearing]
        # Shift the numbers of a surface's vertices past the vertices of earlier surfaces.
        sizes = self._surface_sizes
        corners = [
            np.asarray(surface.triangles) + sum(sizes[:before])
            for before, surface in enumerate(self.surfaces)
        ]
        return {
            "thickness": thickness.tolist(),
            "mu": mu,
            "mu_static": mu_static,
            "edge_fraction": edge_fraction,
            "second_fraction": second_fraction,
            "surface_triangles": np.concatenate(
                [np.empty((0, 3), np.int32), *corners], dtype=np.int32
            ),
            "surface_of_vertex": np.repeat(np.arange(len(sizes)), sizes).tolist(),
            "surface_positions": self._surfaces_at(self.time),
            "crease": [surface.crease for surface in self.surfaces],
        }

    def _touch(self, sheets: int) -> tuple[Floats, Floats, Floats]:
        """Return kinetic and static friction of sheets and surfaces, and thicknesses.

        Friction of -1 stands for no contact.
        """
        # Surfaces come after the sheets. Two surfaces have no contact: both are prescribed.
        mu = np.full((sheets + len(self.surfaces),) * 2, -1.0)
        mu_static = mu.copy()
        thickness = np.full(sheets, THICKNESS)
        if self.self_contact:
            of_sheets = self.self_contact.of_sheets(sheets)
            mu[:sheets, :sheets], mu_static[:sheets, :sheets], thickness = of_sheets
        for column, surface in enumerate(self.surfaces, start=sheets):
            kinetic = np.asarray(surface.mu, float)
            # A surface does not have the number of sheets, so it could not check its friction.
            if kinetic.ndim and kinetic.shape != (sheets,):
                raise ValueError(
                    f"mu: of a surface must be one or of {sheets} sheets, got {kinetic.tolist()}"
                )
            mu[:sheets, column] = mu[column, :sheets] = kinetic
            resting = kinetic if surface.mu_static is None else np.asarray(surface.mu_static, float)
            mu_static[:sheets, column] = mu_static[column, :sheets] = resting
        skins = [surface.thickness for surface in self.surfaces]
        return mu, mu_static, np.append(thickness, skins)

    def _surfaces_at(self, time: float) -> Floats:
        corners = [surface.at(time) for surface in self.surfaces]
        # A function of time may return more or fewer vertices than it did at the start.
        if [len(points) for points in corners] != self._surface_sizes:
            raise ValueError(
                f"positions: of surfaces must keep their vertices, and do not at {time:g} s"
            )
        return np.concatenate([np.empty((0, 3)), *corners])

    @property
    def kernel(self) -> str:
        return str(self._solver.kernel())

    @property
    def worst_residual(self) -> float:
        """Largest residual force of a node in any step, over `force_scale`."""
        return self.total.residual / self.force_scale

    @property
    def masses(self) -> Floats:
        """Masses of the vertices: (V,) [kg]."""
        return np.asarray(self._solver.masses())

    @property
    def positions(self) -> Floats:
        """Positions of the vertices: (V, 3) [m]."""
        return np.asarray(self._solver.positions())

    @property
    def velocities(self) -> Floats:
        """Velocities of the vertices: (V, 3) [m/s]."""
        return np.asarray(self._solver.velocities())

    @property
    def reactions(self) -> Floats:
        """Forces on the vertices (V, 3) [N], from the balance M a = forces.

        A body or a smooth surface exerts the force on a free vertex. The holder exerts the force on
        a held vertex.
        """
        return np.asarray(self._solver.reactions())

    @property
    def contacts(self) -> NDArray[np.int32]:
        """The body that each vertex touches (V,), or -1.

        Surfaces are counted after the bodies.
        """
        return np.asarray(self._solver.contacts(), dtype=np.int32)

    @property
    def sliding(self) -> NDArray[np.bool_]:
        """Whether each vertex slides on its body or surface: (V,)."""
        return np.asarray(self._solver.sliding(), dtype=bool)

    @property
    def opposites(self) -> NDArray[np.int32]:
        """The body that presses each vertex against the one that it touches (V,), or -1.

        Between two bodies that face each other cloth is as thick as it is in self-contact.
        """
        return np.asarray(self._solver.opposites(), dtype=np.int32)

    @property
    def opposite_forces(self) -> Floats:
        """Forces of `opposites` on the vertices (V, 3) [N], which are part of `reactions`.

        The friction of both bodies together is known. It is shared as their normal forces are.
        """
        return np.asarray(self._solver.opposite_forces())

    @property
    def pair_forces(self) -> PairForces:
        """Forces of pairs of closest points at the end of the last step.

        The pairs are between cloth and cloth, and between cloth and triangles of surfaces.
        """
        return self._solver.pair_forces()

    @property
    def surface_forces(self) -> list[Floats]:
        """Forces of the cloth on the vertices of each surface at the end of the last step.

        The forces on a surface of N vertices are (N, 3) [N].
        """
        return np.split(
            np.asarray(self._solver.surface_forces()), np.cumsum(self._surface_sizes)[:-1]
        )

    def set_state(
        self, positions: ArrayLike, velocities: ArrayLike | None = None, bodies: Sequence[Body] = ()
    ) -> None:
        """Set positions (V, 3) [m], and velocities (V, 3) [m/s].

        `bodies` are the bodies at this time. Without them, bodies do not move in the next step.
        Without `velocities` the cloth is at rest.

        Raises:
            ValueError: The cloth crosses a surface, or, with self-contact, itself; a free vertex is
                more than 1 um inside a body; or an array has another shape.
        """
        at = np.asarray(positions, float)
        speed = np.zeros_like(at) if velocities is None else np.asarray(velocities, float)
        self._solver.set_state(
            at,
            speed,
            self._surfaces_at(self.time),
            [body.as_tuple() for body in bodies],
            begins=True,
        )
        # The derivatives of a state that a user gives are zero until the user gives them, too.
        if self._parameters:
            self.follow(self._parameters)

    def hold(self, vertices: ArrayLike, bodies: Sequence[Body] = ()) -> None:
        """Prescribe the positions of these vertices (K,) from now on, and let go of all others.

        Positions and velocities stay: a released vertex flies on with its velocity. `bodies` are
        the bodies at this time.

        Raises:
            ValueError: A vertex does not exist, or comes twice; or no vertex is free.
        """
        # The set of held vertices decides the unknowns of the C++ solver, so it needs a new one.
        positions = self.positions
        velocities = self.velocities
        sensitivities = self.sensitivities, self.velocity_sensitivities
        self.held = np.asarray(vertices, dtype=np.int32).reshape(-1)
        self._solver = self._make(held=self.held.tolist())
        around = [body.as_tuple() for body in bodies]
        # The run goes on: the state is a result of the solver, and no start that a user gave.
        self._solver.set_state(
            positions, velocities, self._surfaces_at(self.time), around, begins=False
        )
        if self._parameters:
            self.follow(self._parameters)
            self.set_sensitivities(*sensitivities)

    def step(
        self, dt: float, *, held: ArrayLike = (), bodies: Sequence[Body] = (), damping: float = 0.0
    ) -> StepReport:
        """Advance by dt [s].

        `held` has the positions of the held vertices (K, 3) [m] at the end of the step. `bodies`
        are the bodies at the end, and surfaces are taken there, too. `damping` is proportional to
        mass [1/s] and adds to the damping of the fabric.

        The solver counts a step that does not converge, and keeps its best iterate. `rungs` of the
        report says how often each rung of the fallback ladder was tried and how often it converged:
        parts of a step may end on different rungs.
        """
        ends = np.asarray(held, float).reshape(-1, 3)
        report = self._solver.step(
            dt,
            self.gravity,
            ends,
            self._surfaces_at(self.time + dt),
            [body.as_tuple() for body in bodies],
            damping,
            self._rates_at(self.time + dt, len(bodies)),
        )
        self.time += dt
        self.total.add(report)
        self.history.add(dt, report)
        return report

    def advance(
        self,
        end: float,
        motion: Motion,
        *,
        path: Path | None = None,
        event: float = np.inf,
        damping: Callable[[float], float] = lambda _time: 0.0,
        is_over: Callable[[], bool] = lambda: False,
        may_fail: Callable[[], bool] = lambda: True,
        ends: Floats | None = None,
    ) -> None:
        """Take steps until one ends at `end` [s] or later.

        The step control chooses their lengths, or the preset fixes them.

        Steps depend on the state of the cloth and not on the number of calls. `positions_at`
        returns positions at any time of the last step. Gravity and damping are taken at the ends of
        steps. A step is halved if held vertices, bodies or surfaces do not move evenly in it. For
        example, `certified` looks at their motion 512 times a second.

        Args:
            end: Time to reach [s].
            motion: Gravity, held vertices and bodies.
            path: Held vertices and poses of bodies at many times, which is quicker. None calls
                `motion` for each time.
            event: Time of the next sudden change of the motion [s]. A step ends there.
            damping: Damping proportional to mass [1/s], added to the damping of each fabric.
            is_over: Function that returns whether to stop, which is asked after each step.
            may_fail: Function that returns whether a step may stay unconverged, which is asked
                before each step. Otherwise such a step is given up soon, and no step may follow.
            ends: Ends of the steps of another run, ascending [s], which this run repeats. After
                the last of them, or without them, the step control chooses the steps.

        Raises:
            ValueError: `event` has passed, or `end` is not a number.
        """
        # The loop below would end at once, as if the time had been reached.
        if np.isnan(end):
            raise ValueError("end: must be a number, got nan")

        # The solver calls `drive` for the end of a step.
        def drive(
            time: float,
        ) -> tuple[Floats, Floats, Floats, list[BodyTuple], float, list[RatesTuple]]:
            self.gravity, held, bodies = motion(time)
            ends = np.asarray(held, float).reshape(-1, 3)
            tuples = [body.as_tuple() for body in bodies]
            surfaces = self._surfaces_at(time)
            return (
                self.gravity,
                ends,
                surfaces,
                tuples,
                damping(time),
                self._rates_at(time, len(tuples)),
            )

        # The solver calls `track` for many times within a step, to see whether the motion is even.
        def track(times: Sequence[float]) -> tuple[Floats, Floats]:
            at = np.array(times)
            if path is not None:
                held, poses = path(at)
            else:
                instants = [motion(time) for time in times]
                held = np.array([np.asarray(instant[1], float) for instant in instants])
                poses = np.array([[body.pose for body in instant[2]] for instant in instants])
            corners: ArrayLike = np.empty((len(at), 0, 3))
            if self.surfaces:
                corners = [self._surfaces_at(time) for time in times]
            # Vertices of surfaces are prescribed points as well, after the held vertices.
            points = np.concatenate([np.reshape(held, (len(at), -1, 3)), corners], axis=1)
            return points.reshape(-1, 3), np.reshape(np.asarray(poses, float), (-1, 4))

        while self.time < end and self.spent <= 1.0:
            # `positions_at` interpolates between the two ends of this step.
            self._before = self.time, self.positions, self.velocities
            if self._parameters:
                self._before_sensitivities = self.sensitivities, self.velocity_sensitivities
            known = np.inf if ends is None else _next_of(ends, self.time)
            if np.isfinite(known):
                report = self._solver.step(known - self.time, *drive(known))
                self.time = known
            else:
                self.time, report = self._solver.advance(self.time, event, drive, track, may_fail())
            self.total.add(report)
            self.history.add(self.time - self._before[0], report)
            self._spend(self.time - self._before[0], report.newton)
            if is_over():
                return

    def _spend(self, duration: float, iterations: int) -> None:
        """Count the iterations of a step of `duration` [s]."""
        self.spent = max(self.spent, iterations / step_iterations_max)
        if self.preset.step_error is None:
            return
        # The sum of iterations drains at the allowed rate. A few hard steps therefore stay within
        # the budget of a second, and many hard steps in a row exceed it.
        allowed = self.preset.newton_per_second
        self._spent = max(0.0, self._spent - allowed * duration) + iterations
        self.spent = max(self.spent, self._spent / allowed)

    @property
    def last_begin(self) -> float:
        """Time at which the last step of `advance` began [s], or inf before the first."""
        return self._before[0]

    def positions_at(self, time: float, *, straight: bool = False) -> Floats:
        """Return the positions (V, 3) [m] at a time [s] in the last step of `advance`.

        Positions are cubic in time between the ends of the step, with the velocities at both ends.
        With `straight` they are linear. A cubic continues the velocity before an impact, and may
        reach through the obstacle.

        Raises:
            ValueError: The time is not in the last step.
        """
        if time == self.time:
            return self.positions
        _, x, v = self._before
        return self._between(time, (x, v), (self.positions, self.velocities), straight=straight)

    def _between(
        self,
        time: float,
        before: tuple[Floats, Floats],
        now: tuple[Floats, Floats],
        *,
        straight: bool,
    ) -> Floats:
        """Return values at a time in the last step, from values and rates at its ends."""
        begin = self._before[0]
        if not begin <= time < self.time:
            raise ValueError(
                f"time: must be in the last step, {begin:g} ... {self.time:g} s, got {time:g}"
            )
        # Hermite's cubic: the straight part with zero velocities, and a bent part for velocities.
        h = self.time - begin
        s = (time - begin) / (self.time - begin)
        (x, v), (x_end, v_end) = before, now
        way = x_end - x
        if straight:
            return np.asarray(x + s * way)
        bent = h * s * (1.0 - s) * ((1.0 - s) * v - s * v_end)
        return np.asarray(x + s * s * (3.0 - 2.0 * s) * way + bent)

    def follow(self, parameters: Sequence[Parameter]) -> None:
        """Differentiate the run by these parameters from now on.

        The derivatives of the state are zero until `set_sensitivities`. Positions have the same
        bits with and without.

        Raises:
            ValueError: A parameter is friction of a thing that does not touch the cloth.
        """
        self._parameters = tuple(parameters)
        self._solver.follow([parameter.as_tuples() for parameter in self._parameters])
        self._before_sensitivities = (self._no_sensitivities(), self._no_sensitivities())

    def set_sensitivities(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> None:
        """Set the derivatives of the state by each parameter.

        Args:
            positions: Of positions (P, V, 3) [m per unit of the parameter].
            velocities: Of velocities (P, V, 3) [m/s per unit]. None is zero.

        Raises:
            ValueError: An array has another shape.
        """
        x = np.asarray(positions, float)
        v = np.zeros_like(x) if velocities is None else np.asarray(velocities, float)
        self._solver.set_sensitivities(list(x), list(v))

    def _no_sensitivities(self) -> Floats:
        return np.zeros((len(self._parameters), len(self.mesh.rest), 3))

    @property
    def sensitivities(self) -> Floats:
        """Derivatives of the positions by each parameter: (P, V, 3) [m per unit]."""
        derivatives = self._solver.position_sensitivities()
        return np.reshape(derivatives, (-1, len(self.mesh.rest), 3))

    @property
    def velocity_sensitivities(self) -> Floats:
        """Derivatives of the velocities by each parameter: (P, V, 3) [m/s per unit]."""
        derivatives = self._solver.velocity_sensitivities()
        return np.reshape(derivatives, (-1, len(self.mesh.rest), 3))

    @property
    def nearest_events(self) -> Floats:
        """How far each parameter may change until a contact changes its branch: (P,).

        It is an estimate to first order from the last step, in units of the parameter. The
        derivative is that of one side where the distance is 0.
        """
        return np.asarray(self._solver.nearest_events(), float)

    @property
    def sensitivity_report(self) -> SensitivityReport:
        """How well the equations of the derivatives were solved."""
        return self._solver.sensitivity_report()

    def sensitivities_at(self, time: float, *, straight: bool = False) -> Floats:
        """Return the derivatives of `positions_at` (P, V, 3) [m per unit].

        Raises:
            ValueError: The time is not in the last step.
        """
        if time == self.time or not self._parameters:
            return self.sensitivities
        now = self.sensitivities, self.velocity_sensitivities
        return self._between(time, self._before_sensitivities, now, straight=straight)

    def _rates_at(self, time: float, bodies: int) -> list[RatesTuple]:
        for parameter in self._parameters:
            parameter.check_bodies(bodies)
        rates = [parameter.rates_at(time) for parameter in self._parameters]
        # The solver reads a row for each thing, and a missing one would be memory of others.
        for by_parameter in rates:
            by_parameter.check(len(self.held), len(self.mesh.rest), bodies)
        return [by_parameter.as_tuple() for by_parameter in rates]

    @property
    def momentum_rate(self) -> Floats:
        """Rate of the cloth's momentum in the last step (3,) [N]: the sum of all forces.

        It is the rate by which the scheme of each vertex balances forces. The change of
        `masses @ velocities` over a step is not this rate times its length: velocities belong to
        the middles of steps, or change over two steps. It is zero before the first step.
        """
        return np.asarray(self._solver.momentum_rate())

    def contact_force(self) -> Floats:
        """Return the force of bodies and surfaces on the cloth in the last step (3,) [N].

        It is the rate of momentum, minus the weight, the force of the holders and that of damping.
        It is zero before the first step.
        """
        # The force comes from the balance of momentum, so it does not rely on the friction law.
        if not self.total.steps:
            return np.zeros(3)
        holders = self.reactions[self.held].sum(axis=0)
        weight = (self.masses[:, None] * self.gravity).sum(axis=0)
        damping = self._solver.damping_force()
        return np.asarray(self.momentum_rate - weight - holders - damping)

    def softest(self) -> float:
        """Return the smallest eigenvalue of stiffness over mass in this state [1/s^2].

        Contact is ignored. The state is stable if the eigenvalue is > 0.
        """
        return float(self._solver.softest(self.positions))


def _solver_fabric(fabric: Fabric) -> tuple[Any, ...]:
    """Return a fabric as the C++ solver takes it."""
    softening = fabric.softening or 0.0
    return fabric.density, fabric.stretching, fabric.rigidity, fabric.damping, softening


def _next_of(ascending: Floats, time: float) -> float:
    """Return the first of ascending times after a time, or inf."""
    number = int(np.searchsorted(ascending, time, side="right"))
    return float(ascending[number]) if number < len(ascending) else np.inf
