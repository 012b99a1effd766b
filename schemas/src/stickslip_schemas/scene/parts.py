"""Parts of a scene: motions, bodies that cloth touches, sheets of cloth, and their looks."""

import math
from itertools import pairwise
from operator import mul
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from stickslip_schemas.base import ARTIFACT, Bool, Document, Float, Int, is_sha256
from stickslip_schemas.spec.cameras import Camera, central, rig_names
from stickslip_schemas.spec.names import (
    FARTHEST,
    LOWEST,
    CustomName,
    FloorNumbers,
    LampNumbers,
    Lighting,
    Share,
    Substrate,
    did_you_mean,
)
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION, Resolution

SMALLEST = 1e-3
"""Least extent of a sheet or of a mesh [m]: anything smaller is taken for another unit."""
LARGEST = 10.0
"""Largest extent of a sheet or of a mesh [m]."""


def unit_hint(extent: float) -> str:
    """Return a question for the unit of a length [m] that is out of range."""
    # Programs of engineers write millimetres. A length that is too small may have been converted
    # twice, or be in kilometres.
    if extent > LARGEST:
        return f"; did you mean mm? Lengths are in metres, and {extent:g} mm are {extent / 1000:g}"
    return f"; did you mean {extent * 1000:g} m? Lengths are in metres, not in mm or km"


Length = Annotated[Float, Field(gt=0, le=100)]

THINNEST = 1e-4
"""Least radius or side of a body [m]: thinner than any needle is taken for another unit."""


