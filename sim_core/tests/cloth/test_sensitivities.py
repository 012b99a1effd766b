"""Derivatives of runs of cloth against closed forms, and against differences of runs.

Runs have fixed steps, so that all of them take the same. A difference of two runs is wrong where a
contact changes its branch between them, and where the run itself jumps. Steps of the differences
are therefore small, and the solver's tolerance is smaller still.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface, box, cylinder, plane
from stickslip_sim_core.cloth.fabrics import Fabric, fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.sensitivities import (
    DriveRates,
    FabricProperty,
    Parameter,
    drive,
    fabric_factor,
    friction,
    pair_friction,
)
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

# Of second order a run jumps where a vertex lands or leaves, by up to half a millimetre in steps of
# 10 ms: another scheme takes it there.
TIGHT = replace(preset_named("certified"), tolerance=1e-9, second_order=False)
SLOPE = np.deg2rad(25.0)
STEP = 0.01
TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns the axis of a cylinder from z to y."""


def sheet_on_incline(mu: float, *, follow: bool, steps: int = 40) -> Cloth:
    mesh = meshes.grid(0.1, 0.1, 8, 8)
    cloth = Cloth(mesh, fabric("gray-interlock"), TIGHT)
    cloth.gravity[:] = GRAVITY * np.array([np.sin(SLOPE), 0.0, -np.cos(SLOPE)])
    cloth.set_state(np.column_stack([mesh.rest, np.zeros(len(mesh.rest))]), bodies=[plane(mu)])
    if follow:
        cloth.follow([friction(0)])
    for _ in range(steps):
        cloth.step(STEP, bodies=[plane(mu)])
    return cloth


def test_sliding_sheet_follows_its_closed_form() -> None:
    # x = g (sin a - mu cos a) t^2/2, and steps are exact under a constant force.
    steps = 40
    by_mu = sheet_on_incline(0.2, follow=True, steps=steps).sensitivities[0]
    expected = -GRAVITY * np.cos(SLOPE) * (steps * STEP) ** 2 / 2
    np.testing.assert_allclose(by_mu[:, 0], expected, rtol=2e-8)
    np.testing.assert_allclose(by_mu[:, 1:], 0.0, atol=1e-7)


def test_sheet_that_sticks_does_not_depend_on_friction() -> None:
    cloth = sheet_on_incline(0.5, follow=True)
    assert np.array_equal(cloth.sensitivities, np.zeros((1, 81, 3)))
    # It begins to slide at tan a, 0.466.
    assert cloth.nearest_events[0] == pytest.approx(0.5 - np.tan(SLOPE), rel=0.05)


@dataclass(frozen=True, kw_only=True)
class Strip:
    """A strip that is held at one end, and what depends on a parameter, which is 0 in the run."""

    parameter: Parameter
    fabric: Callable[[float], Fabric] = lambda _value: fabric("gray-interlock")
    holders: Callable[[float, float], Floats] = lambda _value, _time: np.zeros(3)
    gravity: Callable[[float], tuple[float, float, float]] = lambda _value: (0.0, 0.0, -GRAVITY)
    bodies: Callable[[float, float], list[Body]] = lambda _value, _time: []
    surfaces: Callable[[float], list[Surface]] = lambda _value: []
    released: int = 1000
    """Number of the step before which the strip is let go."""
    steps: int = 30
    bound: float = 1e-5
    change: float = 1e-5

    def run(self, value: float, *, follow: bool) -> Cloth:
        mesh = meshes.grid(0.1, 0.04, 10, 4)
        x = mesh.rest[:, 0]
        held = np.flatnonzero(x < x.min() + 0.011)
        cloth = Cloth(mesh, self.fabric(value), TIGHT, held=held, surfaces=self.surfaces(value))
        cloth.gravity[:] = self.gravity(value)
        start = np.column_stack([mesh.rest, np.full(len(x), 0.02)])
        cloth.set_state(start, bodies=self.bodies(value, 0.0))
        if follow:
            cloth.follow([self.parameter])
        for number in range(self.steps):
            time = (number + 1) * STEP
            if number == self.released:
                cloth.hold([], self.bodies(value, time - STEP))
            ends = start[cloth.held] + self.holders(value, time)
            cloth.step(STEP, held=ends, bodies=self.bodies(value, time))
        return cloth


def rod(mu: float, height: float, angle: float) -> Body:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return replace(cylinder(mu, 0.012), origin=np.array([0.0, 0.0, height]), rotation=turn @ TURNED)


