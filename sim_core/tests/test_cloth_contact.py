"""Sheets on bodies: exact Coulomb friction, balances of momentum and energy, and what is refused."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import Body, Cloth, box, fabric, isotropic, meshes, plane, preset_named, sphere
from stickslip_sim_core.cloth import GRAVITY
from stickslip_sim_core.meshes import Mesh
from stickslip_sim_core.protocols.inclined_plane import tilted

Floats = NDArray[np.float64]

CERTIFIED = preset_named("certified")
PATCH = meshes.grid(0.1, 0.1, 8, 8)
SCATTERED = meshes.unstructured(0.1, 0.1, 0.0125, 3)
MATERIAL = fabric("gray-interlock")


def laid(mesh: Mesh = PATCH, height: float = 0.0, **settings: object) -> Cloth:
    sheet = Cloth(mesh, MATERIAL, CERTIFIED, **settings)  # type: ignore[arg-type]
    sheet.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), height)]))
    return sheet


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
        sheet = laid(mesh)
        sheet.gravity[:] = tilted(0.9 * np.arctan(mu))
        start = sheet.positions
        for _ in range(100):
            sheet.step(0.02, bodies=[plane(mu)])
        assert np.abs(sheet.positions - start).max() < 1e-15
        assert not sheet.sliding.any()
        assert (sheet.contacts == 0).all()

    @pytest.mark.parametrize("mu", [0.1, 0.5, 1.5])
    @pytest.mark.parametrize("mesh", [PATCH, SCATTERED], ids=["grid", "unstructured"])
    def test_patch_beyond_it_accelerates(self, mesh: Mesh, mu: float) -> None:
        """With g (sin a - mu cos a), to 0.5 %; the force that residuals are measured in has to be small beside that."""
        angle = 1.1 * np.arctan(mu)
        sheet = laid(mesh, force_scale=0.01 * MATERIAL.density * mesh.spacing**2 * GRAVITY)
        sheet.gravity[:] = tilted(angle)
        for _ in range(25):
            sheet.step(0.02, bodies=[plane(mu)])
        speed = np.linalg.norm(sheet.masses @ sheet.velocities) / sheet.masses.sum()
        assert speed / 0.5 == pytest.approx(GRAVITY * (np.sin(angle) - mu * np.cos(angle)), rel=5e-3)
        assert sheet.sliding.all()
        assert sheet.unconverged_steps == 0

    def test_without_friction(self) -> None:
        sheet = laid()
        sheet.gravity[:] = tilted(0.3)
        for _ in range(10):
            sheet.step(0.02, bodies=[plane(0.0)])
        assert np.linalg.norm(sheet.velocities, axis=1) == pytest.approx(0.2 * GRAVITY * np.sin(0.3), rel=1e-3)

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

    def test_each_body_has_its_own(self) -> None:
        """A box is pulled from under a patch: a rough one takes it along, a smooth one does not, whatever the floor."""
        rough, smooth = laid(meshes.grid(0.05, 0.05, 4, 4)), laid(meshes.grid(0.05, 0.05, 4, 4))
        for step in range(26):
            moved = 0.5 * (0.02 * step) ** 2 * 2.0  # 2 m/s^2
            for sheet, mu in ((rough, 0.5), (smooth, 0.1)):
                sheet.step(0.02, bodies=[plane(0.9, origin=(0, 0, -1.0)), box(mu, (1, 1, 1), origin=(moved, 0, -0.5))])
                assert (sheet.contacts == 1).all()
        assert rough.positions[:, 0].mean() == pytest.approx(0.25, abs=2e-5)
        assert smooth.velocities[:, 0].mean() == pytest.approx(0.1 * GRAVITY * 0.5, rel=2e-3)


class TestBodies:
    def fall(self, bodies: Sequence[Body], steps: int = 60, height: float = 0.06) -> Cloth:
        sheet = laid(meshes.grid(0.1, 0.1, 12, 12), height)
        for _ in range(steps):
            sheet.step(0.02, bodies=bodies, damping=1.0)
            for body in bodies:
                below = min(self.distance(body, p) for p in sheet.positions)
                assert below > -1e-6
        assert sheet.unconverged_steps <= 1
        return sheet

    @staticmethod
    def distance(body: Body, p: Floats) -> float:
        local = body.rotation.T @ (p - body.origin)
        if body.shape == 0:
            return float(local[2])
        if body.shape == 1:
            return float(np.linalg.norm(local) - body.size[0])
        beyond = np.abs(local) - np.array(body.size)
        return float(np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0))

    def test_sphere_carries(self) -> None:
        sheet = self.fall([plane(0.5), sphere(0.5, 0.05)])
        assert sheet.positions[:, 2].max() == pytest.approx(0.05, abs=2e-3)
        carried = sheet.reactions[:, 2].sum()
        assert carried == pytest.approx(sheet.masses.sum() * GRAVITY, rel=0.05)
        assert (sheet.contacts == 1).any()

    def test_box_carries(self) -> None:
        sheet = self.fall([plane(0.5), box(0.5, (0.06, 0.06, 0.1))])
        assert sheet.positions[:, 2].max() == pytest.approx(0.05, abs=2e-3)
        assert (sheet.contacts == 1).any()

    def test_turned_box_is_the_same_box(self) -> None:
        """Half a turn about x maps a box onto itself."""
        first = self.fall([box(0.5, (0.06, 0.06, 0.1))], 20)
        second = self.fall([box(0.5, (0.06, 0.06, 0.1), rotation=turn(0, np.pi))], 20)
        assert second.positions == pytest.approx(first.positions, abs=2e-3)  # corners buckle as they like

    def test_nothing_tunnels_at_speed(self) -> None:
        sheet = laid(height=0.5)
        sheet.set_state(sheet.positions, np.tile([0.0, 0.0, -50.0], (len(PATCH.rest), 1)))
        for _ in range(5):
            sheet.step(0.02, bodies=[plane(0.3)])
            assert sheet.positions[:, 2].min() > -1e-9

    def test_turning_sphere_drags(self) -> None:
        """What lies on its pole goes round with it."""
        mesh = meshes.grid(0.04, 0.04, 6, 6)
        sheet = laid(mesh, 0.1)
        for step in range(1, 76):
            angle = 0.02 * max(step - 25, 0)
            sheet.step(0.02, bodies=[sphere(0.5, 0.1, rotation=turn(2, angle))], damping=1.0)
        corner = sheet.positions[-1]
        start = np.arctan2(mesh.rest[-1, 1], mesh.rest[-1, 0])
        assert np.arctan2(corner[1], corner[0]) - start == pytest.approx(1.0, abs=0.02)


class TestBalances:
    def test_momentum(self) -> None:
        """Forces of floor and holders are M a less the weight, at every vertex to the preset's tolerance."""
        held = np.array([0, 8])
        sheet = laid(height=0.01, held=held)
        ends = sheet.positions[held]
        for step in range(1, 60):
            before = sheet.velocities
            ends = ends + np.array([0.0, 2e-4, -1e-4 if step < 30 else 0.0])
            report = sheet.step(0.02, held=ends, bodies=[plane(0.4)])
            assert report.converged
            inertia = sheet.masses[:, None] * ((sheet.velocities - before) / 0.02 - sheet.gravity)
            pushed = sheet.reactions
            free_floating = (sheet.contacts < 0) & ~np.isin(np.arange(len(pushed)), held)
            assert pushed.sum(axis=0) == pytest.approx(inertia.sum(axis=0), abs=1e-10)
            assert np.abs(pushed[free_floating]).max(initial=0.0) <= 1e-3 * sheet.force_scale * 1.001
        touching = sheet.contacts == 0
        assert touching.sum() > 10
        along = np.linalg.norm(pushed[touching][:, :2], axis=1)
        assert (along <= 0.4 * pushed[touching][:, 2] + 2e-3 * sheet.force_scale).all()

    @pytest.mark.parametrize("mesh", [PATCH, SCATTERED], ids=["grid", "unstructured"])
    def test_free_fall_is_exact(self, mesh: Mesh) -> None:
        """Of implicit Euler: after n steps it has fallen by g dt^2 n (n + 1) / 2."""
        sheet = laid(mesh, 1.0)
        start = sheet.positions
        for _ in range(20):
            sheet.step(0.01)
        fallen = np.tile([0.0, 0.0, -GRAVITY * 1e-4 * 210], (len(start), 1))
        assert sheet.positions - start == pytest.approx(fallen, abs=2e-7)  # corrections are of single precision
        assert sheet.velocities[:, 2] == pytest.approx(-GRAVITY * 0.2, rel=1e-5)

    def test_energy_does_not_grow(self) -> None:
        """A crumpled sheet that falls on the floor only ever loses; friction and implicit Euler both take."""
        mesh = meshes.grid(0.1, 0.1, 8, 8)
        sheet = Cloth(mesh, isotropic(0.2, 100.0, 2e-5), CERTIFIED)
        at = np.column_stack([mesh.rest[:, 0], 0.01 * np.sin(60.0 * mesh.rest[:, 0]), 0.08 + 0.9 * mesh.rest[:, 1]])
        sheet.set_state(at)

        def total() -> float:
            membrane, bending, _ = sheet._solver.energies(sheet.positions, sheet.slopes)
            moving = 0.5 * (sheet.masses @ (sheet.velocities**2).sum(axis=1))
            return float(membrane + bending + moving + GRAVITY * sheet.masses @ sheet.positions[:, 2])

        energies = [total()]
        for _ in range(100):
            sheet.step(0.01, bodies=[plane(0.3)])
            energies.append(total())
        slack = 1e-3 * sheet.force_scale * len(at) * 0.01  # residuals times what a vertex may move in a step
        assert np.diff(energies).max() < slack
        assert energies[-1] < 0.5 * energies[0]

    def test_rerun_is_bit_identical(self) -> None:
        def run() -> tuple[bytes, bytes]:
            sheet = laid(SCATTERED, 0.02, held=[0])
            ends = sheet.positions[[0]]
            for step in range(40):
                bodies = [plane(0.3), sphere(0.6, 0.03, origin=(0.0, 0.0, -0.02), rotation=turn(2, 0.05 * step))]
                sheet.step(0.02, held=ends + np.array([0.001 * step, 0.0, 0.0]), bodies=bodies)
            return sheet.positions.tobytes(), sheet.reactions.tobytes()

        assert run() == run()

    def test_counts(self) -> None:
        sheet = laid(height=0.01)
        for _ in range(10):
            sheet.step(0.02, bodies=[plane(0.3)])
        assert sheet.steps == 10
        assert sheet.time == pytest.approx(0.2)
        assert sheet.unconverged_steps == 0
        assert 0.0 <= sheet.worst_residual <= CERTIFIED.tolerance
        assert sheet.newton > 0
        assert set(sheet.phases()) == {"assembly", "factorization", "krylov", "contact"}

    def test_step_that_cannot_converge_is_counted_and_kept(self) -> None:
        """It returns an answer and its residual."""
        mesh = meshes.grid(0.1, 0.1, 8, 8)
        hopeless = replace(CERTIFIED, name="hopeless", newton_max=1, halvings_max=0, tolerance=1e-9)
        sheet = Cloth(mesh, isotropic(0.2, 100.0, 1e-5), hopeless, held=[0])
        at = np.column_stack([mesh.rest[:, 0], 0.0 * mesh.rest[:, 0], mesh.rest[:, 1] + 0.05])
        sheet.set_state(at)
        for step in range(1, 6):
            report = sheet.step(0.05, held=at[[0]] + [0.0, 0.02 * step, 0.0], bodies=[plane(0.3)])
        assert not report.converged
        assert report.residual > 0.0
        assert sheet.unconverged_steps > 0
        assert sheet.worst_residual > 1e-9
        assert np.isfinite(sheet.positions).all()


