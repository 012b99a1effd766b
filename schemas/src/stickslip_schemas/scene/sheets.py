"""Sheets of cloth: their flat shape, how they start, and who holds them."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stickslip_schemas.base.document import Bool, Document, Float, Int
from stickslip_schemas.scene.motion import BY_NAME, FileName, Length, Motion, Place, Time, Turn, Vector
from stickslip_schemas.spec.fabrics import CustomName

Cells = Annotated[Int, Field(ge=1, le=1000)]
Factor = Annotated[Float, Field(ge=0.1, le=10)]
Vertex = Annotated[Int, Field(ge=0)]


class Grid(Document):
    """A rectangle, cut into cells, each of two triangles."""

    type: Literal["grid"] = "grid"
    size: tuple[Length, Length] = Field(description="sides along the warp and across [m]")
    cells: tuple[Cells, Cells] = Field(description="cells along both")

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of vertices and triangles."""
        return (self.cells[0] + 1) * (self.cells[1] + 1), 2 * self.cells[0] * self.cells[1]


class Unstructured(Document):
    """A rectangle of scattered vertices."""

    type: Literal["unstructured"] = "unstructured"
    size: tuple[Length, Length] = Field(description="sides along the warp and across [m]")
    spacing: Length = Field(description="about the length of an edge [m]")
    seed: Int = Field(default=0, ge=0, lt=2**31)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of vertices and triangles: of rows of a triangular lattice, every second one shifted."""
        columns = max(1, round(self.size[0] / self.spacing))
        rows = max(1, round(self.size[1] / (self.spacing * 0.75**0.5)))
        shifted = rows // 2  # rows 1, 3, ... but the last
        vertices = (rows + 1) * (columns + 1) + shifted
        hull = 2 * columns + 2 * rows  # every row begins and ends on the outline
        return vertices, 2 * vertices - 2 - hull


class FileMesh(Document):
    """Any flat shape, from an OBJ file whose texture coordinates are the flat pattern."""

    type: Literal["file"]
    file: FileName = Field(description="an OBJ file of triangles; its texture coordinates are the flat pattern [m]")
    counts: tuple[Int, Int] | None = Field(
        default=None, description="numbers of vertices and triangles; filled in when the file is uploaded"
    )

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of vertices and triangles; 0 before the file is read."""
        return self.counts or (0, 0)


class Flat(Document):
    """It starts flat."""

    type: Literal["flat"]


class Hung(Document):
    """It starts at rest under its holders, for which it is let down from flat before the scene begins."""

    type: Literal["hung"]
    bias_until: Time = Field(default=0.0, description="until when the seeded push along its normal lasts [s]")


class Stretched(Document):
    """It starts flat and strained."""

    type: Literal["stretched"]
    strain: tuple[Annotated[Float, Field(ge=-0.2, le=0.2)], Annotated[Float, Field(ge=-0.2, le=0.2)]] = Field(
        description="along the warp and across; not equal, or the stiffness has no direction"
    )


class FromFile(Document):
    """It starts where a file says."""

    type: Literal["file"]
    file: FileName | None = Field(
        default=None, description="an OBJ file, or an NPZ file with `positions` (V, 3) [m]; null: the file of the mesh"
    )


class Holder(Document):
    """What holds vertices of a sheet: those in a rectangle of the flat sheet, on an edge, on its rim, or listed."""

    low: tuple[Place, Place] | None = Field(
        default=None, description="corner of the rectangle (along the warp, across), from the middle [m]"
    )
    high: tuple[Place, Place] | None = Field(default=None, description="opposite corner [m]")
    edge: Literal["left", "right", "bottom", "top"] | None = Field(
        default=None, description="left and right are the least and the largest along the warp, bottom and top across"
    )
    rim: Literal[True] | None = Field(default=None, description="all of the outline")
    vertices: tuple[Vertex, ...] | None = Field(default=None, min_length=1, max_length=100_000)
    motion: Motion | None = Field(default=None, description="of the holder; null: it stays")
    grasp: tuple[Time, Time] | None = Field(
        default=None, description="when it takes hold and when it lets go [s]; null: it always holds"
    )

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        given = [name for name in ("edge", "rim", "vertices") if getattr(self, name) is not None]
        if self.low is not None or self.high is not None:
            given.append("low and high")
        if len(given) != 1:
            raise ValueError(
                "a holder must have one of low and high, edge, rim and vertices, and it has "
                f"{', '.join(given) or 'none'}"
            )
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high must both be given")
        if any(low > high for low, high in zip(self.low or (), self.high or (), strict=True)):
            raise ValueError(
                f"low must be at most high in both [m], and they are {list(self.low or ())} and {list(self.high or ())}"
            )
        if self.grasp is not None and not self.grasp[0] < self.grasp[1]:
            raise ValueError(f"grasp must be [from, until] in ascending order [s], and it is {list(self.grasp)}")
        return self


class Factors(Document):
    """Factors of the numbers of a sheet's fabric."""

    density: Factor = Field(default=1.0, description="of the mass per area")
    bending: Factor = Field(default=1.0, description="of the rigidity against bending")
    stretching: Factor = Field(default=1.0, description="of the stiffness in its plane")


class Sheet(Document):
    """A piece of cloth."""

    material: CustomName = Field(description="a measured fabric, or a custom one under `materials`")
    factors: Factors = Factors()
    mesh: Annotated[Grid | Unstructured | FileMesh, Field(discriminator="type")]
    origin: Vector = Field(default=(0.0, 0.0, 0.0), description="where its middle starts [m]")
    turn: Turn = Field(
        default=(0.0, 0.0, 0.0),
        description="how it lies, as a rotation vector [rad]; without it the warp is along x and the weft along y",
    )
    thickness: Float = Field(default=5e-4, ge=1e-5, le=0.05, description="[m]")
    self_contact: Bool = Field(default=True, description="false: it passes through itself")
    start: Annotated[Flat | Hung | Stretched | FromFile, Field(discriminator="type")] = Flat(type="flat")
    holders: Annotated[dict[CustomName, Holder], BY_NAME] = Field(default_factory=dict, max_length=64)

    @model_validator(mode="after")
    def _can_start(self) -> Self:
        if isinstance(self.start, FromFile) and self.start.file is None and not isinstance(self.mesh, FileMesh):
            raise ValueError("start.file must name a file where the mesh is not one")
        if isinstance(self.start, Hung) and not self.holders:
            raise ValueError("start can be hung only from holders, and there are none")
        return self
