"""Self-contact and contact with other cloth: nothing crosses, friction is exact.

Without contact nothing changes.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from stickslip_testing import tumbles

from stickslip_sim_core import (
    Cloth,
    SelfContact,
    Surface,
    fabric,
    isotropic,
    plane,
    preset_named,
    protocols,
    self_intersections,
)
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.protocols.inclined_plane import Stack, tilted

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]

CERTIFIED = preset_named("certified")
THICKNESS = 5e-4
MATERIAL = fabric("gray-interlock")
SOFT = isotropic(0.2, 100.0, 1e-6)


def stack(mu: float, cells: int = 4, preset: str = "certified") -> Stack:
    """Two sheets on a floor, 0.5 mm from each other."""
    return Stack(2, mu, preset_named(preset), cells)


def watched(cloth: Cloth, steps: int, dt: float = 0.02, **drive: object) -> int:
    """Step, check that nothing crosses after any step, and return how many did not converge."""
    before = cloth.total.unconverged
    for _ in range(steps):
        cloth.step(dt, **drive)  # type: ignore[arg-type]
        assert self_intersections(cloth.positions, cloth.mesh.triangles) == 0
    return cloth.total.unconverged - before


def doubled_over(arc: Floats, length: float, radius: float) -> tuple[Floats, Floats]:
    """Return where arc lengths (V,) of a strip lie along and above its lower half, both (V,) [m].

    The strip has two straight halves, and half a circle between them.
    """
    straight = (length - np.pi * radius) / 2
    angle = np.clip((arc - straight) / radius, 0.0, np.pi)
    lower = np.minimum(arc, straight)
    upper = straight - np.maximum(arc - straight - np.pi * radius, 0.0)
    is_lower = angle < np.pi / 2
    along = np.where(is_lower, lower, upper) + radius * np.sin(angle)
    return along, radius * (1.0 - np.cos(angle))


class TestWithoutContact:
    def test_results_are_the_same(self) -> None:
        """Of a sheet that is pulled over a floor, to 1e-9 m: solves end at residuals that differ by
        rounding.
        """
        mesh = meshes.unstructured(0.1, 0.1, 0.0125, 3)

        def run(self_contact: SelfContact | None) -> Floats:
            cloth = Cloth(mesh, MATERIAL, CERTIFIED, held=[0], self_contact=self_contact)
            start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.002)])
            cloth.set_state(start)
            for step in range(20):
                cloth.step(
                    0.02,
                    held=start[[0]] - 0.0002 * step * np.array([1.0, 1.0, 0.0]),
                    bodies=[plane(0.3)],
                )
            assert cloth.total.least_distance == np.inf
            assert cloth.sliding.any()
            return cloth.positions

        assert run(None) == pytest.approx(run(SelfContact(0.5)), abs=1e-9)


class TestStack:
    def test_upper_sheet_rests_on_the_lower_one(self) -> None:
        two = stack(0.5)
        cloth = two.cloth
        assert watched(cloth, 50, bodies=two.floor) == 0
        pairs = cloth.pair_forces
        upper = two.level == 1
        assert pairs.distance == pytest.approx(THICKNESS, abs=1e-9)
        # Forces on the upper sheet: weights of its vertices add up to 1 or, where it is the second
        # of a pair, to -1.
        on_upper = (pairs.weights * upper[pairs.vertices]).sum(axis=1)
        assert np.abs(on_upper) == pytest.approx(1.0)
        weight = cloth.masses[upper].sum() * GRAVITY
        assert on_upper @ pairs.forces == pytest.approx(
            np.array([0.0, 0.0, weight]), abs=1e-4 * weight
        )
        assert cloth.reactions.sum(axis=0)[2] == pytest.approx(
            cloth.masses.sum() * GRAVITY, rel=1e-4
        )

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
        way = np.linalg.norm((two.cloth.positions - two.start)[upper].mean(axis=0))
        assert 2.0 * way / (dt * steps) ** 2 == pytest.approx(
            GRAVITY * (np.sin(angle) - mu * np.cos(angle)), rel=5e-3
        )
        assert two.moved()[~upper].max() < 1e-8

    def test_each_two_sheets_have_their_own_friction(self) -> None:
        """Of three sheets the upper two slide together on the lowest, where friction is least."""
        three = Stack(3, 0.3, CERTIFIED, 3)
        three.cloth.gravity[:] = tilted(np.arctan(0.3) + 0.03)
        assert watched(three.cloth, 25, bodies=three.floor) == 0
        moved = [three.moved()[three.level == level] for level in range(3)]
        assert moved[0].max() < 1e-8
        assert moved[1].min() > 1e-3
        assert moved[2] == pytest.approx(np.full(len(moved[2]), moved[1].mean()), rel=2e-3)

    def test_measures_mu(self) -> None:
        result = protocols.run(
            "stacked-incline", friction=(0.3,), sheets=(2,), cells=4, unstructured=0
        )
        assert result.passed
        assert result.settings["unconverged_steps"] == 0
        assert result.settings["least_distance_over_thickness"] >= 0.99  # type: ignore[operator]

    def test_a_stack_that_creeps_has_no_slip_angle(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(Stack, "drift", lambda _: 2e-5)
        monkeypatch.setattr(Stack, "slip_slope", lambda _: 0.3)
        assert not protocols.run(
            "stacked-incline", friction=(0.3,), sheets=(2,), cells=3, unstructured=0
        ).passed


class TestBearing:
    @staticmethod
    def ridges(bearing: str) -> Cloth:
        """Press the ridge of one folded sheet on that of another, which is held as a whole.

        The ridges cross in the middle, edge on edge. The sides of the upper sheet go down by
        1.7 mm: at 1.8 mm the force of the pair has its maximum, 0.91 mN. Beyond it the upper ridge
        snaps aside within a step, to one of two equilibria, and rounding decides to which.
        """
        sheet = meshes.grid(0.02, 0.02, 5, 4)
        folded, height = sheet.rest * [1.0, 0.8], 0.6 * np.abs(sheet.rest[:, 1])
        below = np.column_stack([folded[:, ::-1], -height])
        above = np.column_stack([folded, height + 2.0 * THICKNESS])
        sides = len(below) + np.flatnonzero(height > height.max() - 1e-9)
        held = np.append(np.arange(len(below)), sides)
        cloth = Cloth(
            meshes.together(sheet, sheet),
            SOFT,
            CERTIFIED,
            held=held,
            self_contact=SelfContact(0.5, bearing=bearing),
        )
        start = np.concatenate([below, above])
        cloth.set_state(start)
        for step in range(17):
            ends = start[held]
            ends[len(below) :, 2] -= 1e-4 * (step + 1)
            cloth.step(0.02, held=ends, damping=5.0)
        assert cloth.total.unconverged == 0
        return cloth

    @pytest.mark.parametrize(
        ("bearing", "share"), [("all", 1.0), ("vertices", 0.9), ("first", 0.9)]
    )
    def test_how_far_edges_of_two_sheets_stay_apart(self, bearing: str, share: float) -> None:
        cloth = self.ridges(bearing)
        pairs = cloth.pair_forces
        assert np.linalg.norm(pairs.forces, axis=1).max() > 5e-4
        assert pairs.distance == pytest.approx(share * THICKNESS, rel=1e-4)
        assert cloth.total.least_distance == pytest.approx(share * THICKNESS, rel=1e-3)

    @pytest.mark.parametrize("bearing", ["vertices", "first"])
    def test_which_vertices_bear_where_sheets_lie_flat(self, bearing: str) -> None:
        first, second = meshes.grid(0.05, 0.05, 5, 5), meshes.unstructured(0.06, 0.06, 0.009, 1)
        both = meshes.together(first, second)
        cloth = Cloth(both, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5, bearing=bearing))
        cloth.set_state(
            np.concatenate([flat(first, 2.02 * THICKNESS), flat(second, 1.01 * THICKNESS)])
        )
        assert watched(cloth, 30, bodies=[plane(0.5)], damping=2.0) == 0
        pairs, of_first = cloth.pair_forces, len(first.rest)
        heavy = np.linalg.norm(pairs.forces, axis=1) > 1e-6
        assert pairs.distance[heavy] == pytest.approx(THICKNESS, abs=1e-8)
        assert (pairs.weights[heavy].max(axis=1) == 1.0).all()  # vertices over triangles
        from_second = (pairs.vertices[:, 0] >= of_first) & heavy
        assert from_second.any() == (bearing == "vertices")
        weight = cloth.masses[:of_first].sum() * GRAVITY
        share = (pairs.weights * (pairs.vertices < of_first)).sum(axis=1)
        assert (share @ pairs.forces)[2] == pytest.approx(weight, rel=1e-3)

    def test_within_a_sheet_all_bear(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A strip that folds onto itself is the same bit by bit."""

        def run(bearing: str) -> bytes:
            monkeypatch.setattr(tumbles, "SelfContact", lambda mu: SelfContact(mu, bearing=bearing))
            fold = tumbles.tumble("folding-0")
            tumbles.watch(fold, 80)
            assert fold.cloth.total.least_distance < 1.01 * THICKNESS
            return fold.cloth.positions.tobytes()

        assert run("all") == run("first")


