"""A square of cloth that falls on a sphere, which then turns and drags it over the floor [thesis, 4.6]."""

from typing import Annotated, Literal

from pydantic import Field

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

AngularSpeed = Annotated[
    float,
    quantity("AngularSpeed"),
    Field(strict=True, ge=-20, le=20, description="angular speed of the sphere about its vertical axis [rad/s]"),
]
AngularSpeedAxis = Annotated[
    ListAxis[AngularSpeed] | LinspaceAxis[AngularSpeed] | RandomAxis[AngularSpeed] | SobolAxis[AngularSpeed],
    TAGGED,
    SHORTHAND,
]


class ClothSphereAxes(ClothAxes):
    """What a clip of cloth on a turning sphere depends on."""

    mu: MuAxis = Field(description="friction coefficient of the cloth with sphere and floor")
    angular_speed: AngularSpeedAxis = Field(description="angular speed of the sphere about its vertical axis [rad/s]")
    texture: TextureAxis
    viewpoint: ThreeViewpointAxis


class ClothSphereSimulation(ClothSimulation):
    """The trajectory of a cloth on a turning sphere: all that it depends on besides the build."""

    kind: Literal["cloth_sphere"] = "cloth_sphere"
    angular_speed: float


class ClothSphereRender(ClothRender):
    """How a cloth on a turning sphere is seen."""

    kind: Literal["cloth_sphere"] = "cloth_sphere"


class ClothSphereSpec(ClothSpec):
    """A square of cloth that falls on a sphere, which then turns and drags it over the floor [thesis, 4.6]."""

    simulation_type = ClothSphereSimulation
    render_type = ClothSphereRender
    simulation_seeds, render_seeds = seed_rules((*PHYSICAL_AXES, "angular_speed"), "viewpoint")
    instants = 150
    instants_per_second = 15.0
    rig = "sphere-3"
    custom = CUSTOM_LOOKS | {"viewpoint": Custom("viewpoints", "camera", tuple(ThreeViewpoint))}

    kind: Literal["cloth_sphere"]
    axes: ClothSphereAxes

    def arrays(self) -> tuple[ArrayLayout, ...]:
        """Return the arrays of a dataset of cloth on a turning sphere."""
        bias = "what broke the symmetry: horizontal (x, y) over vertical gravity until the sphere turns"
        return (
            *clip_arrays(self),
            *physical_arrays(self),
            array("angular_speed", "of the sphere about its vertical axis [rad/s]"),
            array("bias", bias, of={"xy": 2}),
            *solver_arrays(self),
            over_time(self, "angle", "by which the sphere has turned [rad]"),
            *forces(
                self,
                contact_force="force of floor and sphere on the cloth",
                floor_force="force of the floor on the cloth",
                sphere_force="force of the sphere on the cloth",
            ),
            *mesh_arrays(self),
        )
