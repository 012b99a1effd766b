"""The stage of drop-and-drag [thesis, 4.2.3]: its cameras, the rig `drag`, and the labels of a drop."""

from enum import StrEnum
from typing import Annotated

from stickslip_schemas.spec.arrays import NAN, ArrayLayout
from stickslip_schemas.spec.axes import quantity
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


ViewpointName = Annotated[CustomName, quantity("Viewpoint"), name_schema(Viewpoint)]

TRAINING_VIEWPOINTS = (Viewpoint.calibrated, Viewpoint.left, Viewpoint.right)
HELD_OUT_VIEWPOINTS = tuple(view for view in Viewpoint if view not in TRAINING_VIEWPOINTS)
"""`calibrated` turned about what it looks at, by 5, 10 and 15 degrees to all sides [thesis, 4.5.1]."""

DROP_LABELS = (
    ArrayLayout("bias_side", "int8", (), (), "side to which gravity leaned during the drop, +1 or -1 along x"),
    ArrayLayout("landed_side", "int8", (), (), "side of the holders on which the cloth landed, +1 or -1 along x"),
    ArrayLayout(
        "bias",
        "float64",
        (),
        (),
        "what broke the symmetry: horizontal over vertical gravity during the drop",
        fill=NAN,
    ),
)