def flat(mesh: meshes.Mesh, height: float = 0.0) -> Floats:
    return np.column_stack([mesh.rest, np.full(len(mesh.rest), height)])


class TestSeveralFabrics:
    A, B = meshes.grid(0.05, 0.05, 4, 4), meshes.unstructured(0.06, 0.04, 0.012, 1)
    LIGHT, HEAVY = fabric("gray-interlock"), replace(fabric("camel-ponte-roma"), damping=3.0)

    def both(self) -> Cloth:
        return Cloth(meshes.together(self.A, self.B), (self.LIGHT, self.HEAVY), CERTIFIED)

    def test_each_sheet_is_of_its_own(self) -> None:
        """Energies, forces and masses are those of two cloths of one fabric each."""
        rng = np.random.default_rng(0)
        both, first, second = (
            self.both(),
            Cloth(self.A, self.LIGHT, CERTIFIED),
            Cloth(self.B, self.HEAVY, CERTIFIED),
        )
        bent = [
            flat(mesh) + 1e-3 * rng.normal(size=(len(mesh.rest), 3)) for mesh in (self.A, self.B)
        ]
        membrane, bending, force = both._solver.energies(np.concatenate(bent))
        alone = [
            cloth._solver.energies(at) for cloth, at in zip((first, second), bent, strict=True)
        ]
        assert membrane == pytest.approx(alone[0][0] + alone[1][0], rel=1e-12)
        assert bending == pytest.approx(alone[0][1] + alone[1][1], rel=1e-12)
        expected = np.concatenate([alone[0][2], alone[1][2]])
        assert force == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())
        assert both.masses == pytest.approx(
            np.concatenate([first.masses, second.masses]), rel=1e-12
        )

    def test_each_sheet_has_its_own_damping(self) -> None:
        cloth = self.both()
        cloth.gravity[:] = 0.0
        start = np.concatenate([flat(self.A), flat(self.B)])
        cloth.set_state(start, np.broadcast_to([1.0, 0.0, 0.0], start.shape))
        for _ in range(5):
            cloth.step(0.02)
        speed = cloth.velocities[:, 0]
        assert speed[: len(self.A.rest)] == pytest.approx(1.0, rel=1e-6)
        assert speed[len(self.A.rest) :] == pytest.approx(np.exp(-3.0 * 0.1), rel=0.01)

    def test_residuals_are_measured_in_the_lightest(self) -> None:
        assert self.both().force_scale == pytest.approx(
            min(self.LIGHT.density, self.HEAVY.density) * 25e-6 * GRAVITY
        )

    def test_each_two_keep_their_own_distance(self) -> None:
        """The mean of their thicknesses, and half of both with a surface."""
        cloth = Cloth(
            meshes.together(self.A, self.B),
            (self.LIGHT, self.HEAVY),
            CERTIFIED,
            self_contact=SelfContact(0.5, [8e-4, 4e-4]),
            surfaces=[
                Surface(
                    [[0, 1, 2]], [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]], 0.5, 0.0
                )
            ],
        )
        cloth.set_state(np.concatenate([flat(self.A, 0.001), flat(self.B, 0.002)]))
        assert watched(cloth, 60) == 0
        height = [cloth.positions[: len(self.A.rest), 2], cloth.positions[len(self.A.rest) :, 2]]
        assert height[0] == pytest.approx(4e-4, abs=1e-8)
        assert height[1][np.abs(self.B.rest[:, 0]) < 0.025] == pytest.approx(10e-4, abs=1e-8)
        weight = cloth.masses.sum() * GRAVITY
        assert cloth.surface_forces[0].sum(axis=0) == pytest.approx(
            [0.0, 0.0, -weight], abs=1e-4 * weight
        )
        assert cloth.contact_force() == pytest.approx([0.0, 0.0, weight], abs=1e-3 * weight)
        assert (cloth.contacts[: len(self.A.rest)] == 0).all()

    def test_number_of_fabrics(self) -> None:
        with pytest.raises(
            ValueError, match="fabric: must be one, or one for each of 2 sheets, got 3"
        ):
            Cloth(meshes.together(self.A, self.B), (self.LIGHT,) * 3, CERTIFIED)


