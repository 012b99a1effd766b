"""Bodies that cloth touches."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stickslip_schemas.base.document import Document, Float
from stickslip_schemas.scene.motion import FileName, Length, Motion, Turn, Vector


class Plane(Document):
    """The half-space below a plane."""

    type: Literal["plane"]
    origin: Vector = Field(default=(0.0, 0.0, 0.0), description="[m]")
    normal: Vector = (0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not any(self.normal):
            raise ValueError(f"normal must not be 0, and it is {list(self.normal)}")
        return self


class _Placed(Document):
    origin: Vector = Field(description="where its middle starts [m]")
    turn: Turn = Field(default=(0.0, 0.0, 0.0), description="how it stands at the start, as a rotation vector [rad]")
    motion: Motion | None = Field(default=None, description="null: it stays")


class Sphere(_Placed):
    """A ball."""

    type: Literal["sphere"]
    radius: Length = Field(description="[m]")


class Cylinder(_Placed):
    """A cylinder without ends, whose axis is z before it is turned."""

    type: Literal["cylinder"]
    radius: Length = Field(description="[m]")


class Capsule(_Placed):
    """A cylinder with round ends, whose axis is z before it is turned."""

    type: Literal["capsule"]
    radius: Length = Field(description="[m]")
    length: Length = Field(description="between the middles of its ends [m]")


class Box(_Placed):
    """A box."""

    type: Literal["box"]
    size: tuple[Length, Length, Length] = Field(description="of its edges [m]")
    rounding: Float | None = Field(
        default=None, gt=0, le=50, description="radius of its edges [m]; null: 5 mm, or half the least of size"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.rounding is not None and 2 * self.rounding > min(self.size):
            raise ValueError(
                f"rounding must be at most half the least of size, {min(self.size) / 2:g} m, and it is "
                f"{self.rounding:g} m"
            )
        return self


class MeshBody(Document):
    """Triangles that may move, read from a file."""

    type: Literal["mesh"]
    file: FileName = Field(description="an OBJ file, a folder of them, or an NPZ file")
    frame_rate: Float | None = Field(default=None, gt=0, le=10_000, description="of a folder of OBJ files [1/s]")
    thickness: Float = Field(default=5e-4, ge=0, le=0.05, description="of a skin around the triangles [m]")
    strength: Float = Field(default=1.0, ge=0, le=2, description="factor of all displacements since the first frame")
    motion: Motion | None = Field(default=None, description="that all of it makes besides; null: none")


Body = Annotated[Plane | Sphere | Cylinder | Capsule | Box | MeshBody, Field(discriminator="type")]
