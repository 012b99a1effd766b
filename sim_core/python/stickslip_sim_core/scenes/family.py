"""Families of scenes: scenes that differ in the values of some parameters.

`SceneFamily.differentiated` finds what a parameter changes by comparing two scenes of the family,
just below and just above its value.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core._sim_core import sheet_count
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.sensitivities import DriveRates, FabricProperty, Kind, Parameter, Term
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.scenes.holders import HANGING, Hang, Hanging, flat_under_tilt, hung
from stickslip_sim_core.scenes.scene import Scene
from stickslip_sim_core.scenes.sensitivities import SceneSensitivity, Side

CHANGE = 1e-5
"""Change of a parameter, over its size, between the two scenes that are compared.

What a parameter changes is smooth in it: the error is of the order of the square, 1e-10.
"""

SAME = 1e-9
"""Relative difference within which all numbers of a fabric have changed by one factor."""

AT_REST_STEP = 1e3
"""Length of the steps that differentiate a shape at rest [s].

Inertia is then 1e-6 of the stiffness or less, so that forces balance.
"""

AT_REST_STEPS = 3
"""Number of these steps. The first one is exact within 1e-6, unless stretching lags behind."""


_Rough: TypeAlias = Body | SelfContact | Surface
"""A thing with coefficients of friction."""


class SceneParameter(NamedTuple):
    """A number that scenes of a family differ in."""

    value: float
    low: float
    """Least value."""
    high: float
    """Largest value."""
    unit: str = "1"

    @property
    def size(self) -> float:
        """The unit of small changes: the value, or its range if the value is 0."""
        return abs(self.value) or self.high - self.low


class UnfitParameterError(ValueError):
    """A parameter does not exist, or a run cannot be differentiated by it."""


@dataclass(frozen=True, eq=False)
class SceneFamily:
    """Scenes that differ in the values of some parameters."""

    parameters: Mapping[str, SceneParameter]
    """Parameters by name, each with its value in `scene()` and its range."""

    make: Callable[[Mapping[str, float], Hang], Scene]
    """Function from the values of all parameters, and a way to hang, to the scene."""

    def scene(self, **values: float) -> Scene:
        """Return the scene with other values of some parameters.

        Raises:
            ValueError: A parameter does not exist, or a value breaks its rule.
        """
        return self.make(self._values(values), hung)

    def with_values(self, values: Mapping[str, float]) -> "SceneFamily":
        """Return the family around other values of some parameters.

        Raises:
            UnfitParameterError: A parameter does not exist, or a value is outside its range.
        """
        now = {
            name: parameter._replace(value=value)
            for (name, parameter), value in zip(
                self.parameters.items(), self._values(values).values(), strict=True
            )
        }
        return replace(self, parameters=now)

    def _values(self, values: Mapping[str, float]) -> dict[str, float]:
        self.check_names(tuple(values))
        for name, value in values.items():
            _, low, high, unit = self.parameters[name]
            if not low <= value <= high:
                raise UnfitParameterError(
                    f"{name}: must be within {low:g} ... {high:g} [{unit}], got {value:g}"
                )
        return {name: known.value for name, known in self.parameters.items()} | dict(values)

    def check_names(self, names: Sequence[str]) -> None:
        """Check names of parameters.

        Raises:
            UnfitParameterError: A name is not that of a parameter, or comes twice.
        """
        for number, name in enumerate(names):
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise UnfitParameterError(
                    f"parameter: must be one of {known}, which the scene has, got {name!r}"
                )
            if name in names[:number]:
                raise UnfitParameterError(f"parameter: must be named once, got {name!r} twice")

    def differentiated(self, names: Sequence[str]) -> Scene:
        """Return the scene, whose runs are differentiated by these parameters.

        Raises:
            UnfitParameterError: A parameter does not exist, or changes what a run cannot be
                differentiated by.
            ValueError: A value breaks its rule.
        """
        self.check_names(names)
        scene = self.scene()
        return replace(scene, sensitivities=[self._sensitivity(scene, name) for name in names])

    def _sensitivity(self, scene: Scene, name: str) -> SceneSensitivity:
        parameter = self.parameters[name]
        change = CHANGE * parameter.size
        # At an end of the range the difference is to one side.
        ends = (
            max(parameter.value - change, parameter.low),
            min(parameter.value + change, parameter.high),
        )
        # The shape of hanging is differentiated at rest, so neither side needs to hang.
        low, high = (self.make(self._values({name: end}), flat_under_tilt) for end in ends)
        comparison = Comparison(name, low, high, ends[1] - ends[0])
        comparison.check_the_rest()
        return SceneSensitivity(
            name,
            parameter.size,
            comparison.terms(),
            comparison.start_rates(scene),
            (
                Side(ends[0], low.motion, low.holders),
                Side(ends[1], high.motion, high.holders),
            ),
        )


class Comparison:
    """Two scenes of a family, and their differences per unit of the parameter."""

    def __init__(self, name: str, low: Scene, high: Scene, width: float) -> None:
        self._name, self._low, self._high, self._width = name, low, high, width

    def terms(self) -> tuple[Term, ...]:
        """Return the numbers of the cloth that differ."""
        return (*self._fabrics(), *self._bodies(), *self._pairs())

    def _fabrics(self) -> list[Term]:
        terms = []
        # One fabric for all sheets counts as that of every sheet.
        is_single = len(self._low.fabrics) == 1
        for sheet, (low, high) in enumerate(
            zip(self._low.fabrics, self._high.fabrics, strict=True)
        ):
            for kind, factor in self._factors(low, high).items():
                if factor != 1.0:
                    rate = float(np.log(factor)) / self._width
                    terms.append(Term(kind, -1 if is_single else sheet, rate=rate))
        return terms

    def _factors(self, low: Fabric, high: Fabric) -> dict[FabricProperty, float]:
        if low.damping != high.damping:
            self._refuse("the damping of a fabric")
        return {
            "density": high.density / low.density,
            "stretching": self._factor(low.stretching, high.stretching, "stretching"),
            "softening": self._softening_factor(low.softening, high.softening),
            **self._bending_factors(low.rigidity, high.rigidity),
        }

    def _softening_factor(self, low: float | None, high: float | None) -> float:
        if (low is None) != (high is None):
            self._refuse("whether a fabric softens")
        return 1.0 if low is None or high is None else high / low

    def _bending_factors(self, low: Floats, high: Floats) -> dict[FabricProperty, float]:
        """Return one factor of all of the rigidity, or those of its warp, weft and twist."""
        factors = np.diag(high) / np.diag(low)
        roots = np.sqrt(factors)
        if not np.allclose(high, low * np.outer(roots, roots), rtol=SAME, atol=0.0):
            self._refuse(
                "numbers of the bending of a fabric, and not by factors of warp, weft and twist"
            )
        if np.allclose(factors, factors[0], rtol=SAME, atol=0.0):
            return {"bending": float(factors[0])}
        warp, weft, twist = factors.tolist()
        return {"bending_warp": warp, "bending_weft": weft, "bending_twist": twist}

    def _factor(self, low: Floats, high: Floats, numbers: str) -> float:
        """Return the factor between two tables of numbers of a fabric."""
        factor = float(np.linalg.norm(high) / np.linalg.norm(low))
        if not np.allclose(high, factor * low, rtol=SAME, atol=0.0):
            self._refuse(f"some numbers of {numbers} of a fabric, and not all by one factor")
        return factor

    def _bodies(self) -> list[Term]:
        terms = []
        (_, bodies_low), (_, bodies_high) = self._low.motion(0.0), self._high.motion(0.0)
        for body, (low, high) in enumerate(zip(bodies_low, bodies_high, strict=True)):
            for kind, rates in self._friction_rates("body", low, high).items():
                for sheet, rate in enumerate(np.atleast_1d(rates)):
                    if rate:
                        of_sheet = sheet if rates.ndim else -1
                        terms.append(Term(kind, body, of_sheet, float(rate)))
        return terms

    def _friction_rates(
        self, other: Literal["body", "pair"], low: _Rough, high: _Rough
    ) -> dict[Kind, Floats]:
        """Return how friction with a body, surface or sheet differs, in its own shape."""
        kinetic: Kind = "friction_of_body" if other == "body" else "friction_of_pair"
        rates = {kinetic: (np.asarray(high.mu, float) - np.asarray(low.mu, float)) / self._width}
        # Where nothing holds more than it does while it slides, there is one coefficient.
        if _static_friction(low) is None and _static_friction(high) is None:
            return rates
        static: Kind = "static_friction_of_body" if other == "body" else "static_friction_of_pair"
        ends = [
            np.asarray(end.mu if end.mu_static is None else end.mu_static, float)
            for end in (low, high)
        ]
        return {**rates, static: (ends[1] - ends[0]) / self._width}

    def _pairs(self) -> list[Term]:
        """Return terms of friction between sheets, and between sheets and surfaces."""
        terms = []
        sheets = sheet_count(self._low.mesh.rest, self._low.mesh.triangles)
        if self._low.self_contact is not None and self._high.self_contact is not None:
            contacts = self._low.self_contact, self._high.self_contact
            for kind, rates in self._friction_rates("pair", *contacts).items():
                by_sheets = np.broadcast_to(rates, (sheets, sheets))
                for first, second in zip(*np.triu_indices(sheets), strict=True):
                    if by_sheets[first, second]:
                        rate = float(by_sheets[first, second])
                        terms.append(Term(kind, int(first), int(second), rate))
        for number, (a, b) in enumerate(
            zip(self._low.surfaces, self._high.surfaces, strict=True), start=sheets
        ):
            for kind, rates in self._friction_rates("pair", a, b).items():
                by_sheet = np.broadcast_to(rates, sheets)
                for sheet in np.flatnonzero(by_sheet):
                    terms.append(Term(kind, int(sheet), number, float(by_sheet[sheet])))
        return terms

    def start_rates(self, scene: Scene) -> Floats:
        """Return the derivative of the positions at the start: (V, 3) [m per unit].

        `scene` is the one between both, with its hung shapes.
        """
        rates = (self._high.start - self._low.start) / self._width
        terms = self._fabrics()
        for number, hanging in enumerate(scene.hangings):
            low, high = self._low.hangings[number].hung, self._high.hangings[number].hung
            vertices = slice(hanging.begin, hanging.begin + len(hanging.mesh.rest))
            of_sheet = [
                replace(term, first=-1) for term in terms if term.first in (-1, hanging.sheet)
            ]
            drive = DriveRates(
                held=rates[vertices][hanging.hung.held],
                gravity=(high.gravity - low.gravity) / self._width,
            )
            rates[vertices] = rest_rates(hanging, of_sheet, drive, scene.kernel)
        return np.asarray(rates)

    def check_the_rest(self) -> None:
        """Check that nothing else differs between the two scenes.

        Raises:
            UnfitParameterError: Something else differs.
        """
        low, high = self._low, self._high
        if not np.array_equal(low.mesh.rest, high.mesh.rest):
            self._refuse("the mesh of a sheet")
        if (low.frames, low.frame_rate) != (high.frames, high.frame_rate):
            self._refuse("the number of frames")
        for a, b in zip(low.holders, high.holders, strict=True):
            if a.grasp != b.grasp:
                self._refuse("the time at which a holder takes hold or lets go")
            if not np.array_equal(a.vertices, b.vertices):
                self._refuse("the vertices of a holder")
        self._check_contact()
        for time in np.arange(low.frames) / low.frame_rate:
            self._check_at(float(time))

    def _check_contact(self) -> None:
        contacts = [self._low.self_contact, self._high.self_contact]
        thicknesses = [contact.thickness for contact in contacts if contact is not None]
        if any(not np.array_equal(thickness, thicknesses[0]) for thickness in thicknesses):
            self._refuse("the thickness of a sheet")
        for a, b in zip(self._low.surfaces, self._high.surfaces, strict=True):
            if (a.thickness, a.crease) != (b.thickness, b.crease):
                self._refuse("the thickness of a mesh")

    def _check_at(self, time: float) -> None:
        if self._low.damping(time) != self._high.damping(time):
            self._refuse("the damping")
        for a, b in zip(self._low.surfaces, self._high.surfaces, strict=True):
            if not np.array_equal(a.at(time), b.at(time)):
                self._refuse("the positions of a mesh")
        for body, changed in zip(
            self._low.motion(time)[1], self._high.motion(time)[1], strict=True
        ):
            if _shape_of(body) != _shape_of(changed):
                self._refuse("the shape of a body")

    def _refuse(self, quantity: str) -> None:
        raise UnfitParameterError(
            f"parameter: a run cannot be differentiated by {self._name!r}, which changes {quantity}"
        )


def _static_friction(thing: _Rough) -> ArrayLike | None:
    """Return the friction at rest, or None if it is that of sliding."""
    if thing.mu_static is None or np.array_equal(thing.mu_static, thing.mu):
        return None
    return thing.mu_static


def _shape_of(body: Body) -> tuple[Any, ...]:
    return body.shape, body.core, body.radius


def rest_rates(
    hanging: Hanging, terms: Sequence[Term], drive: DriveRates, kernel: str | None
) -> Floats:
    """Return the derivative of a hung shape: (V, 3) [m per unit].

    At rest K dx = -dR/dp, where K is the stiffness and R the sum of forces. Steps of
    `AT_REST_STEP` solve that, since their inertia is next to nothing.

    Args:
        hanging: The sheet, which hangs at rest.
        terms: Changes of its fabric by the parameter.
        drive: How the held vertices and gravity depend on the parameter.
        kernel: Level of the kernels, see `Cloth`.
    """
    shape = hanging.hung
    if not (terms or drive.held.any() or drive.gravity.any()):
        return np.zeros_like(shape.positions)
    cloth = Cloth(hanging.mesh, hanging.fabric, HANGING, held=shape.held, kernel=kernel)
    cloth.gravity = shape.gravity
    cloth.set_state(shape.positions)
    cloth.follow([Parameter(tuple(terms), lambda _time: drive)])
    for _ in range(AT_REST_STEPS):
        cloth.step(AT_REST_STEP, held=shape.positions[shape.held])
    return np.asarray(cloth.sensitivities[0])
