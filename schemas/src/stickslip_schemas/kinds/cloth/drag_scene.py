"""The scene of drop-and-drag [thesis, 4.2.3]: its cameras, the rig `drag`, its lamps, and the labels of a drop."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from stickslip_schemas.kinds.cloth.names import CUSTOM_LOOKS, VIEWPOINT, Custom, LightingAxis, definitions
from stickslip_schemas.kinds.cloth.spec import ClothSpec
from stickslip_schemas.spec.appearance import LampNumbers, Lighting
from stickslip_schemas.spec.arrays import array
from stickslip_schemas.spec.axes import SHORTHAND, ListAxis, quantity
from stickslip_schemas.spec.fabrics import CustomName, name_schema


class Viewpoint(StrEnum):
    """Cameras of the rig `drag`; the first is calibrated on the real stage, and the last twelve are held out.

    Their order gives the codes of the label `viewpoint`: add new ones at the end.
    """

    calibrated = "calibrated"
    left = "left"
    right = "right"
    azimuth_minus_15 = "azimuth-minus-15"
    azimuth_minus_10 = "azimuth-minus-10"
    azimuth_minus_5 = "azimuth-minus-5"
    azimuth_plus_5 = "azimuth-plus-5"
    azimuth_plus_10 = "azimuth-plus-10"
    azimuth_plus_15 = "azimuth-plus-15"
    elevation_minus_15 = "elevation-minus-15"
    elevation_minus_10 = "elevation-minus-10"
    elevation_minus_5 = "elevation-minus-5"
    elevation_plus_5 = "elevation-plus-5"
    elevation_plus_10 = "elevation-plus-10"
    elevation_plus_15 = "elevation-plus-15"


TRAINING_VIEWPOINTS = (Viewpoint.calibrated, Viewpoint.left, Viewpoint.right)
HELD_OUT_VIEWPOINTS = tuple(view for view in Viewpoint if view not in TRAINING_VIEWPOINTS)
"""`calibrated` turned about what it looks at, by 5, 10 and 15 degrees to all sides [thesis, 4.5.1]."""

ViewpointAxis = Annotated[
    ListAxis[Annotated[CustomName, quantity("Viewpoint"), name_schema(Viewpoint)]], SHORTHAND, VIEWPOINT
]
LampAxis = Annotated[
    LightingAxis | None, Field(description="range of lamps, or a custom one under `lamps`; by default `drawn`")
]


class DragSceneSpec(ClothSpec):
    """What the kinds of dragged cloth have in common."""

    instants = 300
    instants_per_second = 2.4
    rig = "drag"
    custom = CUSTOM_LOOKS | {
        "viewpoint": Custom("viewpoints", "camera", tuple(Viewpoint)),
        "lighting": Custom("lamps", "lamp", tuple(Lighting)),
    }

    lamps: dict[CustomName, LampNumbers] = definitions("lamps", "lighting")


DROP_LABELS = (
    array("bias_side", "side to which gravity leaned during the drop, +1 or -1 along x", "int8", fill=0),
    array("landed_side", "side of the holders on which the cloth landed, +1 or -1 along x", "int8", fill=0),
    array("bias", "what broke the symmetry: horizontal over vertical gravity during the drop"),
)
