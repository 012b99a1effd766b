"""Rods that hang from a clamp under their own weight, seen by four cameras."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from stickslip_schemas.base import Document, Float, Sha256, Stage
from stickslip_schemas.spec.arrays import ArrayLayout, array
from stickslip_schemas.spec.axes import (
    SHORTHAND,
    TAGGED,
    LinspaceAxis,
    ListAxis,
    RandomAxis,
    Seed,
    SobolAxis,
    quantity,
)
from stickslip_schemas.spec.cameras import Camera, rig_cameras, rig_digest
from stickslip_schemas.spec.jobs import Costs, JobSpec, Quality, Render, SeedRule, Simulation
from stickslip_schemas.spec.resolution import (
    DEFAULT_RESOLUTION,
    Resolution,
    is_default,
    resolution_field,
)

ROD_PRESET = "rods"
"""Stands for the rod solver, which has no presets to choose from."""

# Quantities have no unit: lengths are over L, and moments over EI/L.
Gamma = Annotated[
    float,
    quantity("Gamma"),
    Field(strict=True, ge=0, le=1e5, description="weight over bending stiffness"),
]
Phi = Annotated[
    float,
    quantity("Phi"),
    Field(strict=True, ge=-40, le=40, description="an angle over the length of the rod [rad]"),
]

GammaAxis = Annotated[
    ListAxis[Gamma] | LinspaceAxis[Gamma] | RandomAxis[Gamma] | SobolAxis[Gamma], TAGGED, SHORTHAND
]
PhiAxis = Annotated[
    ListAxis[Phi] | LinspaceAxis[Phi] | RandomAxis[Phi] | SobolAxis[Phi], TAGGED, SHORTHAND
]


class RodHangAxes(Document):
    """Non-dimensional parameters of a suspended rod [Bertails-Descoubes et al. 2018]."""

    gamma: GammaAxis = Field(description="weight over bending stiffness, rho A g L^3 / EI")
    phi0: PhiAxis = Field(description="natural twist times L [rad]")
    phi1: PhiAxis = Field(description="natural curvature times L [rad]")


class RodHangSimulation(Simulation):
    """A rod at rest: all that its shape depends on besides the build."""

    kind: Literal["rod_hang"] = "rod_hang"
    gamma: float
    phi0: float
    phi1: float
    poisson: float
    elements: int = 128
    points: int = 150


class RodHangRender(Render):
    """How a rod is seen: all that its views depend on besides its shape and the build."""

    kind: Literal["rod_hang"] = "rod_hang"
    rig: str
    rig_digest: Sha256
    color_seed: Seed
    radius: float = Field(default=0.008, gt=0, lt=0.1, description="radius over length")


class RodHangSpec(JobSpec):
    """Rods that hang from a clamp under their own weight, seen by four cameras."""

    subject = "rods"
    simulation_type = RodHangSimulation
    render_type = RodHangRender
    # Each rod has a colour of its own, so the axes of all enter the seed.
    render_seeds = (SeedRule("color_seed", "color", None),)

    kind: Literal["rod_hang"]
    axes: RodHangAxes
    poisson: Float = Field(
        default=0.5, gt=-1, le=0.5, description="Poisson's ratio nu; GJ/EI = 1/(1 + nu)"
    )
    views: Literal["rod-4"] | None = Field(
        default="rod-4", description="camera rig; null renders nothing"
    )
    resolution: Resolution = resolution_field(
        "width and height of the pictures [px], 64 to 1,920 each; the cameras of the rig show the "
        "whole rod in all of them",
        json_schema_extra={
            "x-cost": "CPU time of a view grows with the square of the shorter side"
        },
    )
    quality: Quality = Field(
        default=Quality.standard,
        description="quality of the pictures",
        json_schema_extra={
            "x-cost": "CPU time of a view: preview 19 ms, draft 31 ms, standard 66 ms, high 240 ms"
        },
    )

    @property
    def certified_preset(self) -> str:
        return ROD_PRESET

    @property
    def needs_certificate(self) -> bool:
        """False: every shape is checked against its own equations.

        So rods need no certificate.
        """
        return False

    def simulation_settings(self) -> dict[str, Any]:
        return {"poisson": self.poisson}

    def render_settings(self) -> dict[str, Any] | None:
        # Shapes alone are a dataset, too.
        if self.views is None:
            return None
        return {
            "rig": self.views,
            "rig_digest": rig_digest(self.views),
            "quality": self.quality,
            "resolution": self.resolution,
        }

    @property
    def default_costs(self) -> Costs:
        """CPU times of the packaged records."""
        # CPU time of a view by quality [s], fitted to `benchmarks/job_costs.py`; there are four.
        view = {"preview": 0.022, "draft": 0.028, "standard": 0.066, "high": 0.24}[self.quality]
        # The rod, and so its window, grows with the shorter side.
        view *= (min(self.resolution) / min(DEFAULT_RESOLUTION)) ** 2
        return Costs(simulate=0.0004, render=4 * view, pack=0.0003, renderer_start=0.3)

    def cost_group(self, stage: Stage, point: Mapping[str, Any]) -> str:
        group = super().cost_group(stage, point)
        if stage is not Stage.render or is_default(self.resolution):
            return group
        width, height = self.resolution
        return f"{group}, {width} x {height}"

    def cameras(self) -> tuple[Camera, ...]:
        return () if self.views is None else rig_cameras(self.views, self.resolution)

    def arrays(self) -> tuple[ArrayLayout, ...]:
        # Curves are sampled at as many points as the simulation document says.
        points = {"point": RodHangSimulation.model_fields["points"].default}
        curves = (
            ("centerline", {"xyz": 3}, "positions over L at uniform arc length, clamp first"),
            ("curvature", {"strain": 3}, "(twist, bend1, bend2) times L"),
            ("frame", {"xyz": 3, "director": 3}, "columns d1 (tangent), d2, d3"),
        )
        # One picture for each camera of the rig.
        width, height = self.resolution
        pixels = {"view": len(self.cameras()), "y": height, "x": width, "rgb": 3}
        pictures = (
            array("views", "sRGB pictures", "uint8", pixels, per_sample=True),
            array("color", "colour of the rod, linear RGB, 0 to 1", "float32", {"rgb": 3}),
        )
        distance = (
            "least distance over L at which the centreline passes another part of itself; infinite "
            "where it does not"
        )
        return (
            *(
                array(name, text, "float32", points | of, is_recorded=True)
                for name, of, text in curves
            ),
            *(() if self.views is None else pictures),
            array("gamma", "weight over bending stiffness [Eq. 5.2a of the thesis]"),
            array("phi0", "natural twist times L [rad]"),
            array("phi1", "natural curvature times L [rad]"),
            array("energy", "elastic and gravity energy over EI/L"),
            array(
                "multistable",
                "another stable shape of the same rod was found",
                "bool",
                is_recorded=True,
            ),
            array("self_contact_distance", distance, is_recorded=True),
            array(
                "reach", "largest distance over L from the vertical of the clamp", is_recorded=True
            ),
        )
