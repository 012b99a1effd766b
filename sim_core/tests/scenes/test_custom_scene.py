"""Custom scenes: sheets, bodies that move, and friction of each two."""

from typing import Any

import numpy as np
import pytest

from stickslip_sim_core import Keyframes, Sheet, fabric, plane
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes import custom
from stickslip_sim_core.scenes.holders import Holder

MESH = meshes.grid(0.06, 0.06, 4, 4)


def flat(height: float) -> np.ndarray:
    return np.column_stack([MESH.rest, np.full(len(MESH.rest), height)])


def sheet(height: float, **more: Any) -> Sheet:
    return Sheet(MESH, fabric("gray-interlock"), flat(height), **more)


class TestRunScene:
    def test_two_sheets_on_a_floor(self) -> None:
        run = custom.scene(
            [sheet(0.0), sheet(0.001)],
            [[0.5, 0.3], [0.3, 0.5]],
            duration=0.5,
            frame_rate=10.0,
            bodies=[plane(0.4)],
            preset="fast",
        ).run()
        assert run.valid, run.reason
        assert run.positions.shape == (6, 50, 3)
        assert run.times == pytest.approx(np.arange(6) / 10)
        assert not run.self_intersections.any()
        weight = fabric("gray-interlock").density * 0.06**2 * GRAVITY
        assert run.contact_force[-1, :, 2] == pytest.approx([weight, weight], rel=1e-3)
        assert run.positions[-1, 25:, 2] == pytest.approx(np.full(25, 5e-4), abs=1e-5)  # on the other
        assert run.holder_force[-1] == pytest.approx(np.zeros((2, 3)))

    @pytest.mark.parametrize(("tilt", "slips"), [(0.9, False), (1.1, True)])
    def test_a_floor_that_tilts_lets_go_at_mu(self, tilt: float, slips: bool) -> None:
        mu = 0.3
        angle = float(np.arctan(tilt * mu))
        keys = Keyframes([0.0, 2.0], np.zeros((2, 3)), np.array([[0, 0, 0], [0, angle, 0]]))

        def floor(time: float) -> list[Any]:
            turn, _ = keys.at(time)
            return [plane(mu, normal=turn[:, 2])]

        run = custom.scene([sheet(0.0)], [[0.5]], duration=2.5, frame_rate=4.0, bodies=floor, preset="fast").run()
        assert run.valid, run.reason
        along = run.positions[-1] @ np.array([np.cos(angle), 0.0, -np.sin(angle)])
        moved = along.mean() - run.positions[0, :, 0].mean()
        assert (moved > 1e-3) == slips

    def test_holders_take_a_sheet_along(self) -> None:
        corner = np.flatnonzero((MESH.rest > 0.029).all(axis=1))
        start = flat(0.1)[corner]
        lifted = Keyframes([0.0, 1.0], np.array([[0, 0, 0], [0, 0, 0.05]]), np.zeros((2, 3)))
        held = sheet(0.1, holders=[Holder(corner, lifted.pose)])
        run = custom.scene([held], [[0.5]], duration=4.0, frame_rate=2.0, preset="fast").run()
        assert run.valid, run.reason
        assert run.positions[-1, corner] == pytest.approx(start + np.array([0.0, 0.0, 0.05]))
        weight = fabric("gray-interlock").density * 0.06**2 * GRAVITY
        assert run.holder_force[-1, 0, 2] == pytest.approx(weight, rel=0.2)  # it swings a little

    def test_a_release_lets_go_without_a_kick(self) -> None:
        """A sheet thrown upward flies on as it was moved: in each frame after it the mean of z falls by g t^2/2."""
        every = np.arange(len(MESH.rest) - 1)  # one vertex is free
        thrown = Keyframes([0.0, 0.5], np.array([[0, 0, 0], [0, 0, 1.0]]), np.zeros((2, 3)))
        run = custom.scene(
            [sheet(0.1, holders=[Holder(every, thrown.pose, (0.0, 0.25))])],
            [[0.5]],
            duration=0.5,
            frame_rate=20.0,
        ).run()
        assert run.valid, run.reason
        z = run.positions[:, every, 2].mean(axis=1)
        speed = 3.0 / (2.0 * 0.5)  # of the smooth keyframes in their middle [m/s]
        t = run.times[5:] - 0.25
        assert z[5] == pytest.approx(0.6, abs=1e-9)
        assert z[5:] == pytest.approx(0.6 + speed * t - 0.5 * GRAVITY * t**2, abs=5e-3)
        assert run.holder_force[6:] == pytest.approx(np.zeros((5, 1, 3)))

    def test_a_grasp_takes_vertices_where_they_are(self) -> None:
        """A sheet falls, is caught at a corner, and hangs there."""
        corner = np.flatnonzero((MESH.rest > 0.029).all(axis=1))
        lifted = Keyframes([0.0, 0.1, 1.0], np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0.05]]), np.zeros((3, 3)))
        run = custom.scene(
            [sheet(0.5, holders=[Holder(corner, lifted.pose, (0.1, np.inf))])],
            [[0.5]],
            duration=2.0,
            frame_rate=20.0,
            preset="fast",
        ).run()
        assert run.valid, run.reason
        caught = run.positions[2, corner]
        assert caught[:, 2] == pytest.approx(0.5 - 0.5 * GRAVITY * 0.1**2, abs=3e-3)
        assert run.positions[-1, corner] == pytest.approx(caught + np.array([0.0, 0.0, 0.05]), abs=1e-9)

    def test_the_same_scene_gives_the_same_bits(self) -> None:
        runs = [
            custom.scene([sheet(0.001)], [[0.5]], duration=0.2, bodies=[plane(0.4)], preset="fast").run()
            for _ in range(2)
        ]
        assert np.array_equal(runs[0].positions, runs[1].positions)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"sheets": []}, "sheets: must be at least one, got none"),
            ({"duration": 0.0}, "duration: must be finite and > 0, got 0.0"),
            ({"frame_rate": float("nan")}, "frame_rate: must be finite and > 0, got nan"),
            ({"duration": 1e6}, "duration: must give at most 10000 frames"),
            ({"gravity": [0.0, 0.0]}, "gravity: must be three finite numbers"),
            ({"friction": [[-1.0]]}, r"mu: must be in \[0, 10\]"),
            (
                {"sheets": [Sheet(MESH, fabric("gray-interlock"), np.zeros((3, 3)))]},
                r"positions: of sheet 0 must be \(25, 3\)",
            ),
            (
                {"sheets": [Sheet(meshes.together(MESH, MESH), fabric("gray-interlock"), np.zeros((50, 3)))]},
                "mesh: of sheet 0 must hang together in one piece",
            ),
        ],
    )
    def test_refusals(self, change: dict[str, Any], message: str) -> None:
        arguments: dict[str, Any] = {"sheets": [sheet(0.1)], "friction": [[0.5]], "duration": 1.0}
        with pytest.raises(ValueError, match=message):
            custom.scene(**arguments | change).run()
