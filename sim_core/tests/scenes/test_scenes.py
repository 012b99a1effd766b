"""Drop-and-drag: the path of the holders, and on a coarse mesh."""

from dataclasses import replace

import numpy as np
import pytest

from stickslip_sim_core import ClothRun, fabric, fabric_names
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes import cloth_drag, holders
from stickslip_sim_core.scenes.scene import fabric_labels

pytestmark = pytest.mark.physics

DURATION = cloth_drag.duration_of(cloth_drag.DROP) + cloth_drag.LEGS * cloth_drag.duration_of(
    cloth_drag.DRAG
)  # s


def test_the_label_of_softening_is_a_length_and_zero_without_it() -> None:
    constant = fabric("gray-interlock")
    softening = replace(constant, softening=400.0)
    assert fabric_labels(constant)["softening_length"] == 0.0
    assert fabric_labels(softening, "scarf.")["scarf.softening_length"] == pytest.approx(2.5e-3)


@pytest.fixture(scope="module")
def dragged() -> ClothRun:
    """The first leg and the turn, mu = 0.5."""
    return cloth_drag.scene("gray-interlock", 0.5, mesh=11, frames=110).run()


class TestHolders:
    def test_lengths_and_times(self) -> None:
        """6 cm down, 30 cm to, fro, to, fro, at 1 cm/s after a second of 1 cm/s^2: 7 s and four
        times 31 s.
        """
        assert cloth_drag.duration_of(0.06) == pytest.approx(7.0)
        assert cloth_drag.duration_of(0.3) == pytest.approx(31.0)
        assert pytest.approx(131.0) == DURATION
        ends = [
            cloth_drag.holder_path(t).tolist() for t in (0.0, 7.0, 38.0, 69.0, 100.0, 131.0, 140.0)
        ]
        x = [0.0, 0.0, 0.3, 0.0, 0.3, 0.0, 0.0]
        assert np.array(ends) == pytest.approx(np.column_stack([x, [0.0] + [-0.06] * 6]), abs=1e-12)

    def test_speeds(self) -> None:
        t = np.arange(0.0, 131.0, 1e-2)
        path = np.stack([cloth_drag.holder_path(time) for time in t])
        speed = np.diff(path, axis=0) / 1e-2
        assert np.abs(speed).max() == pytest.approx(0.01, rel=1e-9)
        assert np.abs(np.diff(speed, axis=0) / 1e-2).max() < 0.01 * 2.0 + 1e-6
        down, drag = t[:-1] < 7.0, t[:-1] >= 7.0
        assert (speed[down][:, 1] <= 1e-12).all()
        assert np.abs(speed[down][:, 0]).max() == 0.0
        assert np.abs(speed[drag][:, 1]).max() < 1e-12
        assert np.mean(np.isclose(np.abs(speed[drag][:, 0]), 0.01)) == pytest.approx(
            29.0 / 31.0, abs=0.01
        )

    def test_frames_cover_it(self) -> None:
        assert cloth_drag.FRAMES == 300
        assert cloth_drag.FRAME_RATE == 2.4
        assert 124.0 < (cloth_drag.FRAMES - 1) / cloth_drag.FRAME_RATE <= DURATION