class TestSurfaces:
    SHEET = meshes.grid(0.06, 0.06, 4, 4)
    GROUND = meshes.grid(0.3, 0.3, 3, 3)

    def on(
        self,
        motion: Callable[[float, Floats], Floats],
        mu: float = 0.5,
        mesh: meshes.Mesh | None = None,
    ) -> Cloth:
        """A sheet that lies on a ground that moves."""
        mesh = self.GROUND if mesh is None else mesh
        ground = Surface(mesh.triangles, lambda time: motion(time, flat(mesh)), mu)
        cloth = Cloth(self.SHEET, MATERIAL, CERTIFIED, surfaces=[ground])
        cloth.set_state(flat(self.SHEET, THICKNESS))
        return cloth

    def watch(self, cloth: Cloth, steps: int, dt: float = 0.02, **drive: object) -> None:
        for _ in range(steps):
            cloth.step(dt, **drive)  # type: ignore[arg-type]
            all_positions = np.concatenate([cloth.positions, cloth.surfaces[0].at(cloth.time)])
            behind = np.asarray(cloth.surfaces[0].triangles) + len(cloth.mesh.rest)
            assert (
                self_intersections(all_positions, np.concatenate([cloth.mesh.triangles, behind]))
                == 0
            )
        assert cloth.total.unconverged == 0

    @pytest.mark.parametrize("mu", [0.1, 0.8])
    @pytest.mark.parametrize("beyond", [-0.02, 0.02])
    def test_slope(self, mu: float, beyond: float) -> None:
        cloth = self.on(lambda _, at: at, mu, meshes.unstructured(0.3, 0.3, 0.04, 1))
        cloth.gravity[:] = tilted(np.arctan(mu) + beyond)
        self.watch(cloth, 20)
        speed = np.linalg.norm(cloth.velocities.mean(axis=0))
        angle = np.arctan(mu) + max(beyond, 0.0)
        assert speed / cloth.time == pytest.approx(
            GRAVITY * (np.sin(angle) - mu * np.cos(angle)), rel=1e-3, abs=1e-8
        )

    def test_carries_what_sticks(self) -> None:
        """A ground that speeds up sideways and upwards, and turns, all of it slowly enough."""

        def motion(time: float, at: Floats) -> Floats:
            turn = 0.5 * time**2
            c, s = np.cos(turn), np.sin(turn)
            moved: Floats = at @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [
                0.2 * time**2,
                0.0,
                0.5 * time**2,
            ]
            return moved

        cloth = self.on(motion)
        self.watch(cloth, 30)
        assert cloth.positions == pytest.approx(
            motion(cloth.time, flat(self.SHEET, THICKNESS)), abs=1e-6
        )

    def test_lifts_at_once(self) -> None:
        """By 10 cm in a step, hundreds of times the thickness."""
        cloth = self.on(lambda time, at: at + np.array([0.0, 0.0, 0.1 * (time > 0.03)]))
        self.watch(cloth, 3)
        assert cloth.total.least_distance >= 0.99 * THICKNESS
        assert cloth.positions[:, 2].min() > 0.1

    def test_several_with_motion_of_a_controller(self) -> None:
        """A sheet lies with one half on a smooth ground and with the other on one that moves and is
        rough.
        """
        half = meshes.grid(0.1, 0.2, 2, 3)
        left, right = (
            flat(half) - np.array([0.05, 0.0, 0.0]),
            flat(half) + np.array([0.05, 0.0, 0.0]),
        )
        surfaces = [
            Surface(half.triangles, left, 0.0),
            Surface(half.triangles, lambda time: right + np.array([0.0, 0.05 * time, 0.0]), 1.0),
        ]
        cloth = Cloth(self.SHEET, MATERIAL, preset_named("fast"), surfaces=surfaces)
        cloth.set_state(flat(self.SHEET, THICKNESS))
        gravity = cloth.gravity.copy()
        cloth.advance(0.2, lambda _: (gravity, np.empty((0, 3)), []), event=0.2)
        assert cloth.total.unconverged == 0
        weight = cloth.masses.sum() * GRAVITY
        smooth, rough = (forces.sum(axis=0) / weight for forces in cloth.surface_forces)
        assert abs(smooth[1]) < 1e-6
        assert smooth[2] == pytest.approx(-0.5, abs=0.13)  # the middle row of vertices lies on both
        assert smooth[2] + rough[2] == pytest.approx(-1.0, abs=1e-3)
        assert cloth.velocities[:, 1].mean() == pytest.approx(0.05, rel=0.02)

    def test_refusals(self) -> None:
        corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        with pytest.raises(ValueError, match="mu: must be in"):
            Surface([[0, 1, 2]], corners, -0.1)
        with pytest.raises(ValueError, match="thickness: must be finite and >= 0"):
            Surface([[0, 1, 2]], corners, 0.1, -1.0)
        with pytest.raises(ValueError, match=r"triangles: must be \(T, 3\)"):
            Surface([[0, 1]], corners, 0.1)
        with pytest.raises(ValueError, match=r"triangles: must index 3 vertices, got 0 \.\.\. 3"):
            Surface([[0, 1, 3]], corners, 0.1)
        with pytest.raises(
            ValueError, match="triangles: must have an area, and triangle 1 has none"
        ):
            Surface([[0, 1, 2], [0, 1, 1]], corners, 0.1)
        with pytest.raises(ValueError, match="positions: must be finite, and are not at 0 s"):
            Surface([[0, 1, 2]], np.full((3, 3), np.nan), 0.1)
        with pytest.raises(ValueError, match=r"positions: must be \(N, 3\)"):
            Surface([[0, 1, 2]], [0.0, 1.0, 2.0], 0.1)
        with pytest.raises(ValueError, match="mu: of a surface must be one or of 1 sheets"):
            Cloth(
                self.SHEET,
                MATERIAL,
                CERTIFIED,
                surfaces=[Surface([[0, 1, 2]], corners, [0.1, 0.2])],
            )
        cloth = Cloth(
            self.SHEET, MATERIAL, CERTIFIED, surfaces=[Surface([[0, 1, 2]], corners, 0.1)]
        )
        with pytest.raises(ValueError, match="positions: must not cross a surface"):
            cloth.set_state(flat(self.SHEET)[:, [0, 2, 1]] + 0.01)
        growing = Surface(
            [[0, 1, 2]],
            lambda time: np.ones((3 + (time > 0.0), 3)) * np.eye(4)[: 3 + (time > 0.0), :3],
            0.1,
        )
        cloth = Cloth(self.SHEET, MATERIAL, CERTIFIED, surfaces=[growing])
        with pytest.raises(ValueError, match="positions: of surfaces must keep their vertices"):
            cloth.step(0.02)


