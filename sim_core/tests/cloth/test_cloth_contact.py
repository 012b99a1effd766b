"""Sheets on bodies: exact Coulomb friction, balances of momentum and energy, refusals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import (
    Body,
    Cloth,
    box,
    capsule,
    fabric,
    isotropic,
    plane,
    preset_named,
    sphere,
)
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.protocols.inclined_plane import tilted

Floats = NDArray[np.float64]

CERTIFIED = preset_named("certified")
PATCH = meshes.grid(0.1, 0.1, 8, 8)
SCATTERED = meshes.unstructured(0.1, 0.1, 0.0125, 3)
MATERIAL = fabric("gray-interlock")


def laid(mesh: Mesh = PATCH, height: float = 0.0, **settings: object) -> Cloth:
    cloth = Cloth(mesh, MATERIAL, CERTIFIED, **settings)  # type: ignore[arg-type]
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), height)]))
    return cloth


def turn(axis: int, angle: float) -> Floats:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i] = out[j, j] = np.cos(angle)
    out[i, j], out[j, i] = -np.sin(angle), np.sin(angle)
    return out


class TestFriction:
    @pytest.mark.parametrize("mu", [0.1, 0.5, 1.5])
    @pytest.mark.parametrize("mesh", [PATCH, SCATTERED], ids=["grid", "unstructured"])
    def test_patch_below_the_slip_angle_does_not_move(self, mesh: Mesh, mu: float) -> None:
        cloth = laid(mesh)
        cloth.gravity[:] = tilted(0.9 * np.arctan(mu))
        start = cloth.positions
        for _ in range(100):
            cloth.step(0.02, bodies=[plane(mu)])
        assert np.abs(cloth.positions - start).max() < 1e-15
        assert not cloth.sliding.any()
        assert (cloth.contacts == 0).all()

    @pytest.mark.parametrize("mu", [0.1, 0.5, 1.5])
    @pytest.mark.parametrize("mesh", [PATCH, SCATTERED], ids=["grid", "unstructured"])
    def test_patch_beyond_it_accelerates(self, mesh: Mesh, mu: float) -> None:
        """With g (sin a - mu cos a), to 0.5 %.

        The force that residuals are measured in has to be small beside that.
        """
        angle = 1.1 * np.arctan(mu)
        cloth = laid(mesh, force_scale=0.01 * MATERIAL.density * mesh.spacing**2 * GRAVITY)
        cloth.gravity[:] = tilted(angle)
        for _ in range(25):
            cloth.step(0.02, bodies=[plane(mu)])
        speed = np.linalg.norm(cloth.masses @ cloth.velocities) / cloth.masses.sum()
        assert speed / 0.5 == pytest.approx(
            GRAVITY * (np.sin(angle) - mu * np.cos(angle)), rel=5e-3
        )
        assert cloth.sliding.all()
        assert cloth.total.unconverged == 0

    def test_without_friction(self) -> None:
        cloth = laid()
        cloth.gravity[:] = tilted(0.3)
        for _ in range(10):
            cloth.step(0.02, bodies=[plane(0.0)])
        assert np.linalg.norm(cloth.velocities, axis=1) == pytest.approx(
            0.2 * GRAVITY * np.sin(0.3), rel=1e-3
        )

    def test_a_tilted_plane_is_tilted_gravity(self) -> None:
        """The same patch, in axes that are turned, comes as far."""
        angle = 1.2 * np.arctan(0.4)
        first = laid()
        first.gravity[:] = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        lying = first.positions
        second = laid()
        slope = turn(1, angle)
        second.set_state(lying @ slope.T)
        for _ in range(20):
            first.step(0.02, bodies=[plane(0.4)])
            second.step(0.02, bodies=[plane(0.4, normal=slope[:, 2])])
        assert second.positions @ slope == pytest.approx(first.positions, abs=1e-5)
        assert (first.positions - lying)[:, 0].min() > 0.01

    def test_each_sheet_has_its_own(self) -> None:
        """Two sheets slide on one floor, each as far as its own friction lets it."""
        patch = meshes.grid(0.05, 0.05, 4, 4)
        cloth = Cloth(
            meshes.together(patch, patch), [MATERIAL, MATERIAL], preset_named("certified")
        )
        at = np.column_stack([patch.rest, np.zeros(len(patch.rest))])
        start = np.concatenate([at, at + np.array([0.0, 0.1, 0.0])])
        cloth.set_state(start, np.tile([1.0, 0.0, 0.0], (len(start), 1)))
        for _ in range(500):
            cloth.step(0.001, bodies=[plane([0.5, 1.0])])
        way = np.split((cloth.positions - start)[:, 0], 2)
        assert way[0] == pytest.approx(1.0 / (2.0 * 0.5 * GRAVITY), rel=0.02)
        assert way[1] == pytest.approx(1.0 / (2.0 * 1.0 * GRAVITY), rel=0.02)

    def test_each_body_has_its_own(self) -> None:
        """A box is pulled from under a patch: a rough one takes it along, a smooth one does not,
        whatever the floor.
        """
        rough, smooth = laid(meshes.grid(0.05, 0.05, 4, 4)), laid(meshes.grid(0.05, 0.05, 4, 4))
        for step in range(26):
            moved = 0.5 * (0.02 * step) ** 2 * 2.0  # 2 m/s^2
            for cloth, mu in ((rough, 0.5), (smooth, 0.1)):
                cloth.step(
                    0.02,
                    bodies=[
                        plane(0.9, origin=(0, 0, -1.0)),
                        box(mu, (1, 1, 1), rounding=0.02, origin=(moved, 0, -0.5)),
                    ],
                )
                assert (cloth.contacts == 1).all()
        assert rough.positions[:, 0].mean() == pytest.approx(0.25, abs=2e-5)
        assert smooth.velocities[:, 0].mean() == pytest.approx(0.1 * GRAVITY * 0.5, rel=2e-3)


class TestBodies:
    def fall(self, bodies: Sequence[Body], steps: int = 60, height: float = 0.06) -> Cloth:
        cloth = laid(meshes.grid(0.1, 0.1, 12, 12), height)
        for _ in range(steps):
            cloth.step(0.02, bodies=bodies, damping=1.0)
            for body in bodies:
                below = min(self.distance(body, p) for p in cloth.positions)
                assert below > -1e-6
        assert cloth.total.unconverged <= 1
        return cloth

    @staticmethod
    def distance(body: Body, p: Floats) -> float:
        local = body.pose[:, :3].T @ (p - body.pose[:, 3])
        if body.shape == 0:
            return float(local[2])
        beyond = np.abs(local) - np.array(body.core)
        return float(np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0) - body.radius)

    def test_sphere_carries(self) -> None:
        cloth = self.fall([plane(0.5), sphere(0.5, 0.05)])
        assert cloth.positions[:, 2].max() == pytest.approx(0.05, abs=2e-3)
        carried = cloth.reactions[:, 2].sum()
        assert carried == pytest.approx(cloth.masses.sum() * GRAVITY, rel=0.05)
        assert (cloth.contacts == 1).any()

    @pytest.mark.physics
    @pytest.mark.parametrize("slope", [0.5, 1.0, 1.4, 1.732])
    def test_valley_carries(self, slope: float) -> None:
        """Two planes: vertices in their corner bear on both, by a fillet of 1 mm.

        A vertex in the corner rests on the fillet, at r (sqrt(1 + slope^2) - 1). The sheet starts
        folded along the valley and without strain. From a stretched start it snaps back so hard
        that rounding decides where it lands.
        """
        limp = Cloth(PATCH, isotropic(0.2, 200.0, 1e-8), CERTIFIED)
        across = PATCH.rest[:, 0] / np.hypot(1.0, slope)
        limp.set_state(np.column_stack([across, PATCH.rest[:, 1], 0.004 + slope * np.abs(across)]))
        for _ in range(60):
            limp.step(
                0.02,
                bodies=[plane(0.2, normal=(side * slope, 0.0, 1.0)) for side in (1.0, -1.0)],
                damping=5.0,
            )
        assert limp.total.unconverged == 0
        assert limp.reactions[:, 2].sum() == pytest.approx(limp.masses.sum() * GRAVITY, rel=0.01)
        assert (limp.contacts >= 0).all()
        fillet = 1e-3 * (np.hypot(1.0, slope) - 1.0)
        assert limp.positions[:, 2].min() == pytest.approx(fillet, rel=0.01)

    def test_wall_pushes_over_a_floor(self) -> None:
        """In the corner both bear: the wall's work is its own, and no gain of contact.

        The floor rubs with mu.
        """
        cloth = laid()
        gravity = np.tile([0.0, 0.0, -GRAVITY], (len(PATCH.rest), 1))

        def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
            wall = plane(0.0, normal=(1.0, 0.0, 0.0), origin=(-0.051 + 0.05 * time, 0.0, 0.0))
            return gravity, np.empty((0, 3)), [plane(0.3), wall]

        cloth.advance(0.6, motion)
        assert cloth.positions[:, 0].min() > -0.051 + 0.05 * 0.6 - 1e-6
        assert (cloth.positions[:, 0].max() + 0.021) == pytest.approx(0.1, abs=5e-3)
        assert cloth.total.unconverged == 0
        assert cloth.total.seen.contact_work < 1e-6 * cloth.total.seen.flow

    def test_box_carries(self) -> None:
        cloth = self.fall([plane(0.5), box(0.5, (0.06, 0.06, 0.1), rounding=0.01)])
        assert cloth.positions[:, 2].max() == pytest.approx(0.05, abs=2e-3)
        assert (cloth.contacts == 1).any()

    @pytest.mark.physics
    def test_turned_box_is_the_same_box(self) -> None:
        """Half a turn about x maps a box onto itself."""
        first = self.fall([box(0.5, (0.06, 0.06, 0.1), rounding=0.01)], 20)
        second = self.fall(
            [box(0.5, (0.06, 0.06, 0.1), rounding=0.01, rotation=turn(0, np.pi))], 20
        )
        assert second.positions == pytest.approx(
            first.positions, abs=2e-3
        )  # corners buckle as they like

    def test_nothing_tunnels_at_speed(self) -> None:
        cloth = laid(height=0.5)
        cloth.set_state(cloth.positions, np.tile([0.0, 0.0, -50.0], (len(PATCH.rest), 1)))
        for _ in range(5):
            cloth.step(0.02, bodies=[plane(0.3)])
            assert cloth.positions[:, 2].min() > -1e-9

    def test_turning_sphere_drags(self) -> None:
        """What lies on its pole goes round with it."""
        mesh = meshes.grid(0.04, 0.04, 6, 6)
        cloth = laid(mesh, 0.1)
        for step in range(1, 76):
            angle = 0.02 * max(step - 25, 0)
            cloth.step(0.02, bodies=[sphere(0.5, 0.1, rotation=turn(2, angle))], damping=1.0)
        corner = cloth.positions[-1]
        start = np.arctan2(mesh.rest[-1, 1], mesh.rest[-1, 0])
        assert np.arctan2(corner[1], corner[0]) - start == pytest.approx(1.0, abs=0.02)


class TestBalances:
    def test_momentum(self) -> None:
        """Forces of floor and holders are M a less the weight, at every vertex to the preset's
        tolerance.
        """
        held = np.array([0, 8])
        cloth = laid(height=0.01, held=held)
        ends = cloth.positions[held]
        for step in range(1, 60):
            ends = ends + np.array([0.0, 2e-4, -1e-4 if step < 30 else 0.0])
            report = cloth.step(0.02, held=ends, bodies=[plane(0.4)])
            assert report.converged
            inertia = cloth.momentum_rate - cloth.masses @ cloth.gravity
            pushed = cloth.reactions
            free_floating = (cloth.contacts < 0) & ~np.isin(np.arange(len(pushed)), held)
            assert pushed.sum(axis=0) == pytest.approx(inertia, abs=1e-10)
            assert (
                np.abs(pushed[free_floating]).max(initial=0.0) <= 1e-3 * cloth.force_scale * 1.001
            )
        touching = cloth.contacts == 0
        assert touching.sum() > 10
        along = np.linalg.norm(pushed[touching][:, :2], axis=1)
        assert (along <= 0.4 * pushed[touching][:, 2] + 2e-3 * cloth.force_scale).all()

    @pytest.mark.parametrize("second_order", [False, True])
    def test_damping_is_no_force_of_contact(self, second_order: bool) -> None:
        """Neither that of the fabric nor that of the scene, in a fall that nothing touches."""
        damped = replace(MATERIAL, damping=2.0)
        cloth = Cloth(PATCH, damped, replace(CERTIFIED, second_order=second_order))
        cloth.set_state(np.column_stack([PATCH.rest, np.full(len(PATCH.rest), 1.0)]))
        for _ in range(10):
            cloth.step(0.02, bodies=[plane(0.4)], damping=1.0)
        weight = cloth.masses.sum() * GRAVITY
        assert cloth.momentum_rate[2] > -0.7 * weight
        assert np.abs(cloth.contact_force()).max() < 1e-6 * weight

    @pytest.mark.parametrize("mesh", [PATCH, SCATTERED], ids=["grid", "unstructured"])
    def test_free_fall_is_exact(self, mesh: Mesh) -> None:
        """After t it has fallen by g t^2/2, whatever the lengths of the steps."""
        cloth = laid(mesh, 1.0)
        start = cloth.positions
        for dt in (0.01, 0.02, 0.04, 0.005, 0.005, 0.02, 0.1):
            cloth.step(dt)
        fallen = np.tile([0.0, 0.0, -0.5 * GRAVITY * 0.2**2], (len(start), 1))
        assert cloth.positions - start == pytest.approx(
            fallen, abs=1e-6
        )  # corrections are of single precision
        assert cloth.velocities[:, 2] == pytest.approx(-GRAVITY * 0.2, rel=1e-5)

    def test_energy_does_not_grow(self) -> None:
        """A crumpled cloth that falls on the floor only loses.

        The velocity at the end of a step is that of its middle and half of what the acceleration
        adds, which is off by what stiff motions lose within the step.
        """
        mesh = meshes.grid(0.1, 0.1, 8, 8)
        cloth = Cloth(mesh, isotropic(0.2, 100.0, 2e-5), CERTIFIED)
        at = np.column_stack(
            [mesh.rest[:, 0], 0.01 * np.sin(60.0 * mesh.rest[:, 0]), 0.08 + 0.9 * mesh.rest[:, 1]]
        )
        cloth.set_state(at)

        def total() -> float:
            membrane, bending, _ = cloth._solver.energies(cloth.positions)
            moving = 0.5 * (cloth.masses @ (cloth.velocities**2).sum(axis=1))
            return float(
                membrane + bending + moving + GRAVITY * cloth.masses @ cloth.positions[:, 2]
            )

        energies = [total()]
        for _ in range(100):
            cloth.step(0.01, bodies=[plane(0.3)])
            energies.append(total())
        assert np.diff(energies).max() < 1e-3 * np.ptp(energies)
        assert energies[-1] < 0.5 * energies[0]

    def test_rerun_is_bit_identical(self) -> None:
        def run() -> tuple[bytes, bytes]:
            cloth = laid(SCATTERED, 0.02, held=[0])
            ends = cloth.positions[[0]]
            for step in range(40):
                bodies = [
                    plane(0.3),
                    sphere(0.6, 0.03, origin=(0.0, 0.0, -0.02), rotation=turn(2, 0.05 * step)),
                ]
                cloth.step(0.02, held=ends + np.array([0.001 * step, 0.0, 0.0]), bodies=bodies)
            return cloth.positions.tobytes(), cloth.reactions.tobytes()

        assert run() == run()

    def test_counts(self) -> None:
        cloth = laid(height=0.01)
        for _ in range(10):
            cloth.step(0.02, bodies=[plane(0.3)])
        assert cloth.total.steps == 10
        assert cloth.time == pytest.approx(0.2)
        assert cloth.total.unconverged == 0
        assert 0.0 <= cloth.worst_residual <= CERTIFIED.tolerance
        assert cloth.total.newton > 0

    def test_step_that_cannot_converge_is_counted_and_kept(self) -> None:
        """It returns an answer and its residual."""
        mesh = meshes.grid(0.1, 0.1, 8, 8)
        hopeless = replace(CERTIFIED, name="hopeless", newton_max=1, halvings_max=0, tolerance=1e-9)
        cloth = Cloth(mesh, isotropic(0.2, 100.0, 1e-5), hopeless, held=[0])
        at = np.column_stack([mesh.rest[:, 0], 0.0 * mesh.rest[:, 0], mesh.rest[:, 1] + 0.05])
        cloth.set_state(at)
        for step in range(1, 6):
            report = cloth.step(0.05, held=at[[0]] + [0.0, 0.02 * step, 0.0], bodies=[plane(0.3)])
        assert not report.converged
        assert report.residual > 0.0
        assert cloth.total.unconverged > 0
        assert cloth.worst_residual > 1e-9
        assert np.isfinite(cloth.positions).all()


class TestRefusals:
    FLAT = np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))])

    @pytest.mark.parametrize("mu", [-0.1, 10.1, float("nan"), float("inf")])
    def test_friction(self, mu: float) -> None:
        rule = r"mu: must be in \[0, 10\]"
        with pytest.raises(ValueError, match=rule):
            plane(mu)
        with pytest.raises(ValueError, match=rule):
            sphere(mu, 0.1)
        with pytest.raises(ValueError, match=rule):
            box(mu, (1, 1, 1))

    def test_sizes(self) -> None:
        with pytest.raises(ValueError, match="radius: must be finite and > 0, got -1"):
            sphere(0.1, -1.0)
        with pytest.raises(ValueError, match="size: must be three finite lengths > 0"):
            box(0.1, (1.0, 0.0, 1.0))
        with pytest.raises(ValueError, match="size: must be three finite lengths > 0"):
            box(0.1, (1.0, 1.0))
        with pytest.raises(
            ValueError,
            match=r"rounding: must be at most half the shortest edge, 0\.01 m, got 0\.02",
        ):
            box(0.1, (1.0, 1.0, 0.02), rounding=0.02)
        with pytest.raises(ValueError, match="length: must be finite and > 0, got 0"):
            capsule(0.1, 0.01, 0.0)

    def test_friction_of_each_sheet(self) -> None:
        cloth = laid()
        with pytest.raises(ValueError, match="mu: of a body must be one or of 1 sheets, got 2"):
            cloth.step(0.02, bodies=[plane([0.1, 0.2])])
        with pytest.raises(ValueError, match="one or one a sheet"):
            plane([[0.1]])

    @pytest.mark.parametrize(
        ("rest", "triangles", "message"),
        [
            ([[0, 0], [1, 0]], [[0, 1, 1]], "rest: must hold at least 3 vertices, got 2"),
            (
                [[0, 0], [1, 0], [0, np.nan]],
                [[0, 1, 2]],
                "rest: must be finite, and vertex 2 is not",
            ),
            (
                [[0, 0], [1, 0], [2, 0]],
                [[0, 1, 2]],
                "triangles: must run counter-clockwise and not be slivers",
            ),
            (
                [[0, 0], [1, 0], [0, 1]],
                [[0, 1, -3]],
                "triangles: must index 3 vertices, got -3 in triangle 0",
            ),
            (
                [[0, 0], [1, 0], [0, 1], [5, 5]],
                [[0, 1, 3], [0, 2, 1]],
                "triangles: must run counter-clockwise",
            ),
            (
                [[0, 0], [1, 0], [0, 1], [5, 5]],
                [[0, 1, 2]],
                "rest: every vertex must belong to a triangle, and 3",
            ),
            (
                [[0, 0], [1, 0], [1, 1], [0, 1]],
                [[0, 1, 2], [0, 2, 3]],
                "triangles: the nodes around edge",
            ),
        ],
    )
    def test_mesh(self, rest: object, triangles: object, message: str) -> None:
        mesh = Mesh(np.array(rest, float), np.array(triangles, dtype=np.int32))
        with pytest.raises(ValueError, match=message):
            Cloth(mesh, MATERIAL, CERTIFIED)

    @pytest.mark.parametrize("held", [[-1], [81], [3, 3]])
    def test_held(self, held: list[int]) -> None:
        with pytest.raises(ValueError, match="held: must"):
            Cloth(PATCH, MATERIAL, CERTIFIED, held=held)

    def test_nothing_free(self) -> None:
        with pytest.raises(ValueError, match="held: must leave a vertex free"):
            Cloth(PATCH, MATERIAL, CERTIFIED, held=np.arange(81))

    def test_state(self) -> None:
        cloth = Cloth(PATCH, MATERIAL, CERTIFIED)
        with pytest.raises(ValueError, match="positions: must have a row for each vertex"):
            cloth.set_state(self.FLAT[:-1])
        with pytest.raises(ValueError, match="positions: must be finite"):
            cloth.set_state(self.FLAT * np.nan)

    def test_step(self) -> None:
        cloth = Cloth(PATCH, MATERIAL, CERTIFIED, held=[0])
        cloth.set_state(self.FLAT)
        for dt in (0.0, -0.1, float("nan")):
            with pytest.raises(ValueError, match="dt: must be finite and > 0"):
                cloth.step(dt, held=self.FLAT[[0]])
        with pytest.raises(ValueError, match="held: must have a row for each held vertex"):
            cloth.step(0.01)
        with pytest.raises(ValueError, match=r"held.* must be finite"):
            cloth.step(0.01, held=[[0.0, 0.0, np.nan]])

    def test_number_of_bodies_stays(self) -> None:
        cloth = Cloth(PATCH, MATERIAL, CERTIFIED)
        cloth.set_state(self.FLAT)
        cloth.step(0.01, bodies=[plane(0.1)])
        with pytest.raises(ValueError, match="bodies: must keep their number"):
            cloth.step(0.01)
