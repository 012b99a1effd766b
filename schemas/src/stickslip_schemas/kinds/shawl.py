"""A shawl over the shoulders of a figure that moves [thesis, 4.6]."""

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import Field

from stickslip_schemas.base.document import Int
from stickslip_schemas.kinds.cloth.spec import (
    CUSTOM_LOOKS,
    PHYSICAL_AXES,
    ClothAxes,
    ClothRender,
    ClothSimulation,
    ClothSpec,
    Custom,
    MuAxis,
    TextureAxis,
)
from stickslip_schemas.spec.arrays import NAN, ArrayLayout
from stickslip_schemas.spec.axes import SHORTHAND, LinspaceAxis, ListAxis, RandomAxis, SobolAxis, quantity
from stickslip_schemas.spec.fabrics import CustomName, name_schema
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS, SeedRule

BONES, SKIN_VERTICES, SKIN_TRIANGLES = 5, 1442, 2880
"""Of the figure, as the simulation core makes it; a contract test compares the numbers."""

Swing = Annotated[
    float,
    quantity("Swing"),
    Field(strict=True, ge=0, le=2, description="size of the figure's motion; 1 is usual, 0 stands still"),
]
SwingAxis = Annotated[
    ListAxis[Swing] | LinspaceAxis[Swing] | RandomAxis[Swing] | SobolAxis[Swing],
    Field(discriminator="type"),
    SHORTHAND,
]


class ShawlViewpoint(StrEnum):
    """Cameras of the rig `shawl-3`.

    Their order gives the codes of the label `viewpoint`: add new ones at the end.
    """

    front = "front"
    side = "side"
    high = "high"


ViewpointName = Annotated[CustomName, quantity("ShawlViewpoint"), name_schema(ShawlViewpoint)]


class ShawlAxes(ClothAxes):
    """What a clip of a shawl depends on."""

    mu: MuAxis = Field(description="friction coefficient of the shawl with figure and floor")
    self_friction: MuAxis = Field(description="friction coefficient of the shawl with itself")
    swing: SwingAxis | None = Field(default=None, description="size of the figure's motion; by default 1")
    texture: TextureAxis = Field(
        description="pattern of the cloth, or a custom one under `textures`; the last four are held out for tests"
    )
    viewpoint: Annotated[ListAxis[ViewpointName], SHORTHAND] = Field(
        description="camera of the rig, or a custom one under `viewpoints`"
    )


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
    simulation_seeds = (SeedRule("seed", "bias", _PHYSICAL_AXES),)
    render_seeds = (
        SeedRule("light_seed", "light", (*_PHYSICAL_AXES, "viewpoint")),
        SeedRule("crease_seed", "creases", _PHYSICAL_AXES),
    )
    instants = 150
    instants_per_second = 15.0
    rig = "shawl-3"
    custom = CUSTOM_LOOKS | {"viewpoint": Custom("viewpoints", "camera", tuple(ShawlViewpoint))}

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
        """Those of contact."""
        return CONTACT_PROTOCOLS

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of shawls."""
        swing = ArrayLayout("swing", "float64", (), (), "size of the figure's motion; 1 is usual", fill=NAN)
        return (
            *self.clip_arrays(),
            *self.physical_arrays(),
            ArrayLayout("self_friction", "float64", (), (), "friction coefficient of the shawl with itself", fill=NAN),
            *((swing,) if "swing" in self.named_axes else ()),
            ArrayLayout(
                "bias",
                "float64",
                (2,),
                ("xy",),
                "what broke the symmetry: horizontal (x, y) over vertical gravity until the figure moves",
                fill=NAN,
            ),
            ArrayLayout(
                "least_distance",
                "float64",
                (),
                (),
                "of two pieces of cloth that do not hang together, and of cloth and figure, at the ends of all steps "
                "of the solver [m]",
                fill=NAN,
            ),
            *self.solver_arrays(),
            self.over_time(
                "contact_force", "float32", (3,), ("xyz",), "force of figure and floor on the cloth [N]", fill=NAN
            ),
            *self.mesh_arrays(),
            *self._figure_arrays(),
        )

    def _figure_arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the figure and its motion: a vertex x of the skin is at sum over bones of weight (A x + b)."""
        if not self.store_positions:
            return ()

        def recorded(name: str, dtype: str, shape: tuple[int, int], of: tuple[str, str], text: str, **more: Any) -> Any:
            return ArrayLayout(name, dtype, shape, of, text, is_recorded=True, **more)

        skin = ("skin_vertex", "xyz")
        return (
            self.over_time(
                "bones",
                "float32",
                (BONES, 3, 4),
                ("bone", "row", "column"),
                "motions (A | b) of the figure's bones: hips, chest, head, left and right arm [m]",
                fill=NAN,
            ),
            recorded("skin_rest", "float32", (SKIN_VERTICES, 3), skin, "the figure's skin at rest [m]", fill=NAN),
            recorded(
                "skin_weights",
                "float32",
                (SKIN_VERTICES, BONES),
                ("skin_vertex", "bone"),
                "how much each vertex of the skin follows each bone; they add up to 1",
                fill=NAN,
            ),
            recorded(
                "skin_triangles",
                "int32",
                (SKIN_TRIANGLES, 3),
                ("skin_triangle", "corner"),
                "vertices of the skin's triangles",
                fill=-1,
            ),
        )
