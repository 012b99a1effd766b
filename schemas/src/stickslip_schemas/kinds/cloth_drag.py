"""A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

from enum import StrEnum
from typing import Annotated, Literal

from stickslip_schemas.arrays import NAN, ArrayLayout
from stickslip_schemas.axes import SHORTHAND, ListAxis
from stickslip_schemas.cloth import PHYSICAL_AXES, ClothAxes, ClothRender, ClothSimulation, ClothSpec, TextureAxis
from stickslip_schemas.jobs import SeedRule


class Viewpoint(StrEnum):
    """Cameras of the rig `drag-3`; the first is calibrated on the real stage.

    Their order gives the codes of the label `viewpoint`: add new ones at the end.
    """

    calibrated = "calibrated"
    left = "left"
    right = "right"


class ClothDragAxes(ClothAxes):
    """What a clip of dragged cloth depends on."""

    texture: TextureAxis
    viewpoint: Annotated[ListAxis[Viewpoint], SHORTHAND]


class ClothDragSimulation(ClothSimulation):
    """The trajectory of a dragged cloth: all that it depends on besides the build."""

    kind: Literal["cloth_drag"] = "cloth_drag"


class ClothDragRender(ClothRender):
    """How a dragged cloth is seen."""

    kind: Literal["cloth_drag"] = "cloth_drag"
    viewpoint: Viewpoint


class ClothDragSpec(ClothSpec):
    """A square of cloth dropped on a plane and dragged to and fro [thesis, 4.2.3]."""

    simulation_type = ClothDragSimulation
    render_type = ClothDragRender
    simulation_seeds = (SeedRule("seed", "bias", PHYSICAL_AXES),)
    render_seeds = (SeedRule("light_seed", "light", (*PHYSICAL_AXES, "viewpoint")),)
    instants = 300
    instants_per_second = 2.4
    rig = "drag-3"

    kind: Literal["cloth_drag"]
    axes: ClothDragAxes

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of dragged cloth."""
        forces = (
            ("contact_force", "force of the floor on the cloth [N]"),
            ("holder_force", "force of the holders on the cloth [N]"),
        )
        return (
            *self.clip_arrays(tuple(Viewpoint)),
            *self.physical_arrays(),
            ArrayLayout("side", "int8", (), (), "side to which gravity leaned during the drop, +1 or -1 along x"),
            ArrayLayout(
                "bias",
                "float64",
                (),
                (),
                "what broke the symmetry: horizontal over vertical gravity during the drop",
                fill=NAN,
            ),
            *self.solver_arrays(),
            *(self.over_time(name, "float32", (3,), ("xyz",), text, fill=NAN) for name, text in forces),
            *self.mesh_arrays(),
        )