def _of_a_body(value: Any) -> Any:
    """Return the radius or side of a body [m]; raise ValueError if it is one of another unit."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if is_number and value > 0 and not THINNEST <= value <= LARGEST:
        raise ValueError(f"must be {THINNEST:g} to {LARGEST:g} m{unit_hint(value)}")
    return value


BodyLength = Annotated[Float, Field(ge=THINNEST, le=LARGEST), BeforeValidator(_of_a_body)]
"""A radius or side of a body [m]."""

Place = Annotated[Float, Field(ge=-100, le=100)]
Vector = tuple[Place, Place, Place]
Angle = Annotated[Float, Field(ge=-6.2832, le=6.2832, description="at most a full turn [rad]")]
Turn = tuple[Angle, Angle, Angle]
Time = Annotated[Float, Field(ge=0, le=10_000)]


def _below_the_scene(name: str) -> str:
    """Return the name of a file if it may stand in a scene; raise ValueError.

    It is a reference to an artifact, or a path within the folder of the scene.
    """
    if name.startswith(ARTIFACT):
        if not is_sha256(name.removeprefix(ARTIFACT)):
            raise ValueError("a reference to a file must be sha256: and 64 hexadecimal digits")
        return name
    # The document may come from somebody else: no file outside of its folder is read.
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise ValueError(
            "a file must be in the folder of the scene or below, with / between folders"
        )
    return name


FileName = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_below_the_scene)]
"""A file of a scene: a path relative to the scene's folder, or `sha256:` and a digest once it is
uploaded.
"""


def _by_name(value: Any) -> Any:
    """Return a mapping in the order of its names: canonical JSON has no other order."""
    return (
        dict(sorted(value.items()))
        if isinstance(value, dict) and all(isinstance(key, str) for key in value)
        else value
    )


BY_NAME = BeforeValidator(_by_name)
"""Puts a mapping into the order of its names."""


class Key(Document):
    """The position of something at an instant, since the start."""

    time: Time = Field(description="[s]")
    move: Vector = Field(default=(0.0, 0.0, 0.0), description="displacement since the start [m]")
    turn: Turn = Field(
        default=(0.0, 0.0, 0.0), description="rotation since the start, as a rotation vector [rad]"
    )


class Spin(Document):
    """A rotation about an axis that begins at a time, gains its speed evenly, and then keeps it."""

    axis: Vector = (0.0, 0.0, 1.0)
    speed: Annotated[Float, Field(ge=-1000, le=1000)] = Field(description="[rad/s]")
    begin: Time = Field(default=0.0, description="when it begins [s]")
    ramp: Time = Field(default=0.0, description="time in which it gains its speed [s]")

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not any(self.axis):
            raise ValueError(f"axis must not be 0, and it is {list(self.axis)}")
        return self


class Motion(Document):
    """A rigid motion: through keyframes, a spin, or a path from a file."""

    keys: tuple[Key, ...] | None = Field(default=None, min_length=1, max_length=1000)
    spin: Spin | None = None
    path: FileName | None = Field(
        default=None,
        description="a CSV file with the columns time, x, y, z, rx, ry, rz, or an NPZ file with "
        "time (K), move (K, 3) "
        "and turn (K, 3): [s], [m], [rad], since the start",
    )
    interpolation: Literal["smooth", "linear"] = Field(
        default="smooth",
        description=(
            "smooth: without overshoot, at rest at the first and the last key; linear: at "
            "even speed between"
        ),
    )
    ramp: Time = Field(
        default=0.0, description="time in which a linear motion changes its speed at each key [s]"
    )
    about: Vector | None = Field(
        default=None,
        description=(
            "point that turns are about [m]; by default the middle of what moves, at the start"
        ),
    )

    @model_validator(mode="after")
    def _is_one_motion(self) -> Self:
        # Three ways to describe a motion; two of them would contradict each other.
        choices = [name for name in ("keys", "spin", "path") if getattr(self, name) is not None]
        if len(choices) != 1:
            raise ValueError(
                "a motion must have one of keys, spin and path, and it has "
                f"{', '.join(choices) or 'none'}"
            )
        # A smooth motion is at rest at its ends, and a spin has a ramp of its own.
        if self.ramp and (self.spin is not None or self.interpolation == "smooth"):
            raise ValueError(
                "ramp is of linear keys and paths, and this motion is not linear; ramp is "
                f"{self.ramp:g} s"
            )
        # Interpolation needs a first and a last key.
        for before, after in pairwise(self.keys or ()):
            if not before.time < after.time:
                raise ValueError(
                    f"keys must ascend in time, and {after.time:g} s comes after {before.time:g} s"
                )
        return self


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
    turn: Turn = Field(
        default=(0.0, 0.0, 0.0),
        description="how it stands at the start, as a rotation vector [rad]",
    )
    motion: Motion | None = Field(default=None, description="null: it stays")


class Sphere(_Placed):
    """A ball."""

    type: Literal["sphere"]
    radius: BodyLength = Field(description="[m]")


class Cylinder(_Placed):
    """A cylinder without ends, whose axis is z before it is turned."""

    type: Literal["cylinder"]
    radius: BodyLength = Field(description="[m]")


class Capsule(_Placed):
    """A cylinder with round ends, whose axis is z before it is turned."""

    type: Literal["capsule"]
    radius: BodyLength = Field(description="[m]")
    length: Length = Field(description="between the middles of its ends [m]")


class Box(_Placed):
    """A box."""

    type: Literal["box"]
    size: tuple[BodyLength, BodyLength, BodyLength] = Field(description="of its edges [m]")
    rounding: Float | None = Field(
        default=None,
        gt=0,
        le=50,
        description="radius of its edges [m]; null: 5 mm or 0.9 cells of the coarsest sheet, at "
        "most half the least of size",
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.rounding is not None and 2 * self.rounding > min(self.size):
            raise ValueError(
                f"rounding must be at most half the least of size, {min(self.size) / 2:g} m, and "
                "it is "
                f"{self.rounding:g} m"
            )
        return self


class MeshBody(Document):
    """Triangles that may move, read from a file."""

    type: Literal["mesh"]
    file: FileName = Field(description="an OBJ file, a folder of them, or an NPZ file")
    frame_rate: Float | None = Field(
        default=None, gt=0, le=10_000, description="of a folder of OBJ files [1/s]"
    )
    thickness: Float = Field(
        default=5e-4, ge=0, le=0.05, description="of a skin around the triangles [m]"
    )
    strength: Float = Field(
        default=1.0, ge=0, le=2, description="factor of all displacements since the first frame"
    )
    motion: Motion | None = Field(
        default=None, description="that all of it makes besides; null: none"
    )


Body = Annotated[Plane | Sphere | Cylinder | Capsule | Box | MeshBody, Field(discriminator="type")]

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
        """Numbers of vertices and triangles.

        The vertices are rows of a triangular lattice, with every second row shifted.
        """
        # The mesher of sim_core lays the same rows; a contract test compares the counts.
        columns = max(1, round(self.size[0] / self.spacing))
        rows = max(1, round(self.size[1] / (self.spacing * 0.75**0.5)))
        shifted = rows // 2  # rows 1, 3, ... but the last
        # A shifted row begins and ends on the outline, so it has one vertex more.
        vertices = (rows + 1) * (columns + 1) + shifted
        # Euler: a triangulation has 2 V - 2 - H triangles, with H vertices on its hull.
        hull = 2 * columns + 2 * rows  # every row begins and ends on the outline
        return vertices, 2 * vertices - 2 - hull


class FileMesh(Document):
    """Any flat shape, from an OBJ file whose texture coordinates are the flat pattern."""

    type: Literal["file"]
    file: FileName = Field(
        description="an OBJ file of triangles; its texture coordinates are the flat pattern [m]"
    )
    counts: tuple[Int, Int] | None = Field(
        default=None,
        description="numbers of vertices and triangles; filled in when the file is uploaded",
    )

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of vertices and triangles; 0 before the file is read."""
        return self.counts or (0, 0)


