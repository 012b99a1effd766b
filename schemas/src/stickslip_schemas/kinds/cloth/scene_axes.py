"""The axes of a clip of a scene, and the name of a built-in scene in its place."""

from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from stickslip_schemas.base import Document
from stickslip_schemas.kinds.cloth.spec import VIEWPOINT, LampAxis, SubstrateAxis, TextureAxis
from stickslip_schemas.scene.parameters import ParameterName, Value
from stickslip_schemas.spec.axes import (
    SHORTHAND,
    TAGGED,
    LinspaceAxis,
    ListAxis,
    RandomAxis,
    SobolAxis,
    quantity,
)
from stickslip_schemas.spec.names import CustomName

Number = Annotated[float, quantity("Number"), Field(strict=True)]
Choice = Annotated[Value, quantity("Value")]
ParameterAxis = Annotated[
    ListAxis[Choice] | LinspaceAxis[Number] | RandomAxis[Number] | SobolAxis[Number],
    TAGGED,
    SHORTHAND,
]


class BuiltIn(BeforeValidator):
    """Accepts the name of a built-in scene, in validation and in the JSON schema."""

    def __get_pydantic_json_schema__(
        self, core: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        document = handler(core)
        # A scene is always written out whole.
        if handler.mode == "serialization":
            return document
        name = {"type": "string", "description": "the name of a built-in scene"}
        return {"anyOf": [name, document]}


class ClothSceneAxes(Document):
    """Axes of a clip of a scene: any parameter of the scene, by its name, and looks."""

    # The names of parameters are known only with the scene, so they are extra fields here.
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[ParameterName, ParameterAxis]

    texture: TextureAxis
    viewpoint: Annotated[ListAxis[Annotated[CustomName, quantity("Camera")]], SHORTHAND, VIEWPOINT]
    lighting: LampAxis = None
    substrate: SubstrateAxis | None = Field(
        default=None,
        description=(
            "finish of the floor, or a custom one under `substrates`; by default the scene's"
        ),
    )
