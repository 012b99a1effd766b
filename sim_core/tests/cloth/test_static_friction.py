"""Static and kinetic friction: what rests holds more than what slides."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, SelfContact, Surface, plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.sensitivities import friction
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import tilted
from stickslip_sim_core.scenes import cloth_drag

STATIC, KINETIC = 0.5, 0.35
ALONG = np.array([np.cos(0.5), np.sin(0.5), 0.0])
"""Down the slope of `tilted`."""

FLOOR = replace(plane(KINETIC), mu_static=STATIC)


def patch_on(
    slope: float, bodies: Sequence[Body], surfaces: Sequence[Surface] = (), speed: float = 0.0
) -> tuple[Cloth, Floats]:
    """A patch on a slope whose normal is z; it moves down the slope."""
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"), surfaces=surfaces)
    height = 5e-4 if surfaces else 0.0
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), height)])
    cloth.gravity[:] = tilted(np.arctan(slope))
    cloth.set_state(start, np.tile(speed * ALONG, (len(start), 1)), bodies)
    return cloth, start


def advance(cloth: Cloth, until: float, bodies: Sequence[Body]) -> None:
    """Advance under the gravity that the cloth has, with bodies that do not move."""
    gravity, nothing_held = cloth.gravity.copy(), np.empty((0, 3))
    cloth.advance(until, lambda _time: (gravity, nothing_held, bodies))


def slid(
    slope: float,
    until: float,
    bodies: Sequence[Body] = (FLOOR,),
    surfaces: Sequence[Surface] = (),
    speed: float = 0.0,
) -> float:
    """How far a patch slides down a slope in a time [s]: mean, in m."""
    cloth, start = patch_on(slope, bodies, surfaces, speed)
    advance(cloth, until, bodies)
    assert cloth.total.unconverged == 0
    return float((cloth.positions_at(until) - start).mean(axis=0) @ ALONG)


def gain(slope: float, mu: float = KINETIC) -> float:
    """Acceleration down a slope [m/s^2]."""
    alpha = np.arctan(slope)
    return float(GRAVITY * (np.sin(alpha) - mu * np.cos(alpha)))


SQUARE = ([[0, 1, 2], [0, 2, 3]], np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 1.0)


class TestOnset:
    @pytest.mark.parametrize("on_surface", [False, True])
    def test_holds_up_to_static_friction_and_slides_with_kinetic(self, on_surface: bool) -> None:
        surfaces = [Surface(*SQUARE, KINETIC, 5e-4, mu_static=STATIC)] if on_surface else []
        bodies = [] if on_surface else [FLOOR]
        assert abs(slid(0.998 * STATIC, 0.5, bodies, surfaces)) < 1e-12
        moved = slid(1.002 * STATIC, 0.5, bodies, surfaces)
        assert moved == pytest.approx(gain(1.002 * STATIC) * 0.5**2 / 2, rel=1e-4)

    def test_sheet_on_a_sheet(self) -> None:
        below, above = meshes.grid(0.5, 0.5, 10, 10), meshes.grid(0.1, 0.1, 4, 4)
        contact = SelfContact(
            [[0.5, KINETIC], [KINETIC, 0.5]], mu_static=[[0.5, STATIC], [STATIC, 0.5]]
        )
        moved = []
        for share in (0.98, 1.02):
            cloth = Cloth(
                meshes.together(below, above),
                fabric("gray-interlock"),
                preset_named("certified"),
                self_contact=contact,
            )
            heights = np.repeat([0.0, 5e-4], [len(below.rest), len(above.rest)])
            start = np.column_stack([np.concatenate([below.rest, above.rest]), heights])
            floor = [plane(1.5)]
            cloth.set_state(start, bodies=floor)
            cloth.gravity[:] = tilted(np.arctan(share * STATIC))
            advance(cloth, 0.3, floor)
            way = (cloth.positions_at(0.3) - start) @ ALONG
            moved.append(way[len(below.rest) :].mean())
        assert abs(moved[0]) < 1e-9
        assert moved[1] == pytest.approx(gain(1.02 * STATIC) * 0.3**2 / 2, rel=2e-3)


class TestSliding:
    """Between the two cones it depends on the motion whether cloth slides."""

    def test_goes_on_where_it_would_hold_at_rest(self) -> None:
        slope = 0.45
        moved = slid(slope, 0.5, speed=0.1)
        assert moved == pytest.approx(0.1 * 0.5 + gain(slope) * 0.5**2 / 2, rel=1e-4)

    @pytest.mark.parametrize("slope", [0.37, 0.4, 0.43, 0.46, 0.49])
    def test_holds_where_it_comes_to_rest(self, slope: float) -> None:
        """Thrown up the slope; kinetic friction alone would not hold it where it turns back."""
        speed = 0.6
        loss = GRAVITY * (np.sin(np.arctan(slope)) + KINETIC * np.cos(np.arctan(slope)))
        for times in (1.5, 4.0):
            up = -slid(slope, times * speed / loss, speed=-speed)
            assert up == pytest.approx(speed**2 / (2.0 * loss), rel=1e-3)

    def test_turns_back_beyond_static_friction(self) -> None:
        slope, speed = 0.6, 0.6
        loss = GRAVITY * (np.sin(np.arctan(slope)) + KINETIC * np.cos(np.arctan(slope)))
        up, down = speed**2 / (2.0 * loss), 0.4
        until = speed / loss + down
        assert slid(slope, until, speed=-speed) == pytest.approx(
            gain(slope) * down**2 / 2 - up, rel=2e-2
        )


class TestSameCoefficients:
    def test_bits(self) -> None:
        runs = []
        for floor in (plane(0.5), replace(plane(0.5), mu_static=0.5)):
            cloth, _ = patch_on(0.52, [floor], speed=0.1)
            advance(cloth, 0.5, [floor])
            runs.append(cloth.positions)
        assert np.array_equal(runs[0], runs[1])

    def test_bits_of_a_pile(self) -> None:
        runs = []
        for contact in (SelfContact(0.4), SelfContact(0.4, mu_static=0.4)):
            mesh = meshes.grid(0.1, 0.1, 8, 8)
            cloth = Cloth(
                mesh, fabric("gray-interlock"), preset_named("certified"), self_contact=contact
            )
            bent = np.column_stack(
                [np.abs(mesh.rest[:, 0]), mesh.rest[:, 1], 0.03 + 0.02 * np.sign(mesh.rest[:, 0])]
            )
            bent[np.abs(mesh.rest[:, 0]) < 1e-9, 2] = 0.03
            cloth.set_state(bent)
            advance(cloth, 0.1, [plane(0.5)])
            runs.append(cloth.positions)
        assert np.array_equal(runs[0], runs[1])


@pytest.mark.physics
def test_drag_differs_only_with_a_ratio() -> None:
    family = cloth_drag.family("gray-interlock", 0.4, mesh=9, frames=60)
    runs = [family.scene(static_ratio=ratio).run().positions for ratio in (1.0, 1.5)]
    plain = cloth_drag.scene("gray-interlock", 0.4, mesh=9, frames=60).run().positions
    assert np.array_equal(runs[0], plain)
    assert np.abs(runs[1] - plain).max() > 1e-4


def test_parameters_of_a_drag_change_both_coefficients() -> None:
    family = cloth_drag.family("gray-interlock", 0.4, static_ratio=1.5, mesh=5, frames=1)
    by_mu, by_ratio = family.differentiated(["mu", "static_ratio"]).sensitivities
    assert [(term.kind, term.first, round(term.rate, 6)) for term in by_mu.terms] == [
        ("friction_of_body", 0, 1.0),
        ("static_friction_of_body", 0, 1.5),
    ]
    assert [(term.kind, term.first, round(term.rate, 6)) for term in by_ratio.terms] == [
        ("static_friction_of_body", 0, 0.4)
    ]


class TestSensitivities:
    def followed(self, slope: float) -> Cloth:
        cloth, _ = patch_on(slope, [FLOOR])
        cloth.follow([friction(0), friction(0, static=True)])
        for _ in range(20):
            cloth.step(0.01, bodies=[FLOOR])
        return cloth

    def test_what_slides_depends_on_the_kinetic_coefficient(self) -> None:
        by_kinetic, by_static = self.followed(1.1 * STATIC).sensitivities
        alpha = np.arctan(1.1 * STATIC)
        expected = -GRAVITY * np.cos(alpha) * 0.2**2 / 2 * ALONG
        np.testing.assert_allclose(by_kinetic, np.tile(expected, (25, 1)), rtol=1e-6, atol=1e-9)
        assert np.array_equal(by_static, np.zeros((25, 3)))

    def test_what_rests_is_set_off_by_the_static_coefficient(self) -> None:
        cloth = self.followed(0.9 * STATIC)
        assert np.array_equal(cloth.sensitivities, np.zeros((2, 25, 3)))
        by_kinetic, by_static = cloth.nearest_events
        assert by_kinetic == np.inf
        assert by_static == pytest.approx(0.1 * STATIC, rel=1e-3)


@pytest.mark.parametrize(
    ("mu", "mu_static", "rule"),
    [
        (0.5, 0.4, r"mu_static: must be in \[mu, 10\], and mu is 0.5, got 0.4"),
        (0.5, np.nan, r"mu_static: must be in \[mu, 10\]"),
        (0.5, np.inf, r"mu_static: must be in \[mu, 10\]"),
        ([0.5, 0.5], 0.6, r"mu_static: must have the shape of mu, \(2,\), got \(\)"),
    ],
)
def test_wrong_numbers(mu: object, mu_static: object, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        replace(plane(mu), mu_static=mu_static)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=rule):
        Surface(*SQUARE, mu, mu_static=mu_static)  # type: ignore[arg-type]
    if not isinstance(mu, list):
        with pytest.raises(ValueError, match=rule):
            SelfContact(mu, mu_static=mu_static)  # type: ignore[arg-type]
