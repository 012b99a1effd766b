"""Smooth surfaces through prescribed triangles: feet of points, and cloth that touches them vertex
by vertex.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from stickslip_testing.spheres import icosphere

from stickslip_sim_core import (
    Cloth,
    Surface,
    isotropic,
    plane,
    preset_named,
    self_intersections,
    sphere,
)
from stickslip_sim_core import _testing as core
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import CREASE, THICKNESS
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.protocols.inclined_plane import tilted

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]
Triangles = NDArray[np.int32]

CERTIFIED = preset_named("certified")
STIFF = isotropic(0.2, 200.0, 2e-5)
SHEET = meshes.grid(0.06, 0.06, 6, 6)


def directions(count: int, seed: int = 0) -> Floats:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Floats = d / np.linalg.norm(d, axis=1)[:, None]
    return unit


def bumpy(subdivisions: int = 3) -> tuple[Floats, Triangles]:
    """A closed mesh whose curvature changes its sign."""
    x, triangles = icosphere(subdivisions)
    return x * (1.0 + 0.1 * np.sin(3.0 * x[:, 0] + 1.0) * np.cos(4.0 * x[:, 1]))[:, None], triangles


class TestFeet:
    @pytest.mark.parametrize("height", [0.02, -0.02])
    def test_distance_to_a_sphere_is_of_fourth_order(self, height: float) -> None:
        d = directions(1000)
        errors, turns = [], []
        for subdivisions in (2, 3, 4):
            x, triangles = icosphere(subdivisions)
            heights, normal, point, _ = core.feet(triangles, x, CREASE, (1.0 + height) * d)
            errors.append(np.abs(heights - height).max())
            turns.append(np.linalg.norm(normal - d, axis=1).max())
            assert heights[:, None] * normal + point == pytest.approx((1.0 + height) * d, abs=1e-12)
        assert errors[0] < 6e-4
        assert np.divide(errors[:-1], errors[1:]).min() > 14.0
        assert np.divide(turns[:-1], turns[1:]).min() > 7.0

    @pytest.mark.parametrize("facets", [24, 48, 96])
    def test_distance_to_a_cylinder_is_of_fourth_order(self, facets: int) -> None:
        angle = 2.0 * np.pi * np.arange(facets) / facets
        ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        x = np.concatenate([ring - np.eye(3)[2], ring + np.eye(3)[2]])
        i, j = np.arange(facets), (np.arange(facets) + 1) % facets
        triangles = np.concatenate(
            [np.stack([i, j, facets + i], 1), np.stack([j, facets + j, facets + i], 1)]
        )
        at = np.random.default_rng(1).uniform([0.0, -0.9], [6.3, 0.9], (500, 2))
        out = np.stack([np.cos(at[:, 0]), np.sin(at[:, 0]), 0.0 * at[:, 0]], axis=1)
        heights, normal, *_ = core.feet(
            triangles.astype(np.int32), x, CREASE, 1.01 * out + at[:, 1:] * [0.0, 0.0, 1.0]
        )
        assert np.abs(heights - 0.01).max() < 0.03 * (2.0 * np.pi / facets) ** 4
        assert np.linalg.norm(normal - out, axis=1).max() < 0.05 * (2.0 * np.pi / facets) ** 3

    def test_normal_is_the_gradient_of_the_height_to_second_order(self) -> None:
        d, step, worst = directions(300, 2), 1e-5, []
        for subdivisions in (3, 4, 5):
            x, triangles = bumpy(subdivisions)
            p = d * (np.linalg.norm(core.feet(triangles, x, CREASE, d)[2], axis=1) + 0.02)[:, None]
            _, normal, *_ = core.feet(triangles, x, CREASE, p)
            height = [
                core.feet(triangles, x, CREASE, p + s * step * e)[0]
                for e in np.eye(3)
                for s in (1.0, -1.0)
            ]
            gradient = (np.array(height[::2]) - np.array(height[1::2])).T / (2.0 * step)
            worst.append(np.linalg.norm(gradient - normal, axis=1).max())
        assert worst[0] < 0.05
        assert np.divide(worst[:-1], worst[1:]).min() > 3.0

    def test_height_and_normal_are_continuous_across_edges(self) -> None:
        """At both ends of short ways from one triangle into another."""
        x, triangles = bumpy(2)
        for height in (0.95, 1.15):
            inner = height * directions(300, 3)
            other = inner + 0.1 * directions(300, 4)
            first = np.asarray(core.feet(triangles, x, CREASE, inner)[3])
            for _ in range(35):
                middle = 0.5 * (inner + other)
                stays = (np.asarray(core.feet(triangles, x, CREASE, middle)[3]) == first)[:, None]
                inner, other = np.where(stays, middle, inner), np.where(stays, other, middle)
            a, b = (core.feet(triangles, x, CREASE, p) for p in (inner, other))
            changed = np.asarray(a[3]) != np.asarray(b[3])
            assert changed.mean() > 0.3
            assert a[0] == pytest.approx(b[0], abs=1e-9)
            assert a[1] == pytest.approx(b[1], abs=1e-8)

    def test_distance_to_what_is_sharp(self) -> None:
        """To a cube, whose triangles turn this way and that, from outside."""
        x = np.array([[a, b, c] for a in (-1.0, 1.0) for b in (-1.0, 1.0) for c in (-1.0, 1.0)])
        quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
        triangles = np.array(
            [t for a, b, c, d in quads for t in ((a, b, c), (a, d, c))], dtype=np.int32
        )
        p = np.random.default_rng(4).uniform(-1.3, 1.3, (2000, 3))
        p = p[np.abs(p).max(axis=1) > 1.0]
        away = p - np.clip(p, -1.0, 1.0)
        distance = np.linalg.norm(away, axis=1)
        heights, normal, *_ = core.feet(triangles, x, CREASE, p)
        sign = np.sign(heights[0])  # the first triangle decides which side is which
        assert sign * heights == pytest.approx(distance, abs=1e-12)
        assert sign * normal == pytest.approx(away / distance[:, None], abs=1e-9)

    def test_distance_beyond_a_border(self) -> None:
        x, triangles = (
            np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
            np.array([[0, 1, 2], [0, 2, 3]]),
        )
        p = np.random.default_rng(5).uniform(-0.5, 1.5, (1000, 3)) * [1.0, 1.0, 0.3]
        nearest = np.clip(p, [0.0, 0.0, 0.0], [1.0, 1.0, 0.0])
        heights, *_ = core.feet(triangles.astype(np.int32), x, CREASE, p)
        assert np.abs(heights) == pytest.approx(np.linalg.norm(p - nearest, axis=1), abs=1e-12)
        inside = (nearest[:, :2] == p[:, :2]).all(axis=1)
        assert heights[inside] == pytest.approx(p[inside, 2], abs=1e-12)

    def test_without_smooth_edges_it_is_the_triangles(self) -> None:
        x, triangles = icosphere(1)
        p = 1.05 * directions(500, 6)
        heights, normal, *_ = core.feet(triangles, x, 0.0, p)
        for i in range(0, 500, 25):
            pairs = [np.vstack([p[i], x[corners]]) for corners in triangles]
            closest = min(
                np.linalg.norm(core.closest_weights(False, four) @ four) for four in pairs
            )
            assert heights[i] == pytest.approx(closest, abs=1e-12)
        assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0)


def ball(radius: float, subdivisions: int) -> tuple[Floats, Triangles]:
    x, triangles = icosphere(subdivisions)
    return radius * x, triangles


def turn(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def over(
    surface: Surface, height: float, mesh: meshes.Mesh = SHEET, fabric: object = STIFF
) -> Cloth:
    """A flat sheet at a height."""
    cloth = Cloth(mesh, fabric, CERTIFIED, surfaces=[surface])  # type: ignore[arg-type]
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), height)]))
    return cloth


def crossings(cloth: Cloth) -> int:
    """Of the cloth and the surface."""
    surface = cloth.surfaces[0]
    at = np.concatenate([cloth.positions, surface.at(cloth.time)])
    every = np.concatenate(
        [cloth.mesh.triangles, np.asarray(surface.triangles) + len(cloth.mesh.rest)]
    )
    return self_intersections(at, every) - self_intersections(cloth.positions, cloth.mesh.triangles)


class TestCloth:
    R = 0.2

    def settled(
        self, mu: float, motion: Callable[[float], Floats] | None = None, subdivisions: int = 4
    ) -> Cloth:
        """A sheet at rest on top of a sphere."""
        x, triangles = ball(self.R, subdivisions)
        at = x if motion is None else lambda time: x @ motion(time).T
        cloth = over(Surface(triangles, at, mu), self.R + 2.0 * THICKNESS)
        for _ in range(40):
            cloth.step(0.02, damping=5.0)
        return cloth

    def test_agrees_with_a_round_sphere(self) -> None:
        """More so the finer the triangles.

        With one scheme for all vertices: of second order, one that lands a little later takes
        another way, and shapes are not all that differs.
        """
        settings = replace(CERTIFIED, second_order=False)
        round_one = Cloth(SHEET, STIFF, settings)
        start = np.column_stack([SHEET.rest, np.full(len(SHEET.rest), self.R + 2.0 * THICKNESS)])
        round_one.set_state(start)
        tilt = tilted(0.1)
        round_one.gravity[:] = tilt
        body = sphere(0.05, self.R + THICKNESS)
        for _ in range(40):
            round_one.step(0.01, bodies=[body])
        off = []
        for subdivisions in (2, 3, 4):
            x, triangles = ball(self.R, subdivisions)
            cloth = Cloth(SHEET, STIFF, settings, surfaces=[Surface(triangles, x, 0.05)])
            cloth.set_state(start)
            cloth.gravity[:] = tilt
            for _ in range(40):
                cloth.step(0.01)
            assert cloth.total.unconverged == 0
            assert not len(cloth.pair_forces.forces)
            off.append(np.linalg.norm(cloth.positions - round_one.positions, axis=1).max())
            assert (cloth.contacts == round_one.contacts).all()
        assert round_one.sliding.any()
        assert off[0] < 5e-4
        assert off[1] < off[0] / 8.0
        assert off[2] < 5e-6
        assert cloth.contact_force() == pytest.approx(
            round_one.contact_force(), abs=1e-3 * cloth.masses.sum() * GRAVITY
        )

    def test_momentum(self) -> None:
        """What the cloth bears, the surface bears with the other sign."""
        cloth = self.settled(0.5)
        touching = cloth.contacts >= 0
        assert touching.any()
        on_cloth = cloth.reactions[touching].sum(axis=0)
        assert cloth.surface_forces[0].sum(axis=0) == pytest.approx(
            -on_cloth, abs=1e-12 * np.abs(on_cloth).max()
        )
        # The balance has the residuals of vertices that touch nothing, too.
        balance = cloth.reactions.sum(axis=0)
        assert cloth.contact_force() == pytest.approx(balance, abs=1e-12 * np.abs(balance).max())

    def test_does_not_creep_within_the_cone(self) -> None:
        """At nine tenths of the steepest slope that its whole way downhill can bear."""
        mu = 0.4
        cloth = self.settled(mu)
        reach = 0.03 * np.sqrt(2.0) / self.R
        cloth.gravity[:] = tilted(np.arctan(0.9 * mu) - reach)
        for _ in range(50):
            cloth.step(0.02)
        before = cloth.positions
        for _ in range(250):
            cloth.step(0.02)
        assert np.abs(cloth.positions - before).max() < 1e-9
        assert cloth.total.unconverged == 0

    def test_carries_what_sticks(self) -> None:
        """On a sphere that turns about the vertical, and as fast about its middle."""
        cloth = self.settled(1.0, lambda time: turn(0.5 * max(time - 0.8, 0.0) ** 2))
        before = cloth.positions
        for _ in range(20):
            cloth.step(0.02)
        assert cloth.positions == pytest.approx(before @ turn(0.5 * 0.4**2).T, abs=2e-6)

    def test_is_carried_by_what_bends(self) -> None:
        """A ground that rises in a wave below a sheet, which sticks to it."""
        ground = meshes.grid(0.2, 0.2, 20, 20)

        def wave(time: float, at: Floats) -> Floats:
            height = 0.002 * min(time, 1.0) * np.cos(30.0 * at[:, 0])
            return np.column_stack([at, height])

        soft = isotropic(0.2, 20.0, 1e-6)
        cloth = over(
            Surface(ground.triangles, lambda time: wave(time, ground.rest), 1.0),
            THICKNESS,
            fabric=soft,
        )
        for _ in range(60):
            cloth.step(0.02)
        assert cloth.total.unconverged == 0
        exact = wave(1.0, cloth.positions[:, :2])[:, 2]
        touching = cloth.contacts >= 0
        assert touching.mean() > 0.5
        assert cloth.positions[touching, 2] - exact[touching] == pytest.approx(THICKNESS, rel=0.05)

    def test_hangs_below(self) -> None:
        """Of an open surface the other side is felt as well."""
        ground = meshes.unstructured(0.1, 0.1, 0.02, 1)
        surface = Surface(
            ground.triangles, np.column_stack([ground.rest, 0.0 * ground.rest[:, 0]]), 0.3
        )
        cloth = over(surface, -1.5 * THICKNESS)
        cloth.gravity[:] = [0.0, 0.0, GRAVITY]
        for _ in range(20):
            cloth.step(0.02)
        assert cloth.positions[:, 2] == pytest.approx(-THICKNESS, abs=1e-8)
        assert cloth.total.unconverged == 0

    def test_coarse_cloth_keeps_off_what_is_curved(self) -> None:
        """So that its triangles do not cut into it: no pair bears, and nodes are as far off as they
        need to be.
        """
        x, triangles = ball(0.04, 3)
        soft = isotropic(0.2, 200.0, 2e-6)
        cloth = over(Surface(triangles, x, 0.5), 0.042, meshes.grid(0.06, 0.06, 4, 4), soft)
        for _ in range(40):
            cloth.step(0.02, damping=5.0)
            assert crossings(cloth) == 0
        touching = cloth.contacts >= 0
        assert touching.sum() > 4
        height = np.linalg.norm(cloth.positions[touching], axis=1) - 0.04
        sinks = 0.5 * 0.015**2 / 2.0 / 0.04
        assert height == pytest.approx(sinks + 0.25 * THICKNESS, rel=0.02)
        assert not len(cloth.pair_forces.forces)

    def test_coarse_cloth_rests_alike_on_coarse_and_fine_triangles(self) -> None:
        """Vertices keep 6 mm from the ball, and coarse triangles are up to 7 mm below it: nodes
        must find them.
        """
        soft, heights, touching = isotropic(0.2, 200.0, 2e-6), [], []
        for subdivisions in (1, 3):
            x, triangles = ball(0.1, subdivisions)
            cloth = over(Surface(triangles, x, 0.5), 0.12, meshes.grid(0.36, 0.36, 8, 8), soft)
            for _ in range(150):
                cloth.step(0.01, damping=10.0)
            touching.append(cloth.contacts >= 0)
            heights.append(cloth.positions)
        assert np.count_nonzero(touching[0]) > 15
        assert np.array_equal(touching[0], touching[1])
        assert heights[0] == pytest.approx(heights[1], abs=1e-3)

    def test_what_starts_nearer_than_it_may_be_is_not_thrown_off(self) -> None:
        """A coarse sheet 1 mm over a ball has to be 5 mm off: it gets there, and falls on as freely
        as without, but for the strain of its new shape.
        """
        x, triangles = ball(0.1, 3)
        cloth = over(
            Surface(triangles, x, 0.5),
            0.101,
            meshes.grid(0.36, 0.36, 8, 8),
            isotropic(0.2, 200.0, 2e-6),
        )
        cloth.step(0.005)
        assert cloth.positions[:, 2].max() > 0.105
        assert np.linalg.norm(cloth.velocities, axis=1).max() < 1.05 * 0.005 * GRAVITY

    def test_corner_of_a_floor_and_a_surface(self) -> None:
        """A wall that pushes a sheet over the floor: vertices bear on both."""
        wall = np.array([[0.0, -0.1, -0.01], [0.0, 0.1, -0.01], [0.0, 0.1, 0.1], [0.0, -0.1, 0.1]])
        pushing = Surface(
            [[0, 1, 2], [0, 2, 3]], lambda time: wall - [0.032 - 0.02 * time, 0.0, 0.0], 0.5
        )
        cloth = over(pushing, 1e-4)
        for _ in range(40):
            cloth.step(0.02, bodies=[plane(0.3)])
            assert crossings(cloth) == 0
        assert cloth.total.unconverged == 0
        assert cloth.positions[:, 0].min() > -0.032 + 0.02 * cloth.time
        assert cloth.positions[:, 2].min() > -1e-8
        assert (cloth.contacts == 0).any()

    def test_what_leaves_a_floor_beside_a_surface_is_not_thrown_off(self) -> None:
        """A sheet slides over a floor to a post of flat sides, 3 mm inside its round surface, and
        is then lifted.
        """
        angle = np.pi / 6.0 * (np.arange(12) + 0.5)
        ring = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        i, j = np.arange(12), (np.arange(12) + 1) % 12
        sides = np.concatenate([np.stack([i, j, 12 + i], 1), np.stack([j, 12 + j, 12 + i], 1)])
        cloth = over(
            Surface(
                sides, np.concatenate([np.add(ring, [0, 0, -0.05]), np.add(ring, [0, 0, 0.2])]), 0.2
            ),
            1e-4,
        )
        cloth.set_state(np.add(cloth.positions, [0.135, 0.0, 0.0]))
        for gravity in ([-5.0, 0.0, -GRAVITY], [0.0, 0.0, GRAVITY]):
            cloth.gravity, speed = np.tile(gravity, (len(SHEET.rest), 1)), np.zeros(0)
            for _ in range(40):
                cloth.step(0.01, bodies=[plane(0.1)])
                speed = np.append(speed, np.linalg.norm(cloth.velocities, axis=1).max())
            if gravity[2] < 0.0:
                assert cloth.positions[:, 0].min() == pytest.approx(
                    0.1 * np.cos(np.pi / 12.0), abs=2e-4
                )
        assert speed == pytest.approx(0.01 * GRAVITY * np.arange(1, 41), rel=0.05)

    def test_what_pokes_through_between_vertices_is_felt(self) -> None:
        """A spike below the middle of a triangle, and the edge of a thin plate along a column of
        cells.
        """
        spike = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * [0.002, 0.002, -0.02] + [
            0.003,
            0.004,
            0.0,
        ]
        faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], dtype=np.int32)
        plate = np.array([[-0.02, -0.05, 0.0], [-0.02, 0.05, 0.0], [-0.02, 0.0, -0.05]])
        x, triangles = (
            np.concatenate([spike, plate]),
            np.concatenate([faces, [[4, 5, 6]]]).astype(np.int32),
        )
        cloth = over(Surface(triangles, x, 0.5), 2.0 * THICKNESS)
        for _ in range(40):
            cloth.step(0.01, damping=2.0)
            assert crossings(cloth) == 0
        assert (cloth.pair_forces.vertices >= len(SHEET.rest)).any()
        assert cloth.total.least_distance > 0.2 * THICKNESS

    @pytest.mark.parametrize(
        "seed", [1, 3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 2))]
    )
    def test_nothing_crosses(self, seed: int) -> None:
        """Soft cloth that is thrown at a lumpy mesh that moves and turns at random."""
        rng = np.random.default_rng(seed)
        x, triangles = bumpy(2)
        x = 0.03 * x * rng.uniform(0.6, 1.4, 3)
        way, spin = rng.normal(size=3) * [0.3, 0.3, 0.2], rng.normal() * 10.0
        surface = Surface(
            triangles,
            lambda time: x @ turn(spin * time).T + way * np.sin(9.0 * time),
            rng.uniform(0.0, 1.0),
        )
        cloth = over(
            surface, 0.06, meshes.unstructured(0.1, 0.1, 0.012, seed), isotropic(0.2, 100.0, 1e-6)
        )
        cloth.set_state(cloth.positions, np.tile([0.0, 0.0, -2.0], (len(cloth.mesh.rest), 1)))
        for _ in range(50):
            cloth.step(0.01)
            assert crossings(cloth) == 0
        assert cloth.total.least_distance < THICKNESS
        assert cloth.total.unconverged <= 1

    def test_a_rerun_is_the_same_to_the_bit(self) -> None:
        assert (
            self.settled(0.3, subdivisions=3).positions.tobytes()
            == self.settled(0.3, subdivisions=3).positions.tobytes()
        )

    def test_refusals(self) -> None:
        corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        for crease in (-0.1, 4.0, float("nan")):
            with pytest.raises(ValueError, match=r"crease: must be in \[0, pi\] rad"):
                Surface([[0, 1, 2]], corners, 0.1, crease=crease)
