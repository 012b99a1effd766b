"""Cloth that feels itself and other cloth: nothing crosses, friction is exact, and without contact nothing changes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import Cloth, SelfContact, fabric, isotropic, plane, preset_named, self_intersections
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.protocols import stacked_incline
from stickslip_sim_core.protocols.inclined_plane import tilted

Floats = NDArray[np.float64]

CERTIFIED = preset_named("certified")
THICKNESS = 5e-4
MATERIAL = fabric("gray-interlock")
SOFT = isotropic(0.2, 100.0, 1e-6)


def stack(mu: float, cells: int = 4, preset: str = "certified") -> stacked_incline.Stack:
    """Two sheets on a floor, 0.5 mm from each other."""
    return stacked_incline.Stack(2, mu, preset_named(preset), cells)


def watched(cloth: Cloth, steps: int, dt: float = 0.02, **drive: object) -> int:
    """Step, check that nothing crosses after any step, and return how many did not converge."""
    before = cloth.unconverged_steps
    for _ in range(steps):
        cloth.step(dt, **drive)  # type: ignore[arg-type]
        assert self_intersections(cloth.positions, cloth.mesh.triangles) == 0
    return cloth.unconverged_steps - before


class TestWithoutContact:
    def test_results_are_the_same_to_the_bit(self) -> None:
        """Of a sheet that is pulled over a floor."""
        mesh = meshes.unstructured(0.1, 0.1, 0.0125, 3)

        def run(self_contact: SelfContact | None) -> bytes:
            cloth = Cloth(mesh, MATERIAL, CERTIFIED, held=[0], self_contact=self_contact)
            start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.002)])
            cloth.set_state(start)
            for step in range(20):
                cloth.step(0.02, held=start[[0]] - 0.0002 * step * np.array([1.0, 1.0, 0.0]), bodies=[plane(0.3)])
            assert cloth.least_distance == np.inf
            assert cloth.sliding.any()
            return cloth.positions.tobytes()

        assert run(None) == run(SelfContact(0.5))


class TestStack:
    def test_upper_sheet_rests_on_the_lower_one(self) -> None:
        two = stack(0.5)
        cloth = two.cloth
        assert watched(cloth, 50, bodies=two.floor) == 0
        pairs = cloth.pair_forces
        upper = two.level == 1
        assert pairs.distance == pytest.approx(THICKNESS, abs=1e-9)
        # Forces on the upper sheet: weights of its vertices add up to 1 or, where it is the second of a pair, to -1.
        on_upper = (pairs.weights * upper[pairs.vertices]).sum(axis=1)
        assert np.abs(on_upper) == pytest.approx(1.0)
        weight = cloth.masses[upper].sum() * GRAVITY
        assert on_upper @ pairs.forces == pytest.approx(np.array([0.0, 0.0, weight]), abs=1e-4 * weight)
        assert cloth.reactions.sum(axis=0)[2] == pytest.approx(cloth.masses.sum() * GRAVITY, rel=1e-4)

    @pytest.mark.parametrize("mu", [0.1, 1.5])
    def test_does_not_move_below_the_slip_angle(self, mu: float) -> None:
        two = stack(mu)
        two.cloth.gravity[:] = tilted(0.9 * np.arctan(mu))
        assert watched(two.cloth, 100, bodies=two.floor) == 0
        assert two.moved().max() < 1e-8

    @pytest.mark.parametrize("mu", [0.0, 0.1, 0.8])
    def test_accelerates_beyond_it(self, mu: float) -> None:
        """With g (sin a - mu cos a); the lower sheet stays, since the floor is rough."""
        two = stack(mu)
        two.floor = [plane(10.0)]
        angle = np.arctan(mu) + 0.1
        two.cloth.gravity[:] = tilted(angle)
        dt, steps = 0.01, 8
        assert watched(two.cloth, steps, dt, bodies=two.floor) == 0
        upper = two.level == 1
        speed = np.linalg.norm(two.cloth.velocities[upper].mean(axis=0))
        assert speed / (dt * steps) == pytest.approx(GRAVITY * (np.sin(angle) - mu * np.cos(angle)), rel=5e-3)
        assert two.moved()[~upper].max() < 1e-8

    def test_each_two_sheets_have_their_own_friction(self) -> None:
        """Of three sheets the upper two slide together on the lowest, where friction is least."""
        three = stacked_incline.Stack(3, 0.3, CERTIFIED, 3)
        three.cloth.gravity[:] = tilted(np.arctan(0.3) + 0.03)
        assert watched(three.cloth, 25, bodies=three.floor) == 0
        moved = [three.moved()[three.level == level] for level in range(3)]
        assert moved[0].max() < 1e-8
        assert moved[1].min() > 1e-3
        assert moved[2] == pytest.approx(np.full(len(moved[2]), moved[1].mean()), rel=2e-3)

    def test_measures_mu(self) -> None:
        result = stacked_incline.run(friction=(0.3,), sheets=(2,), cells=4, unstructured=0)
        assert result.passed
        assert result.settings["unconverged_steps"] == 0
        assert result.settings["least_distance_over_thickness"] >= 0.99  # type: ignore[operator]

    def test_a_stack_that_creeps_has_no_slip_angle(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(stacked_incline.Stack, "drift", lambda _: 2e-5)
        monkeypatch.setattr(stacked_incline.Stack, "slip_slope", lambda _: 0.3)
        assert not stacked_incline.run(friction=(0.3,), sheets=(2,), cells=3, unstructured=0).passed


class TestNothingCrosses:
    @pytest.mark.parametrize("seed", range(3))
    def test_crumpled_sheet_that_falls(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        mesh = meshes.unstructured(0.1, 0.1, 0.01, seed)
        cloth = Cloth(mesh, SOFT, CERTIFIED, self_contact=SelfContact(float(rng.uniform(0.0, 1.0))))
        u, v = mesh.rest.T
        wave = 0.006 * np.sin(80.0 * u + rng.uniform(0, 6)) + 0.003 * np.sin(150.0 * v + rng.uniform(0, 6))
        cloth.set_state(np.column_stack([0.7 * u, wave, 0.08 + 0.9 * v]))
        unconverged = watched(cloth, 60, 0.01, bodies=[plane(0.4)])
        assert cloth.least_distance < 1.01 * THICKNESS  # it did touch itself
        assert cloth.least_distance > 0.9 * THICKNESS
        assert unconverged <= 1

    def test_held_vertices_do_not_pass_through(self) -> None:
        """A sheet is pushed through another one, both of them held: the step is counted as unconverged."""
        a, b = meshes.grid(0.05, 0.05, 5, 5), meshes.grid(0.02, 0.02, 2, 2)
        mesh = meshes.together(a, b)
        held = np.arange(len(mesh.rest) - 1)
        hasty = replace(CERTIFIED, halvings_max=1, newton_max=10)
        cloth = Cloth(mesh, MATERIAL, hasty, held=held, self_contact=SelfContact(0.3))
        start = np.concatenate(
            [np.column_stack([a.rest, np.zeros(len(a.rest))]), np.column_stack([b.rest, np.full(len(b.rest), 0.001)])]
        )
        cloth.set_state(start)
        ends = start[held].copy()
        ends[len(a.rest) :, 2] = -0.02
        report = cloth.step(0.02, held=ends)
        assert not report.converged
        assert cloth.unconverged_steps == 1
        assert self_intersections(cloth.positions, mesh.triangles) == 0
        assert cloth.positions[len(a.rest) :, 2].min() > 0.0
        ends[len(a.rest) :, 2] = 0.002
        assert cloth.step(0.02, held=ends).converged

    def test_sheets_that_collide_keep_their_momentum(self) -> None:
        a, b = meshes.grid(0.05, 0.05, 4, 4), meshes.unstructured(0.05, 0.05, 0.012, 2)
        mesh = meshes.together(a, b)
        cloth = Cloth(mesh, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5))
        cloth.gravity[:] = 0.0
        rest = np.concatenate([a.rest, b.rest])
        level = np.repeat([0, 1], [len(a.rest), len(b.rest)])
        speed = np.where(level == 0, 0.2, -0.1)[:, None] * np.array([0.2, 0.0, 1.0])
        cloth.set_state(np.column_stack([rest, 0.004 * level]), speed)
        before = cloth.masses @ cloth.velocities
        assert watched(cloth, 10, 0.01) == 0
        after = cloth.masses @ cloth.velocities
        size = cloth.masses @ np.linalg.norm(speed, axis=1)
        tolerated = CERTIFIED.tolerance * cloth.force_scale * len(rest) * 0.1  # residuals times time
        assert np.abs(after - before).max() < tolerated
        assert tolerated < 1e-3 * size
        assert cloth.velocities[level == 1, 2].mean() > -0.05  # they did collide

    def test_rerun_is_bit_identical(self) -> None:
        def run() -> tuple[bytes, bytes]:
            two = stacked_incline.Stack(2, 0.5, CERTIFIED, 4, 1)
            two.cloth.gravity[:] = tilted(np.arctan(0.5) + 0.05)
            for _ in range(12):
                two.cloth.step(0.02, bodies=two.floor)
            assert len(two.cloth.pair_forces.forces) > 0
            return two.cloth.positions.tobytes(), two.cloth.pair_forces.forces.tobytes()

        assert run() == run()


class TestRefusals:
    MESH = meshes.grid(0.1, 0.1, 8, 8)

    @pytest.mark.parametrize("mu", [-0.1, 10.1, float("nan"), [[0.1, 0.2], [0.3, 0.1]], [0.1, 0.2]])
    def test_friction(self, mu: object) -> None:
        with pytest.raises(ValueError, match="mu: must be"):
            SelfContact(np.asarray(mu, float))

    @pytest.mark.parametrize("thickness", [0.0, -1.0, float("nan")])
    def test_thickness(self, thickness: float) -> None:
        with pytest.raises(ValueError, match="thickness: must be finite and > 0"):
            SelfContact(0.5, thickness)

    def test_thickness_of_a_fine_mesh(self) -> None:
        with pytest.raises(ValueError, match="thickness: must be less than the distance at rest"):
            Cloth(self.MESH, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5, 0.009))

    def test_number_of_sheets(self) -> None:
        with pytest.raises(ValueError, match="mu: must be of 1 sheets"):
            Cloth(self.MESH, MATERIAL, CERTIFIED, self_contact=SelfContact(np.full((2, 2), 0.1)))

    def test_state_that_crosses_itself(self) -> None:
        mesh = meshes.together(self.MESH, self.MESH)
        cloth = Cloth(mesh, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5))
        flat = np.column_stack([self.MESH.rest, np.zeros(81)])
        with pytest.raises(ValueError, match="must not cross itself"):
            cloth.set_state(np.concatenate([flat, flat[:, [0, 2, 1]] + [0.0, 0.001, 0.0]]))
