"""A shawl over the shoulders of a figure that moves [thesis, 4.6]."""

from typing import Annotated, Literal

from pydantic import Field

from stickslip_schemas.base.document import Int
from stickslip_schemas.kinds.cloth.arrays import (
    clip_arrays,
    forces,
    mesh_arrays,
    over_time,
    physical_arrays,
    solver_arrays,
)
from stickslip_schemas.kinds.cloth.names import CUSTOM_LOOKS, Custom, TextureAxis, ThreeViewpoint, ThreeViewpointAxis
from stickslip_schemas.kinds.cloth.spec import (
    PHYSICAL_AXES,
    ClothAxes,
    ClothRender,
    ClothSimulation,
    ClothSpec,
    MuAxis,
    seed_rules,
)
from stickslip_schemas.spec.arrays import ArrayLayout, array
from stickslip_schemas.spec.axes import SHORTHAND, TAGGED, LinspaceAxis, ListAxis, RandomAxis, SobolAxis, quantity
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS

BONES, SKIN_VERTICES, SKIN_TRIANGLES = 5, 1442, 2880
"""Of the figure, as the simulation core makes it; a contract test compares the numbers."""

Swing = Annotated[
    float,
    quantity("Swing"),
    Field(strict=True, ge=0, le=2, description="size of the figure's motion; 1 is usual, 0 stands still"),
]
SwingAxis = Annotated[ListAxis[Swing] | LinspaceAxis[Swing] | RandomAxis[Swing] | SobolAxis[Swing], TAGGED, SHORTHAND]


class ShawlAxes(ClothAxes):
    """What a clip of a shawl depends on."""

    mu: MuAxis = Field(description="friction coefficient of the shawl with figure and floor")
    self_friction: MuAxis = Field(description="friction coefficient of the shawl with itself")
    swing: SwingAxis | None = Field(default=None, description="size of the figure's motion; by default 1")
    texture: TextureAxis
    viewpoint: ThreeViewpointAxis


_PHYSICAL_AXES = (*PHYSICAL_AXES, "self_friction", "swing")


class ShawlSimulation(ClothSimulation):
    """The trajectory of a shawl: all that it depends on besides the build."""

    kind: Literal["shawl"] = "shawl"
    self_friction: float
    swing: float = 1.0


class ShawlRender(ClothRender):
    """How a shawl is seen."""

    kind: Literal["shawl"] = "shawl"


class ShawlSpec(ClothSpec):
    """A shawl over the shoulders of a figure that moves [thesis, 4.6]."""

    simulation_type = ShawlSimulation
    render_type = ShawlRender
    simulation_seeds, render_seeds = seed_rules(_PHYSICAL_AXES, "viewpoint")
    instants = 150
    instants_per_second = 15.0
    rig = "shawl-3"
    custom = CUSTOM_LOOKS | {"viewpoint": Custom("viewpoints", "camera", tuple(ThreeViewpoint))}

    kind: Literal["shawl"]
    axes: ShawlAxes
    mesh: Int = Field(
        default=61,
        ge=9,
        le=161,
        description="vertices along a side of the mesh; 31 or more show folds",
    )

    @property
    def certified_protocols(self) -> tuple[str, ...]:
        """Return the protocols of contact."""
        return CONTACT_PROTOCOLS

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of shawls."""
        swing = array("swing", "size of the figure's motion; 1 is usual")
        return (
            *clip_arrays(self),
            *physical_arrays(self),
            array("self_friction", "friction coefficient of the shawl with itself"),
            *((swing,) if "swing" in self.named_axes else ()),
            array(
                "bias",
                "what broke the symmetry: horizontal (x, y) over vertical gravity until the figure moves",
                of={"xy": 2},
            ),
            array(
                "least_distance",
                "of two pieces of cloth that do not hang together, and of cloth and figure, at the ends of all steps "
                "of the solver [m]",
            ),
            *solver_arrays(self),
            *forces(self, contact_force="force of figure and floor on the cloth"),
            *mesh_arrays(self),
            *self._figure_arrays(),
        )

    def _figure_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the figure and its motion: a vertex x of the skin is at sum over bones of weight (A x + b)."""
        if not self.store_positions:
            return ()
        bones, vertices, triangles = {"bone": BONES}, {"skin_vertex": SKIN_VERTICES}, {"skin_triangle": SKIN_TRIANGLES}
        weights = "how much each vertex of the skin follows each bone; they add up to 1"
        motions = "motions (A | b) of the figure's bones: hips, chest, head, left and right arm [m]"
        return (
            over_time(self, "bones", motions, of=bones | {"row": 3, "column": 4}),
            array("skin_rest", "the figure's skin at rest [m]", "float32", vertices | {"xyz": 3}, is_recorded=True),
            array("skin_weights", weights, "float32", vertices | bones, is_recorded=True),
            array(
                "skin_triangles",
                "vertices of the skin's triangles",
                "int32",
                triangles | {"corner": 3},
                is_recorded=True,
            ),
        )