class Flat(Document):
    """It starts flat."""

    type: Literal["flat"]


class Hung(Document):
    """It starts at rest under its holders.

    It is let down from flat before the scene begins.
    """

    type: Literal["hung"]
    bias_until: Time = Field(
        default=0.0, description="until when the seeded push along its normal lasts [s]"
    )


class Stretched(Document):
    """It starts flat and strained."""

    type: Literal["stretched"]
    strain: tuple[
        Annotated[Float, Field(ge=-0.2, le=0.2)], Annotated[Float, Field(ge=-0.2, le=0.2)]
    ] = Field(description="along the warp and across; not equal, or the stiffness has no direction")


class FromFile(Document):
    """It starts at positions in a file."""

    type: Literal["file"]
    file: FileName | None = Field(
        default=None,
        description=(
            "an OBJ file, or an NPZ file with `positions` (V, 3) [m]; null: the file of the mesh"
        ),
    )


class Holder(Document):
    """A holder of vertices of a sheet.

    It holds a rectangle of the flat sheet, an edge, the rim, or listed vertices.
    """

    low: tuple[Place, Place] | None = Field(
        default=None,
        description="corner of the rectangle (along the warp, across), from the middle [m]",
    )
    high: tuple[Place, Place] | None = Field(default=None, description="opposite corner [m]")
    edge: Literal["left", "right", "bottom", "top"] | None = Field(
        default=None,
        description=(
            "left and right are the least and the largest along the warp, bottom and top across"
        ),
    )
    rim: Literal[True] | None = Field(default=None, description="all of the outline")
    vertices: tuple[Vertex, ...] | None = Field(default=None, min_length=1, max_length=100_000)
    motion: Motion | None = Field(default=None, description="of the holder; null: it stays")
    grasp: tuple[Time, Time] | None = Field(
        default=None,
        description="when it takes hold and when it lets go [s]; null: it always holds",
    )

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        # Four ways to choose vertices, of which a holder has one.
        choices = [name for name in ("edge", "rim", "vertices") if getattr(self, name) is not None]
        if self.low is not None or self.high is not None:
            choices.append("low and high")
        if len(choices) != 1:
            raise ValueError(
                "a holder must have one of low and high, edge, rim and vertices, and it has "
                f"{', '.join(choices) or 'none'}"
            )
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high must both be given")
        # A rectangle with its corners exchanged would hold nothing.
        if any(low > high for low, high in zip(self.low or (), self.high or (), strict=True)):
            raise ValueError(
                f"low must be at most high in both [m], and they are {list(self.low or ())} and "
                f"{list(self.high or ())}"
            )
        if self.grasp is not None and not self.grasp[0] < self.grasp[1]:
            raise ValueError(
                f"grasp must be [from, until] in ascending order [s], and it is {list(self.grasp)}"
            )
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
        description=(
            "how it lies, as a rotation vector [rad]; without it the warp is along x and "
            "the weft along y"
        ),
    )
    thickness: Float = Field(default=5e-4, ge=1e-5, le=0.05, description="[m]")
    self_contact: Bool = Field(default=True, description="false: it passes through itself")
    start: Annotated[Flat | Hung | Stretched | FromFile, Field(discriminator="type")] = Flat(
        type="flat"
    )
    holders: Annotated[dict[CustomName, Holder], BY_NAME] = Field(
        default_factory=dict, max_length=64
    )

    @model_validator(mode="after")
    def _can_start(self) -> Self:
        # The file of the mesh has positions; a grid has none.
        if (
            isinstance(self.start, FromFile)
            and self.start.file is None
            and not isinstance(self.mesh, FileMesh)
        ):
            raise ValueError("start.file must name a file where the mesh is not one")
        if isinstance(self.start, Hung) and not self.holders:
            raise ValueError("start can be hung only from holders, and there are none")
        return self


