"""What of a scene is seen, and how: nothing here enters the key of a simulation."""

import math
from operator import mul
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from stickslip_schemas.base import Document, Float
from stickslip_schemas.scene.parts import BY_NAME, FileName, Vector
from stickslip_schemas.spec.appearance import (
    CLIP_SIZE,
    FARTHEST,
    LOWEST,
    FloorNumbers,
    LampNumbers,
    Lighting,
    Share,
    Substrate,
)
from stickslip_schemas.spec.cameras import Camera, rig_names
from stickslip_schemas.spec.fabrics import CustomName, did_you_mean

FILM = 36.0
"""Width of the film that focal lengths refer to [mm]."""


class View(Document):
    """A camera, by where it is and where it looks."""

    position: Vector = Field(description="[m]")
    target: Vector = Field(description="the point in the middle of the picture [m]")
    focal_length: Float = Field(default=50.0, ge=10, le=400, description="for a film 36 mm wide [mm]")

    @model_validator(mode="after")
    def _sees(self) -> Self:
        x, y, z = self.position
        if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and LOWEST <= z <= FARTHEST):
            raise ValueError(
                f"position must be within {FARTHEST:g} m of the middle and {LOWEST:g} m or more above the floor, and "
                f"it is {list(self.position)} m"
            )
        if math.hypot(*self._forward[:2]) < 1e-6:
            raise ValueError(f"target must not be straight above or below position, and it is {list(self.target)} m")
        return self

    @property
    def _forward(self) -> tuple[float, float, float]:
        x, y, z = (b - a for a, b in zip(self.position, self.target, strict=True))
        return x, y, z

    def camera(self, name: str) -> Camera:
        """Return the calibrated camera: upright, with the principal point in the middle."""
        x, y, z = (value / math.hypot(*self._forward) for value in self._forward)
        level = math.hypot(x, y)
        rotation = ((y / level, -x / level, 0.0), (x * z / level, y * z / level, -level), (x, y, z))
        a, b, c = (0.0 - sum(map(mul, row, self.position)) for row in rotation)
        focal, middle = self.focal_length / FILM * CLIP_SIZE, (CLIP_SIZE - 1) / 2
        return Camera(
            name=name,
            width=CLIP_SIZE,
            height=CLIP_SIZE,
            fx=focal,
            fy=focal,
            cx=middle,
            cy=middle,
            rotation=rotation,
            translation=(a, b, c),
        )


class SheetLook(Document):
    """What a sheet looks like where no axis says it."""

    texture: FileName = Field(description="a built-in texture, or a square PNG or JPEG file")


class BodyLook(Document):
    """What a body looks like."""

    color: tuple[Share, Share, Share] = Field(default=(0.2, 0.2, 0.2), description="linear red, green, blue, 0 to 1")
    roughness: Share = Field(default=0.5, description="0 is a mirror")


class Looks(Document):
    """The looks of a scene: textures, colours, cameras, light and floor."""

    sheets: Annotated[dict[CustomName, SheetLook], BY_NAME] = Field(
        default_factory=dict,
        description="textures of their own; the first sheet (by name) without one takes the axis `texture`",
    )
    bodies: Annotated[dict[CustomName, BodyLook], BY_NAME] = Field(default_factory=dict)
    cameras: str | Annotated[dict[CustomName, View], BY_NAME, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description="a rig by name, or cameras; null: front, side and high frame all that moves"
    )
    light: Lighting | LampNumbers = Field(default=Lighting.drawn, description="of the axis `lighting` by default")
    floor: Substrate | FloorNumbers = Field(default=Substrate.matt, description="of the axis `substrate` by default")

    @field_validator("cameras")
    @classmethod
    def _known_rig(cls, cameras: "str | dict[str, View] | None") -> "str | dict[str, View] | None":
        if isinstance(cameras, str) and cameras not in rig_names():
            raise ValueError(
                f"cameras must be one of {', '.join(rig_names())}, or cameras by name"
                f"{did_you_mean(cameras, rig_names())}"
            )
        return cameras
