"""Meanings of names in a spec: textures, lamps, floors and cameras.

They are built in, or defined by numbers of the user.

The numbers of the measured fabrics live with the simulation core; a contract test compares the
names.
"""

import math
from collections.abc import Iterable
from difflib import get_close_matches
from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, Strict, WithJsonSchema, model_validator

from stickslip_schemas.base import WHOLE, Document, Float
from stickslip_schemas.spec.cameras import NO_LENS, Camera, distorted
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION, Resolution


class Material(StrEnum):
    """The ten fabrics measured by [Wang et al. 2011].

    Their order gives the codes of the label `material`: add new ones at the end.
    """

    black_denim = "11oz-black-denim"
    camel_ponte_roma = "camel-ponte-roma"
    gray_interlock = "gray-interlock"
    ivory_rib_knit = "ivory-rib-knit"
    navy_sparkle_sweat = "navy-sparkle-sweat"
    pink_ribbon_brown = "pink-ribbon-brown"
    royal_target = "royal-target"
    tango_red_jet_set = "tango-red-jet-set"
    white_dots_on_blk = "white-dots-on-blk"
    white_swim_solid = "white-swim-solid"


MATERIAL_NAME = r"^[a-z0-9][a-z0-9-]{0,62}$"

CustomName = Annotated[str, Field(pattern=MATERIAL_NAME)]


def name_schema(built_in: Iterable[str]) -> WithJsonSchema:
    """Return the JSON schema of a name: a built-in one, or the pattern of custom ones."""
    return WithJsonSchema(
        {
            "anyOf": [
                {"enum": list(map(str, built_in))},
                {"type": "string", "pattern": MATERIAL_NAME},
            ]
        }
    )


class Texture(StrEnum):
    """Procedural cloth textures.

    The last four are to test networks with that never saw them [thesis, 4.5.1].

    Their order gives the codes of the label `texture`: add new ones at the end.
    """

    checker = "checker"
    dots = "dots"
    stripes = "stripes"
    plaid = "plaid"
    gingham = "gingham"
    herringbone = "herringbone"
    houndstooth = "houndstooth"
    floral = "floral"
    argyle = "argyle"
    camouflage = "camouflage"
    chevron = "chevron"
    terrazzo = "terrazzo"


LEAST_LIKENESS = 0.65
"""Likeness of two words from which on one is suggested for the other [difflib's ratio]."""
LEAST_PART_LETTERS = 4
"""Letters that a part of a name must have to stand for it."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a question for the known word that is most like `word`, or an empty text.

    A known word that contains `word` counts, too: `denim` means `11oz-black-denim`.
    """
    names = list(known)
    close = get_close_matches(word, names, n=1, cutoff=LEAST_LIKENESS)
    if not close and len(word) >= LEAST_PART_LETTERS:
        close = [name for name in names if word.lower() in name.lower()]
    return f"; did you mean {close[0]}?" if close else ""


FARTHEST = 4.0
"""Largest distance of a camera from the middle of the scene along each axis [m]: the floor ends at
8 m.
"""
LOWEST = 0.02
"""Least height of a camera above the floor [m]."""
FIELD_OF_VIEW = (3.0, 150.0)
"""Of a calibrated image along each side [degree]."""

_TOLERANCE = 1e-9
_RADII = 64  # at which a lens is checked
_BORDER_TOLERANCE = 1e-3  # of the border of a clip that is traced through its lens and back [px]

Azimuth = Annotated[Float, Field(ge=-180, le=180)]
Elevation = Annotated[Float, Field(ge=5, le=90)]
Power = Annotated[Float, Field(ge=0.05, le=10)]
Share = Annotated[Float, Field(ge=0, le=1)]
Roughness = Annotated[Float, Field(ge=0.01, le=1)]
Tint = Annotated[Float, Field(ge=0.05, le=1)]
Pixels = Annotated[int, Strict(), Field(ge=16, le=16384), WHOLE]
Row = tuple[Float, Float, Float]


class Lighting(StrEnum):
    """Named ranges that the lamp of a clip is drawn from.

    Two are of a studio; the others are a bright room and a window beside the cloth.

    Their order gives the codes of the label `lighting`: add new ones at the end.
    """

    drawn = "drawn"
    held_out = "held-out"
    room = "room"
    window = "window"


class Substrate(StrEnum):
    """Finishes of the floor.

    They are matt black, the seven of the thesis (4.2.2), woven cloth, bright ones, and any hard
    one.

    Numbers of a finish are drawn within a range. The order gives the codes of the label
    `substrate`: add new ones at the end.
    """

    matt = "matt"
    aluminium = "aluminium"
    aluminium_pet = "aluminium-pet"
    ceramic = "ceramic"
    rough_glass = "rough-glass"
    smooth_glass = "smooth-glass"
    polyester_mirror = "polyester-mirror"
    stainless_steel = "stainless-steel"
    cloth = "cloth"
    white_table = "white-table"
    light_oak = "light-oak"
    beech = "beech"
    concrete = "concrete"
    any = "any"