def hill(mu: float) -> Surface:
    """Return a smooth mound under the strip."""
    columns, rows = 13, 9
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, columns), np.linspace(-0.06, 0.06, rows))
    z = 0.012 * np.exp(-((x / 0.05) ** 2)) - 0.005
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    number = np.arange(rows * columns).reshape(rows, columns)
    lower_left, lower_right = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    upper_left, upper_right = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    below = np.column_stack([lower_left, lower_right, upper_right])
    above = np.column_stack([lower_left, upper_right, upper_left])
    triangles = np.concatenate([below, above]).astype(np.int32)
    return Surface(triangles, lambda _time: points, mu=mu)


CASES = {
    "density": Strip(
        parameter=fabric_factor("density"),
        fabric=lambda value: fabric("gray-interlock").scaled(density=np.exp(value)),
    ),
    "stretching": Strip(
        parameter=fabric_factor("stretching"),
        fabric=lambda value: fabric("gray-interlock").scaled(stretching=np.exp(value)),
    ),
    "bending": Strip(
        parameter=fabric_factor("bending"),
        fabric=lambda value: fabric("gray-interlock").scaled(bending=np.exp(value)),
    ),
    "bending of a fabric that softens": Strip(
        parameter=fabric_factor("bending"),
        fabric=lambda value: replace(
            fabric("gray-interlock").scaled(bending=np.exp(value)), softening=160.0
        ),
    ),
    "bending of a fabric that stiffens": Strip(
        parameter=fabric_factor("bending"),
        fabric=lambda value: fabric("navy-sparkle-sweat").scaled(bending=np.exp(value)),
    ),
    "holders": Strip(
        parameter=drive(lambda time: DriveRates(held=np.tile([0.0, 0.0, time], (10, 1)))),
        holders=lambda value, time: np.array([0.0, 0.0, (0.1 + value) * time]),
    ),
    "gravity": Strip(
        parameter=drive(lambda _time: DriveRates(gravity=np.tile([1.0, 0.0, 0.0], (55, 1)))),
        gravity=lambda value: (value, 0.0, -GRAVITY),
    ),
    "a strip that is let go": Strip(
        parameter=fabric_factor("bending"),
        fabric=lambda value: fabric("gray-interlock").scaled(bending=np.exp(value)),
        released=20,
    ),
    "a rod that rises": Strip(
        parameter=drive(
            lambda time: DriveRates(bodies=[(np.array([0.0, 0.0, time]), np.zeros(3))])
        ),
        bodies=lambda value, time: [rod(0.3, 0.005 + (0.02 + value) * time, 0.0)],
        steps=40,
    ),
    "a rod that turns": Strip(
        parameter=drive(
            lambda time: DriveRates(bodies=[(np.zeros(3), np.array([0.0, time, 0.0]))])
        ),
        bodies=lambda value, time: [rod(0.3, 0.0, (1.0 + value) * time)],
        steps=40,
        change=1e-4,
    ),
    "friction of a rod that turns": Strip(
        parameter=friction(0),
        bodies=lambda value, time: [rod(0.3 + value, 0.0, 5.0 * time)],
        steps=40,
    ),
    "friction of a box": Strip(
        parameter=friction(0),
        bodies=lambda value, _time: [
            box(0.2 + value, (0.04, 0.2, 0.04), rounding=0.012, origin=(0.0, 0.0, -0.022))
        ],
        steps=40,
        # Vertices cross from the flat face to the round edge, where the curvature jumps.
        bound=1e-4,
    ),
    "friction of a surface": Strip(
        parameter=pair_friction(0, 1),
        surfaces=lambda value: [hill(0.2 + value)],
        steps=40,
        bound=1e-4,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_runs(name: str) -> None:
    case = CASES[name]
    cloth = case.run(0.0, follow=True)
    by_parameter = cloth.sensitivities[0]
    h = case.change
    difference = (case.run(h, follow=False).positions - case.run(-h, follow=False).positions) / (
        2.0 * h
    )
    size = np.linalg.norm(by_parameter)
    assert size > 0.0
    assert np.linalg.norm(difference - by_parameter) < case.bound * size
    report = cloth.sensitivity_report
    assert report.unrefined == 0


def sheet_over_held_sheet(mu: float, *, follow: bool) -> Cloth:
    lower = meshes.grid(0.08, 0.08, 6, 6)
    upper = meshes.grid(0.05, 0.05, 5, 5)
    count = len(lower.rest)
    cloth = Cloth(
        meshes.together(lower, upper),
        [fabric("gray-interlock")] * 2,
        TIGHT,
        held=np.arange(count),
        self_contact=SelfContact(mu=mu, thickness=5e-4, bearing="first"),
    )
    down = np.array([0.9 * np.sin(SLOPE), 0.3 * np.sin(SLOPE), -np.cos(SLOPE)])
    cloth.gravity[:] = GRAVITY * down
    flat = np.vstack([lower.rest, upper.rest + 7e-4])
    height = np.append(np.zeros(count), np.full(len(upper.rest), 5e-4))
    start = np.column_stack([flat, height])
    cloth.set_state(start)
    if follow:
        cloth.follow([pair_friction(0, 1)])
    for _ in range(10):
        cloth.step(STEP, held=start[:count])
    return cloth


def test_friction_between_sheets() -> None:
    # The run jumps where closest points change to other edges, so one side of both must agree.
    mu, h = 0.2, 1e-4
    cloth = sheet_over_held_sheet(mu, follow=True)
    by_mu = cloth.sensitivities[0]
    sides = [
        (sheet_over_held_sheet(mu + change, follow=False).positions - cloth.positions) / change
        for change in (h, -h)
    ]
    errors = [np.linalg.norm(side - by_mu) / np.linalg.norm(by_mu) for side in sides]
    assert min(errors) < 2e-3


def test_positions_have_the_same_bits() -> None:
    case = CASES["friction of a rod that turns"]
    plain = case.run(0.0, follow=False)
    assert np.array_equal(plain.positions, case.run(0.0, follow=True).positions)


def test_parameters_solved_together_are_those_solved_alone() -> None:
    # Five are more than go through the factor at once.
    names: list[FabricProperty] = [
        "density",
        "stretching",
        "bending",
        "bending_warp",
        "bending_twist",
    ]
    parameters = [fabric_factor(name) for name in names]

    def swung(by: list[Parameter]) -> Floats:
        mesh = meshes.grid(0.1, 0.04, 10, 4)
        held = np.flatnonzero(mesh.rest[:, 0] < mesh.rest[:, 0].min() + 0.011)
        cloth = Cloth(mesh, fabric("gray-interlock"), TIGHT, held=held)
        start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
        cloth.set_state(start)
        cloth.follow(by)
        for _ in range(20):
            cloth.step(STEP, held=start[cloth.held])
        return cloth.sensitivities

    for together, parameter in zip(swung(parameters), parameters, strict=True):
        alone = swung([parameter])[0]
        assert np.linalg.norm(together - alone) < 1e-5 * np.linalg.norm(alone)


def test_derivatives_between_the_ends_of_a_step() -> None:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"))
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 1.0)])
    cloth.set_state(start)
    by_gravity = DriveRates(gravity=np.tile([0.0, 0.0, -1.0], (len(start), 1)))
    cloth.follow([drive(lambda _time: by_gravity)])
    gravity = cloth.gravity
    cloth.advance(0.1, lambda _time: (gravity, np.empty((0, 3)), []))
    time = 0.5 * (cloth.last_begin + cloth.time)
    # z = z0 - g t^2/2.
    np.testing.assert_allclose(cloth.sensitivities_at(time)[0, :, 2], -0.5 * time**2, rtol=1e-6)


def test_parameters_that_are_not_there_are_refused() -> None:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"))
    with pytest.raises(ValueError, match="of two sheets, or of a sheet and a surface"):
        cloth.follow([pair_friction(0, 0)])
    with pytest.raises(ValueError, match="one of 1 sheets, got sheet 1"):
        cloth.follow([friction(0, sheet=1)])
    cloth.follow([friction(1)])
    with pytest.raises(ValueError, match="one of 1 bodies, got 1"):
        cloth.step(0.01, bodies=[plane(0.3, origin=(0.0, 0.0, -1.0))])


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        (DriveRates(held=np.zeros((2, 3))), r"held must be empty or \(10, 3\), got \(2, 3\)"),
        (DriveRates(gravity=np.zeros((3, 3))), r"gravity must be empty or \(55, 3\)"),
        (DriveRates(bodies=[(np.zeros(3), np.zeros(3))]), "bodies must be none or all 0, got 1"),
    ],
)
def test_rates_of_other_things_are_refused(rates: DriveRates, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Strip(parameter=drive(lambda _time: rates)).run(0.0, follow=True)
