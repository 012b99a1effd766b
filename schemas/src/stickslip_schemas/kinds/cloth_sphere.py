"""A square of cloth that falls on a sphere, which then turns and drags it over the floor [thesis, 4.6]."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

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
from stickslip_schemas.spec.jobs import SeedRule

AngularSpeed = Annotated[
    float,
    quantity("AngularSpeed"),
    Field(strict=True, ge=-20, le=20, description="angular speed of the sphere about its vertical axis [rad/s]"),
]
AngularSpeedAxis = Annotated[
    ListAxis[AngularSpeed] | LinspaceAxis[AngularSpeed] | RandomAxis[AngularSpeed] | SobolAxis[AngularSpeed],
    Field(discriminator="type"),
    SHORTHAND,
]


class SphereViewpoint(StrEnum):
    """Cameras of the rig `sphere-3`.

    Their order gives the codes of the label `viewpoint`: add new ones at the end.
    """

    front = "front"
    side = "side"
    high = "high"


ViewpointName = Annotated[CustomName, quantity("SphereViewpoint"), name_schema(SphereViewpoint)]


class ClothSphereAxes(ClothAxes):
    """What a clip of cloth on a turning sphere depends on."""

    mu: MuAxis = Field(description="friction coefficient of the cloth with sphere and floor")
    angular_speed: AngularSpeedAxis = Field(description="angular speed of the sphere about its vertical axis [rad/s]")
    texture: TextureAxis = Field(
        description="pattern of the cloth, or a custom one under `textures`; the last four are held out for tests"
    )
    viewpoint: Annotated[ListAxis[ViewpointName], SHORTHAND] = Field(
        description="camera of the rig, or a custom one under `viewpoints`"
    )


class ClothSphereSimulation(ClothSimulation):
    """The trajectory of a cloth on a turning sphere: all that it depends on besides the build."""

    kind: Literal["cloth_sphere"] = "cloth_sphere"
    angular_speed: float


class ClothSphereRender(ClothRender):
    """How a cloth on a turning sphere is seen."""

    kind: Literal["cloth_sphere"] = "cloth_sphere"
    angular_speed: float


class ClothSphereSpec(ClothSpec):
    """A square of cloth that falls on a sphere, which then turns and drags it over the floor [thesis, 4.6]."""

    simulation_type = ClothSphereSimulation
    render_type = ClothSphereRender
    simulation_seeds = (SeedRule("seed", "bias", (*PHYSICAL_AXES, "angular_speed")),)
    render_seeds = (
        SeedRule("light_seed", "light", (*PHYSICAL_AXES, "angular_speed", "viewpoint")),
        SeedRule("crease_seed", "creases", (*PHYSICAL_AXES, "angular_speed")),
    )
    instants = 150
    instants_per_second = 15.0
    rig = "sphere-3"
    custom = CUSTOM_LOOKS | {"viewpoint": Custom("viewpoints", "camera", tuple(SphereViewpoint))}

    kind: Literal["cloth_sphere"]
    axes: ClothSphereAxes

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of cloth on a turning sphere."""
        forces = (
            ("contact_force", "force of floor and sphere on the cloth [N]"),
            ("floor_force", "force of the floor on the cloth [N]"),
            ("sphere_force", "force of the sphere on the cloth [N]"),
        )
        bias = "what broke the symmetry: horizontal (x, y) over vertical gravity until the sphere turns"
        return (
            *self.clip_arrays(),
            *self.physical_arrays(),
            ArrayLayout("angular_speed", "float64", (), (), "of the sphere about its vertical axis [rad/s]", fill=NAN),
            ArrayLayout("bias", "float64", (2,), ("xy",), bias, fill=NAN),
            *self.solver_arrays(),
            self.over_time("angle", "float32", (), (), "by which the sphere has turned [rad]", fill=NAN),
            *(self.over_time(name, "float32", (3,), ("xyz",), text, fill=NAN) for name, text in forces),
            *self.mesh_arrays(),
        )