class TestNothingCrosses:
    @pytest.mark.parametrize("seed", [0, 1, 3])
    def test_crumpled_sheet_that_falls(self, seed: int) -> None:
        """Of a sheet that is doubled over: whichever way it crumples, its halves meet."""
        rng = np.random.default_rng(seed)
        mesh = meshes.unstructured(0.1, 0.1, 0.01, seed)
        cloth = Cloth(mesh, SOFT, CERTIFIED, self_contact=SelfContact(float(rng.uniform(0.0, 1.0))))
        u, v = mesh.rest.T
        wave = 0.004 * np.sin(80.0 * u + rng.uniform(0, 6))
        along, above = doubled_over(v - v.min(), length=0.1, radius=0.004)
        cloth.set_state(np.column_stack([0.9 * u, along, 0.03 + above + wave]))
        unconverged = watched(cloth, 40, 0.01, bodies=[plane(0.4)])
        assert cloth.total.least_distance < 1.01 * THICKNESS  # it did touch itself
        assert cloth.total.least_distance > 0.9 * THICKNESS
        assert unconverged <= 1

    @pytest.mark.parametrize(
        "name",
        [
            "drop-1",
            "folding-0",
            "folding-1",
            "pile-0",
            *(pytest.param(n, marks=pytest.mark.slow) for n in ("drop-3", "pile-1")),
        ],
    )
    def test_tumbles(self, name: str) -> None:
        history = tumbles.watch(tumbles.tumble(name))
        assert history.crossing_steps == 0
        assert 0.9 < history.least_distance < 1.01  # they did touch themselves
        assert history.unconverged_steps == 0

    def test_crossings_are_seen(self) -> None:
        """Of a sheet whose corner is stuck through another one, and of one that lies in the same
        plane.
        """
        large, two = meshes.grid(0.1, 0.1, 4, 4), meshes.unstructured(0.05, 0.05, 0.015, 1)
        mesh = meshes.together(large, two)
        both = np.concatenate([flat(large), flat(two)[:, [0, 2, 1]] + [0.003, 0.002, 0.01]])
        triangles = np.asarray(mesh.triangles)
        assert tumbles.crossings(both, triangles, both, triangles) > 0
        assert self_intersections(both, triangles) > 0
        both[len(large.rest) :] = flat(two) + np.array([0.003, 0.002, 0.0])
        assert tumbles.crossings(both, triangles, both, triangles) == 0

    def test_no_such_tumble(self) -> None:
        with pytest.raises(ValueError, match=r"tumble: must be one of drop-0, .*, got 'fall'"):
            tumbles.tumble("fall")

    def test_held_vertices_do_not_pass_through(self) -> None:
        """A sheet is pushed through another one, both of them held: the step is counted as
        unconverged.
        """
        a, b = meshes.grid(0.05, 0.05, 5, 5), meshes.grid(0.02, 0.02, 2, 2)
        mesh = meshes.together(a, b)
        held = np.arange(len(mesh.rest) - 1)
        hasty = replace(CERTIFIED, halvings_max=1, newton_max=10)
        cloth = Cloth(mesh, MATERIAL, hasty, held=held, self_contact=SelfContact(0.3))
        start = np.concatenate(
            [
                np.column_stack([a.rest, np.zeros(len(a.rest))]),
                np.column_stack([b.rest, np.full(len(b.rest), 0.001)]),
            ]
        )
        cloth.set_state(start)
        ends = start[held].copy()
        ends[len(a.rest) :, 2] = -0.02
        report = cloth.step(0.02, held=ends)
        assert not report.converged
        assert cloth.total.unconverged == 1
        assert self_intersections(cloth.positions, mesh.triangles) == 0
        assert cloth.positions[len(a.rest) :, 2].min() > 0.0
        ends[len(a.rest) :, 2] = 0.002
        assert cloth.step(0.02, held=ends).converged

    @pytest.mark.parametrize(("end", "unconverged"), [(0.002, 0), (-0.005, 1)])
    def test_a_step_ends_where_its_holders_are(self, end: float, unconverged: int) -> None:
        """One held sheet goes to another, and through it: forces on the free corners balance, but
        nothing arrives.
        """
        sheet = meshes.grid(0.02, 0.08, 2, 8)
        count, away = len(sheet.rest), sheet.rest[:, 1] >= 0.0
        held = np.flatnonzero(np.tile(sheet.rest[:, 1] < 0.0399, 2))
        cloth = Cloth(
            meshes.together(sheet, sheet),
            MATERIAL,
            CERTIFIED,
            held=held,
            self_contact=SelfContact(0.5, THICKNESS),
        )
        start = np.concatenate([flat(sheet, 0.005), flat(sheet)])
        cloth.set_state(start)
        ends = start.copy()
        ends[:count, 2] = np.where(away, 0.005, end)
        cloth.step(0.02, held=ends[held])
        assert cloth.total.unconverged == unconverged
        assert bool((cloth.positions[held] == ends[held]).all()) is not bool(unconverged)

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
        tolerated = (
            CERTIFIED.tolerance * cloth.force_scale * len(rest) * 0.1
        )  # residuals times time
        assert np.abs(after - before).max() < tolerated
        assert tolerated < 1e-3 * size
        assert cloth.velocities[level == 1, 2].mean() > -0.05  # they did collide

    def test_forces_of_pairs_are_equal_and_opposite(self) -> None:
        """To rounding.

        Friction acts on both sides of the thickness, and so turns: by the thickness times friction.
        """
        tumble = tumbles.tumble("folding-0")
        tumbles.watch(tumble, 100)
        sums = tumbles.balance(tumble.cloth)
        assert sums.pairs > 5
        assert np.abs(sums.force).max() < 1e-15 * sums.size
        assert sums.moment == pytest.approx(
            sums.moment_of_friction, abs=1e-12 * THICKNESS * sums.size
        )
        assert np.linalg.norm(sums.moment) > 0.05 * THICKNESS * sums.size  # it is not nothing

    def test_rerun_is_bit_identical(self) -> None:
        def run() -> tuple[bytes, bytes]:
            two = Stack(2, 0.5, CERTIFIED, 4, 1)
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

    @pytest.mark.parametrize("thickness", [0.0, -1.0, float("nan"), [1e-4, 0.0], [[1e-4]]])
    def test_thickness(self, thickness: object) -> None:
        with pytest.raises(ValueError, match="thickness: must be finite and > 0"):
            SelfContact(0.5, np.asarray(thickness))

    def test_thickness_of_a_fine_mesh(self) -> None:
        with pytest.raises(ValueError, match="thickness: must be less than the distance at rest"):
            Cloth(self.MESH, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5, 0.009))

    def test_bearing(self) -> None:
        with pytest.raises(
            ValueError, match="bearing: must be one of all, vertices, first, got 'second'"
        ):
            SelfContact(0.5, bearing="second")

    def test_number_of_sheets(self) -> None:
        with pytest.raises(ValueError, match="mu: must be of 1 sheets"):
            Cloth(self.MESH, MATERIAL, CERTIFIED, self_contact=SelfContact(np.full((2, 2), 0.1)))
        with pytest.raises(ValueError, match="thickness: must be of 1 sheets"):
            Cloth(self.MESH, MATERIAL, CERTIFIED, self_contact=SelfContact(0.1, [1e-4, 1e-4]))

    def test_state_that_crosses_itself(self) -> None:
        mesh = meshes.together(self.MESH, self.MESH)
        cloth = Cloth(mesh, MATERIAL, CERTIFIED, self_contact=SelfContact(0.5))
        flat = np.column_stack([self.MESH.rest, np.zeros(81)])
        with pytest.raises(ValueError, match="must not cross itself"):
            cloth.set_state(np.concatenate([flat, flat[:, [0, 2, 1]] + [0.0, 0.001, 0.0]]))