class _Ranges(Document):
    """Pairs are ranges that a seed draws from, `[low, high]`."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) == 2 and not value[0] <= value[1]:
                raise ValueError(
                    f"{name} must be [low, high], low at most high, and it is {list(value)}"
                )
        return self


class LampNumbers(_Ranges):
    """A custom lamp.

    Each pair is a range `[low, high]` that a seed draws from, for each view of each simulation.
    """

    azimuth: tuple[Azimuth, Azimuth] = Field(
        description=(
            "azimuth of the lamp, seen from the cloth, from +x towards +y [degree], -180 to 180"
        )
    )
    elevation: tuple[Elevation, Elevation] = Field(
        description="elevation of the lamp above the floor [degree], 5 to 90"
    )
    power: tuple[Power, Power] = Field(
        description="power over the nominal power, 0.05 to 10; `drawn` has 0.8 to 1.25"
    )


class FloorNumbers(_Ranges):
    """A custom floor.

    Each pair is a range `[low, high]` that a seed draws from, for each view of each simulation.
    """

    albedo: tuple[Share, Share] = Field(
        description=(
            "share of the light that the floor scatters, or reflects if it is a metal, 0 to 1"
        )
    )
    roughness: tuple[Roughness, Roughness] = Field(
        description="roughness of the gloss, 0.01 to 1; 0.02 is a mirror"
    )
    metallic: Share = Field(default=0.0, description="1 for a metal, 0 for a dielectric")
    specular: Share = Field(
        default=0.5, description="gloss of a dielectric; 0.5 is an index of refraction of 1.5"
    )
    grain: Share = Field(
        default=0.1,
        description="contrast of the marks on the floor; at 0, motion over it is invisible",
    )
    tint: tuple[Tint, Tint, Tint] = Field(
        default=(1.0, 1.0, 1.0),
        description="colour (linear red, green, blue), 0.05 to 1; only ratios count",
    )


def _flatten_vector(value: Any) -> Any:
    """Return a column or a row of numbers as a plain list, as OpenCV's arrays are written.

    `solvePnP` returns rvec and tvec as [[a], [b], [c]], and `calibrateCamera` the distortion as
    [[k1, k2, p1, p2, k3]].
    """
    if not isinstance(value, list | tuple) or not value:
        return value
    # A plain list has numbers in it, and no lists.
    rows = [row for row in value if isinstance(row, list | tuple)]
    if len(rows) != len(value):
        return value
    is_row = len(rows) == 1
    is_column = all(len(row) == 1 for row in rows)
    return [number for row in rows for number in row] if is_row or is_column else value


FLATTENED = BeforeValidator(_flatten_vector)
"""Takes the vectors of OpenCV as they are."""


class Calibration(Document):
    """A custom camera, with the numbers that OpenCV's `calibrateCamera` and `solvePnP` give.

    The world's z axis points up from the floor, which is z = 0. A dragged cloth stays within x =
    -0.1 to 0.4, y = -0.1 to 0.1 and z = 0 to 0.25 m. A clip shows the largest part in the middle of
    the image that has the shape of its resolution, scaled to it: all of the image if the resolution
    is that of the image.
    """

    image_size: tuple[Pixels, Pixels] = Field(
        description="width and height of the calibrated image [px]"
    )
    camera_matrix: tuple[Row, Row, Row] = Field(
        description="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [px]"
    )
    distortion: Annotated[tuple[Float, ...], FLATTENED] = Field(
        default=(),
        max_length=14,
        description=(
            "distortion coefficients k1, k2, p1, p2, k3 of the lens; further ones must be 0"
        ),
    )
    rvec: Annotated[Row, FLATTENED] = Field(
        description="rotation from the world to the camera, as a Rodrigues vector [rad]"
    )
    tvec: Annotated[Row, FLATTENED] = Field(
        description="the world's origin in the camera's axes [m]"
    )
    resolution: Resolution | None = Field(
        default=None,
        exclude_if=lambda size: size is None,
        description="width and height of the pictures of this camera [px], 64 to 1,920 each; by "
        "default the `resolution` of the spec",
    )

    @model_validator(mode="after")
    def _can_be_rendered(self) -> Self:
        # OpenCV has up to 14 coefficients; the renderer has the first five.
        if any(self.distortion[5:]):
            raise ValueError(
                "distortion must be 0 after k1, k2, p1, p2, k3: calibrate without rational, prism "
                "and tilted models; "
                f"it is {list(self.distortion)}"
            )
        # The renderer has no skew, and the last row is always 0, 0, 1.
        (fx, skew, cx), (zero, fy, cy), last = self.camera_matrix
        if skew != 0 or zero != 0 or last != (0.0, 0.0, 1.0) or fx <= 0 or fy <= 0:
            raise ValueError(
                "camera_matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above "
                "0: the renderer has "
                f"no skew; it is {[list(row) for row in self.camera_matrix]}"
            )
        for axis, f, c, side in zip("xy", (fx, fy), (cx, cy), self.image_size, strict=True):
            # A field of view of 2 a sees half of the side at the focal length side / (2 tan a).
            least, most = (
                0.5 * side / math.tan(math.radians(0.5 * view)) for view in reversed(FIELD_OF_VIEW)
            )
            ranges = (("f", f, least, most), ("c", c, -0.5 * side, 1.5 * side))
            for name, value, low, high in ranges:
                if not low <= value <= high:
                    raise ValueError(
                        f"camera_matrix must have {name}{axis} from {low:.4g} to {high:.4g} px, "
                        "for a field of view of "
                        f"{FIELD_OF_VIEW} degrees and a centre within half an image of its edges; "
                        f"it is {value:g} px"
                    )
        # The lens is checked with the camera of the clip, which is cut from the image.
        self.check_lens(DEFAULT_RESOLUTION)
        x, y, z = self.camera("own").position
        if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST and LOWEST <= z <= FARTHEST):
            raise ValueError(
                f"rvec and tvec must put the camera within {FARTHEST:g} m of the scene's middle "
                f"and {LOWEST:g} m or "
                f"more above the floor, and it is at ({x:.3g}, {y:.3g}, {z:.3g}) m"
            )
        return self

    def check_lens(self, resolution: tuple[int, int]) -> None:
        """Raise ValueError for a lens that no clip of a resolution can be rendered with.

        A lens must not show a point twice within the picture, nor see farther than any camera may.
        """
        camera = self.camera("own", resolution)
        border = camera.border()
        # s = x^2 + y^2 of the corner of the box around all that the picture shows.
        farthest = max(abs(x) for x, _ in border) ** 2 + max(abs(y) for _, y in border) ** 2
        # Points must move outwards in their order: d(r g) / dr > 0 at all radii.
        k1, k2, _, _, k3 = camera.distortion
        squares = [k / _RADII * farthest for k in range(_RADII + 1)]
        is_rising = all(1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * 7.0 * k3)) > 0.0 for s in squares)
        # The lens was inverted along the border: its image must be the border again.
        is_inverted = True
        for x, y in border:
            u, v = distorted(x, y, camera.distortion)
            pixel = (camera.fx * u + camera.cx, camera.fy * v + camera.cy)
            sides = (camera.width, camera.height)
            gaps = [
                min(abs(p + 0.5), abs(p - side + 0.5)) for p, side in zip(pixel, sides, strict=True)
            ]
            is_inverted = is_inverted and min(gaps) < _BORDER_TOLERANCE
        widest = 2.0 * math.tan(math.radians(0.5 * FIELD_OF_VIEW[1])) ** 2
        if not (is_rising and is_inverted and farthest <= widest):
            raise ValueError(
                "distortion must move places outwards in their order over the whole picture of "
                f"{camera.width} x {camera.height} pixels, for a field of view of up to "
                f"{FIELD_OF_VIEW[1]:g} degrees; it is {list(self.distortion)}"
            )

    def camera(self, name: str, resolution: tuple[int, int] = DEFAULT_RESOLUTION) -> Camera:
        """Return the camera of a clip.

        It shows the largest part in the middle of the image that has the shape of the picture,
        scaled to the picture. The resolution of this camera goes before the given one.
        """
        picture_width, picture_height = self.resolution or resolution
        width, height = self.image_size
        # The part has the whole height of the image if the image is the wider one, or its whole
        # width.
        part_width, part_height = height * picture_width / picture_height, float(height)
        scale = picture_height / height
        if part_width > width:
            part_width, part_height = float(width), width * picture_height / picture_width
            scale = picture_width / width
        (fx, _, cx), (_, fy, cy), _ = self.camera_matrix
        # Pixel centres are whole numbers: the left edge of the part is at (width - part_width) / 2
        # - 1/2.
        left = (width - part_width) / 2
        top = (height - part_height) / 2
        return Camera(
            name=name,
            width=picture_width,
            height=picture_height,
            fx=fx * scale,
            fy=fy * scale,
            cx=(cx - left + 0.5) * scale - 0.5,
            cy=(cy - top + 0.5) * scale - 0.5,
            rotation=_rotation(self.rvec),
            translation=self.tvec,
            distortion=(*self.distortion, *NO_LENS)[:5],
        )


def _rotation(rvec: Row) -> tuple[Row, Row, Row]:
    """Return the rotation by a = |r| about r [Rodrigues].

    R = I + sin(a) K + (1 - cos(a)) K^2, with K v = r / a x v.
    """
    angle = math.hypot(*rvec)
    x, y, z = (value / angle if angle > _TOLERANCE else value for value in rvec)
    s = math.sin(angle)
    c = 1.0 - math.cos(angle)
    return (
        (1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y),
        (c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x),
        (c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)),
    )