class TestRefusals:
    FLAT = np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))])

    @pytest.mark.parametrize("mu", [-0.1, float("nan"), float("inf")])
    def test_friction(self, mu: float) -> None:
        rule = "mu: must be finite and >= 0"
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

    @pytest.mark.parametrize(
        ("rest", "triangles", "message"),
        [
            ([[0, 0], [1, 0]], [[0, 1, 1]], "rest: must hold at least 3 vertices, got 2"),
            ([[0, 0], [1, 0], [0, np.nan]], [[0, 1, 2]], "rest: must be finite, and vertex 2 is not"),
            ([[0, 0], [1, 0], [2, 0]], [[0, 1, 2]], "triangles: must run counter-clockwise and not be slivers"),
            ([[0, 0], [1, 0], [0, 1]], [[0, 1, -3]], "triangles: must index 3 vertices, got -3 in triangle 0"),
            ([[0, 0], [1, 0], [0, 1], [5, 5]], [[0, 1, 3], [0, 2, 1]], "triangles: must run counter-clockwise"),
            ([[0, 0], [1, 0], [0, 1], [5, 5]], [[0, 1, 2]], "rest: every vertex must belong to a triangle, and 3"),
            ([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]], "triangles: the nodes around edge"),
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

    @pytest.mark.parametrize("edge", [(0, 80), (40, 41), (0, 999)])
    def test_clamp_outside_the_mesh(self, edge: tuple[int, int]) -> None:
        with pytest.raises(ValueError, match="clamped: must be edges of the boundary"):
            Cloth(PATCH, MATERIAL, CERTIFIED, clamped=[edge])

    def test_state(self) -> None:
        sheet = Cloth(PATCH, MATERIAL, CERTIFIED)
        with pytest.raises(ValueError, match="positions: must have a row for each vertex"):
            sheet.set_state(self.FLAT[:-1])
        with pytest.raises(ValueError, match="positions: must be finite"):
            sheet.set_state(self.FLAT * np.nan)

    def test_step(self) -> None:
        sheet = Cloth(PATCH, MATERIAL, CERTIFIED, held=[0])
        sheet.set_state(self.FLAT)
        for dt in (0.0, -0.1, float("nan")):
            with pytest.raises(ValueError, match="dt: must be finite and > 0"):
                sheet.step(dt, held=self.FLAT[[0]])
        with pytest.raises(ValueError, match="held: must have a row for each held vertex"):
            sheet.step(0.01)
        with pytest.raises(ValueError, match=r"held.* must be finite"):
            sheet.step(0.01, held=[[0.0, 0.0, np.nan]])
        with pytest.raises(ValueError, match="slopes: must have a row for each clamped edge"):
            sheet.step(0.01, held=self.FLAT[[0]], slopes=np.zeros((3, 3)))

    def test_number_of_bodies_stays(self) -> None:
        sheet = Cloth(PATCH, MATERIAL, CERTIFIED)
        sheet.set_state(self.FLAT)
        sheet.step(0.01, bodies=[plane(0.1)])
        with pytest.raises(ValueError, match="bodies: must keep their number"):
            sheet.step(0.01)