FILM = 36.0
"""Width of the film that focal lengths refer to [mm]."""


class View(Document):
    """A camera, by its position and its target."""

    position: Vector = Field(description="[m]")
    target: Vector = Field(description="the point in the middle of the picture [m]")
    focal_length: Float = Field(
        default=50.0,
        ge=10,
        le=400,
        description="for a film whose shorter side is 36 mm [mm]",
    )
    # Without it, a scene has the digest that it had before.
    resolution: Resolution | None = Field(
        default=None,
        exclude_if=lambda size: size is None,
        description="width and height of the pictures of this camera [px], 64 to 1,920 each; by "
        "default the `resolution` of the spec",
    )

    @model_validator(mode="after")
    def _sees(self) -> Self:
        # The floor ends at 8 m, and is seen from above.
        x, y, z = self.position
        if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and LOWEST <= z <= FARTHEST):
            raise ValueError(
                f"position must be within {FARTHEST:g} m of the middle and {LOWEST:g} m or more "
                "above the floor, and "
                f"it is {list(self.position)} m"
            )
        # Up would have no direction in the picture.
        if math.hypot(*self._forward[:2]) < 1e-6:
            raise ValueError(
                "target must not be straight above or below position, and it is "
                f"{list(self.target)} m"
            )
        return self

    @property
    def _forward(self) -> tuple[float, float, float]:
        x, y, z = (b - a for a, b in zip(self.position, self.target, strict=True))
        return x, y, z

    def camera(self, name: str, resolution: tuple[int, int] = DEFAULT_RESOLUTION) -> Camera:
        """Return the calibrated camera: upright, with the principal point in the middle.

        The resolution of this camera goes before the given one.
        """
        # Rows of the rotation are the axes of the camera: right, which is level, down and forward.
        x, y, z = (value / math.hypot(*self._forward) for value in self._forward)
        level = math.hypot(x, y)
        rotation = ((y / level, -x / level, 0.0), (x * z / level, y * z / level, -level), (x, y, z))
        # t = -R p, for the camera itself is at the origin of its axes.
        a, b, c = (0.0 - sum(map(mul, row, self.position)) for row in rotation)
        size = self.resolution or resolution
        focal = self.focal_length / FILM * min(size)
        return central(name, size, focal, rotation, (a, b, c))


class SheetLook(Document):
    """Looks of a sheet, if no axis sets them."""

    texture: FileName = Field(description="a built-in texture, or a square PNG or JPEG file")


class BodyLook(Document):
    """Looks of a body."""

    color: tuple[Share, Share, Share] = Field(
        default=(0.2, 0.2, 0.2), description="linear red, green, blue, 0 to 1"
    )
    roughness: Share = Field(default=0.5, description="0 is a mirror")


class Looks(Document):
    """The looks of a scene: textures, colours, cameras, light and floor."""

    sheets: Annotated[dict[CustomName, SheetLook], BY_NAME] = Field(
        default_factory=dict,
        description=(
            "textures of their own; the first sheet (by name) without one takes the axis `texture`"
        ),
    )
    bodies: Annotated[dict[CustomName, BodyLook], BY_NAME] = Field(default_factory=dict)
    cameras: (
        str | Annotated[dict[CustomName, View], BY_NAME, Field(min_length=1, max_length=64)] | None
    ) = Field(
        default=None,
        description="a rig by name, or cameras; null: front, side and high frame all that moves",
    )
    light: Lighting | LampNumbers = Field(
        default=Lighting.drawn, description="of the axis `lighting` by default"
    )
    floor: Substrate | FloorNumbers = Field(
        default=Substrate.matt, description="of the axis `substrate` by default"
    )

    @field_validator("cameras")
    @classmethod
    def _known_rig(cls, cameras: "str | dict[str, View] | None") -> "str | dict[str, View] | None":
        # A name is that of a rig; cameras by name are of the scene.
        if isinstance(cameras, str) and cameras not in rig_names():
            raise ValueError(
                f"cameras must be one of {', '.join(rig_names())}, or cameras by name"
                f"{did_you_mean(cameras, rig_names())}"
            )
        return cameras