class TestClothRun:
    def test_is_valid(self, dragged: ClothRun) -> None:
        assert dragged.valid, dragged.reason
        assert dragged.reason == ""
        assert dragged.positions.shape == (110, 121, 3)
        assert dragged.labels["unconverged_steps"] == 0
        assert 0.0 < dragged.labels["worst_residual"] <= 1e-3
        assert dragged.self_intersections.shape == (110,)

    def test_frames_are_at_their_times(self, dragged: ClothRun) -> None:
        """Held corners are where the holders are at k/2.4 s, to 0.02 mm: between steps they are on
        a cubic.
        """
        assert dragged.times == pytest.approx(np.arange(110) / 2.4)
        corner = int(np.argmax(dragged.rest.sum(axis=1)))
        came = dragged.positions[:, corner] - dragged.positions[0, corner]
        path = np.stack([cloth_drag.holder_path(t) for t in dragged.times])
        assert came[:, [0, 2]] == pytest.approx(path, abs=2e-5)
        assert dragged.record["holder_pose"][:, [0, 2], 3] == pytest.approx(path, abs=1e-12)
        assert np.abs(came[:, 1]).max() == 0.0

    def test_starts_at_rest_over_the_floor(self, dragged: ClothRun) -> None:
        assert dragged.positions[0, :, 2].min() == pytest.approx(
            cloth_drag.CLEARANCE, abs=2e-3
        )  # it sags
        assert dragged.positions[:, :, 2].min() > -2e-5  # between steps, on a cubic
        assert dragged.positions[60, :, 2].min() < 1e-9

    def test_friction_in_the_steady_drag(self, dragged: ClothRun) -> None:
        """Against the motion, and mu times the normal force, from the balance of momentum."""
        steady = (dragged.times > 22.0) & (dragged.times < 37.0)
        force = dragged.record["contact_force"][steady]
        assert (force[:, 0] < 0.0).all()
        ratio = np.hypot(force[:, 0], force[:, 1]) / force[:, 2]
        assert np.median(ratio) == pytest.approx(0.5, rel=1e-3)
        assert ratio == pytest.approx(0.5, rel=1e-2)

    def test_forces_carry_the_weight(self, dragged: ClothRun) -> None:
        weight = fabric("gray-interlock").density * 0.04 * GRAVITY
        assert dragged.record["holder_force"][0] == pytest.approx([0.0, 0.0, weight], rel=1e-9)
        steady = (dragged.times > 22.0) & (dragged.times < 37.0)
        lifted = (dragged.record["holder_force"] + dragged.record["contact_force"])[steady]
        assert lifted[:, 2] == pytest.approx(weight, rel=0.02)
        assert np.abs(lifted[:, :2]).max() < 0.02 * weight

    def test_side_is_drawn_from_the_seed_and_followed(self) -> None:
        """The hung cloth bellies to the side of the bias; where it lands is a label of its own."""
        sides = set()
        for seed in range(4):
            fallen = cloth_drag.scene("gray-interlock", 0.5, mesh=7, frames=18, seed=seed).run()
            assert 1e-3 <= fallen.labels["bias"] <= 3e-3
            assert fallen.labels["bias_side"] == np.sign(fallen.positions[0, :, 0].mean())
            held = cloth_drag.held_by_holders(meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, 6, 6))
            offset = fallen.positions[17, :, 0].mean() - fallen.positions[17, held, 0].mean()
            assert fallen.labels["landed_side"] == np.sign(offset)
            sides.add(fallen.labels["bias_side"])
        assert sides == {-1, 1}
        assert (
            cloth_drag.scene("gray-interlock", 0.5, mesh=7, frames=17).run().labels["landed_side"]
            == 0
        )

    def test_hung_shape_is_one(self) -> None:
        """Whatever the preset, settings and kernels: to 1e-6 mm and 1e-3 mm."""
        mesh = meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, 10, 10)
        first = cloth_drag.hang(mesh, fabric("camel-ponte-roma"), seed=0)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                holders, "HANGING", replace(holders.HANGING, tolerance=1e-4, time_step=0.035)
            )
            second = cloth_drag.hang(mesh, fabric("camel-ponte-roma"), seed=0, kernel="baseline")
        assert first.reason == second.reason == ""
        assert second.positions == pytest.approx(first.positions, abs=1e-6)
        starts = [
            cloth_drag.scene("gray-interlock", 0.5, mesh=9, frames=1, preset=preset)
            .run()
            .positions[0]
            for preset in ("certified", "fast", "thesis-high")
        ]
        assert (starts[0] == starts[1]).all()
        assert (starts[0] == starts[2]).all()

    def test_hangs_under_its_gravity(self) -> None:
        """A scene that is turned has the turned shape, and half the gravity another one."""
        mesh = meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, 8, 8)
        cloth_fabric = fabric("gray-interlock")
        held = cloth_drag.held_by_holders(mesh)
        flat = np.column_stack([0.0 * mesh.rest[:, 0], mesh.rest])
        down = np.array([0.0, 0.0, -GRAVITY])
        # From z to x, from x to y, from y to z.
        turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

        def shape(turn: Floats, gravity: Floats) -> Floats:
            hung_shape = holders.hung(
                mesh,
                cloth_fabric,
                flat @ turn.T,
                held,
                normal=turn[:, 0],
                seed=0,
                gravity=turn @ gravity,
            )
            assert hung_shape.reason == ""
            return hung_shape.positions @ turn

        upright = shape(np.eye(3), down)
        assert shape(turn, down) == pytest.approx(upright, abs=1e-6)
        assert np.abs(shape(turn, 0.5 * down) - upright).max() > 1e-4
        with pytest.raises(ValueError, match="gravity: cloth can only hang under gravity, got"):
            shape(turn, 0.0 * down)

    def test_every_fabric_comes_to_rest(self) -> None:
        """Also one that stiffens so fast that its steps swing about the shape at rest."""
        mesh = meshes.grid(cloth_drag.SIDE, cloth_drag.SIDE, 20, 20)
        for name in fabric_names():
            hung = cloth_drag.hang(mesh, fabric(name), seed=0)
            assert hung.reason == "", name
            assert not hung.reason, name

    def test_hung_shape_that_does_not_settle_is_not_valid(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(holders, "HANGING_STEPS_MAX", 2)
        scene = cloth_drag.scene("gray-interlock", 0.5, mesh=7, frames=1).run()
        assert not scene.valid
        assert "did not come to rest" in scene.reason

    def test_frames_are_announced(self) -> None:
        announced: list[tuple[int, int]] = []
        cloth_drag.scene("gray-interlock", 0.5, mesh=5, frames=4).run(
            lambda *done: announced.append(done)
        )
        assert announced == [(2, 4), (3, 4), (4, 4)]

    def test_kernel_is_recorded(self) -> None:
        scene = cloth_drag.scene("gray-interlock", 0.5, mesh=5, frames=2, kernel="baseline").run()
        assert scene.labels["kernel"] == "baseline"
        with pytest.raises(
            ValueError, match="kernel: must be one that this processor runs, baseline"
        ):
            cloth_drag.scene("gray-interlock", 0.5, mesh=5, frames=2, kernel="best").run()

    def test_rerun_is_bit_identical(self) -> None:
        first, second = (
            cloth_drag.scene("gray-interlock", 0.3, mesh=7, frames=30).run() for _ in range(2)
        )
        assert first.positions.tobytes() == second.positions.tobytes()
        assert first.record["contact_force"].tobytes() == second.record["contact_force"].tobytes()

    def test_other_meshes_and_presets(self) -> None:
        mesh = meshes.unstructured(cloth_drag.SIDE, cloth_drag.SIDE, 0.02, 1)
        assert (
            cloth_drag.scene("gray-interlock", 0.3, mesh=mesh, frames=8, preset="fast").run().valid
        )

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"frames": 0}, r"frames: must be in \[1, 300\], got 0"),
            ({"frames": 301}, r"frames: must be in \[1, 300\], got 301"),
            ({"mesh": 4}, r"mesh: must be in \[5, inf\], got 4"),
            ({"preset": "best"}, "preset: must be one of"),
            ({"material": "silk"}, "fabric: must be one of"),
            ({"mu": -0.1}, r"mu: must be in \[0, 10\], one or one a sheet, got -0.1"),
            ({"self_friction": -1.0}, r"mu: must be in \[0, 10\], got -1.0"),
            ({"mu": float("nan")}, r"mu: must be in \[0, 10\], one or one a sheet, got nan"),
        ],
    )
    def test_refusals(self, settings: dict[str, object], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            cloth_drag.scene(**{"material": "gray-interlock", "mu": 0.5, **settings}).run()  # type: ignore[arg-type]
