"""Drop and drag: a square of cloth, held at two corners, is lowered onto a floor and dragged [thesis, 4.2.3]."""

from collections.abc import Callable

from stickslip_sim_core import stage
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import plane
from stickslip_sim_core.cloth.contact import SELF_FRICTION, SelfContact
from stickslip_sim_core.cloth.fabrics import Fabric, fabric_of
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth


def drop_and_drag(
    fabric: str | Fabric,
    mu: float,
    *,
    preset: str | SolverSettings = "certified",
    vertices: int = 41,
    frames: int = stage.FRAMES,
    seed: int = 0,
    mesh: meshes.Mesh | None = None,
    self_friction: float | None = SELF_FRICTION,
    kernel: str | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> stage.DropAndDrag:
    """Hold a square of cloth by two corners, lower it onto a plane and drag it to and fro [thesis, 4.2.3].

    The cloth hangs at rest, 1 cm over the floor, when the holders start to move. A drop without imperfection would
    buckle to neither side: gravity is tilted along x by `bias`, a little more on one side of the cloth than on the
    other, both drawn from `seed`, until the drop ends, and set upright within the second after.

    Args:
        fabric: One of `fabric_names()`, or a custom one.
        mu: Coefficient of friction between cloth and floor, 0 ... 10.
        preset: Solver settings, or their name.
        vertices: Vertices a side of the mesh, at least 5.
        frames: Frames to simulate, 2.4 a second from 0 on; 300 are the whole motion.
        seed: Of the bias.
        mesh: Instead of the structured mesh of `vertices`: one of the square of side `stage.SIDE`.
        self_friction: Coefficient of friction of the cloth with itself, 0 ... 10; None: it passes through itself.
        kernel: Level of the kernels, see `Cloth`.
        on_frame: Called with (frames done, frames) after every frame.

    Raises:
        ValueError: An argument breaks its rule.
    """
    settings = preset_named(preset)
    stage.frames_checked(frames, vertices)
    mesh = meshes.grid(stage.SIDE, stage.SIDE, vertices - 1, vertices - 1) if mesh is None else mesh
    held = stage.held_by_holders(mesh)
    floor = [plane(mu)]
    feels = None if self_friction is None else SelfContact(self_friction)
    cloth = Cloth(mesh, fabric_of(fabric), settings, held=held, self_contact=feels, kernel=kernel)
    hung = stage.hang(mesh, cloth.fabrics[0], seed=seed, kernel=kernel)
    cloth.set_state(hung.positions)
    motion = stage.motion_of(cloth, floor, hung.positions[held], hung.tilt)
    return stage.run(cloth, mesh, hung, motion, frames=frames, contact_force=Cloth.contact_force, on_frame=on_frame)
