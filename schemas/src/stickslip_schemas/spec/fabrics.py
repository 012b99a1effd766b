"""Materials of cloth: ten measured fabrics by name, custom fabrics as numbers; names of textures.

The numbers of the measured materials live with the simulation core; a contract test compares the names.
"""

from collections.abc import Iterable
from difflib import get_close_matches
from enum import StrEnum
from typing import Annotated, Self

from pydantic import Field, WithJsonSchema, model_validator

from stickslip_schemas.base import Document, Float


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

Stiffness = Annotated[Float, Field(ge=0, le=1e6)]
Rigidity = Annotated[Float, Field(ge=1e-12, le=1)]

MEMBRANE_MAX = 1e6
"""Upper bound on membrane stiffness: entries of the stretching table, and E h [N/m]."""
PLATE_BOUNDS = (1e-11, 1.0)
"""Bounds on the plate rigidity from `young`, `poisson` and `thickness` [N m]."""


class FabricNumbers(Document):
    """The constitutive numbers of a custom fabric.

    Give the resistance to stretching either as `stretching`, a table, or as `young`, `poisson` and `thickness`. Give
    the resistance to bending as `bending`. With `young` you may leave it out: it is then that of a plate of this
    thickness.
    """

    density: Float = Field(ge=0.01, le=5, description="mass per area [kg/m^2]")
    stretching: tuple[tuple[Stiffness, Stiffness, Stiffness, Stiffness], ...] | None = Field(
        default=None,
        description="6 rows of (k0, k1, k2, k3) [N/m]; energy per area k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3 G01^2 "
        "[Wang et al. 2011]. Row 0: no strain; rows 1 to 5: a stretch of 1 + 1/6 at 0, 22.5, 45, 67.5 and 90 degrees "
        "from the warp",
    )
    young: Float | None = Field(default=None, ge=1, le=1e12, description="Young's modulus [Pa] of an isotropic sheet")
    poisson: Float | None = Field(default=None, ge=0, le=0.49, description="Poisson's ratio of an isotropic sheet")
    thickness: Float | None = Field(default=None, ge=1e-6, le=0.01, description="thickness [m] of an isotropic sheet")
    bending: tuple[Rigidity, Rigidity, Rigidity] | None = Field(
        default=None,
        description="plate rigidities (along the warp, along the weft, twist) [N m], energy per area H:D:H/2",
    )
    damping: Float = Field(default=0.0, ge=0, le=10, description="damping force over momentum [1/s]")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        isotropic = (self.young, self.poisson, self.thickness)
        if self.stretching is not None:
            if any(number is not None for number in isotropic):
                raise ValueError("give stretching, or young, poisson and thickness, but not both")
            if len(self.stretching) != 6:
                raise ValueError(f"stretching must have 6 rows, and it has {len(self.stretching)}")
            for row, (k0, k1, k2, _) in enumerate(self.stretching):
                if not k1 * k1 < k0 * k2:
                    raise ValueError(
                        f"stretching must be positive definite: k1^2 < k0 k2 in every row, but row {row} has "
                        f"k0 = {k0:g}, k1 = {k1:g}, k2 = {k2:g}"
                    )
            if self.bending is None:
                raise ValueError("bending must be given with stretching: a table says nothing of bending")
        elif self.young is None or self.poisson is None or self.thickness is None:
            raise ValueError("give stretching, or all of young, poisson and thickness")
        else:
            membrane = self.young * self.thickness
            if membrane > MEMBRANE_MAX:
                raise ValueError(f"young times thickness must be at most {MEMBRANE_MAX:g} N/m, and it is {membrane:g}")
            plate = membrane * self.thickness**2 / (12 * (1 - self.poisson**2))  # E h^3 / (12 (1 - nu^2))
            if not PLATE_BOUNDS[0] <= plate <= PLATE_BOUNDS[1]:
                low, high = PLATE_BOUNDS
                raise ValueError(
                    f"young and thickness must give a plate rigidity from {low:g} to {high:g} N m, and it is {plate:g}"
                )
        return self


CustomName = Annotated[str, Field(pattern=MATERIAL_NAME)]


def name_schema(built_in: Iterable[str]) -> WithJsonSchema:
    """Return the JSON schema of a name: a built-in one, or the pattern of custom ones."""
    return WithJsonSchema({"anyOf": [{"enum": list(map(str, built_in))}, {"type": "string", "pattern": MATERIAL_NAME}]})


class Texture(StrEnum):
    """Procedural cloth textures; the last four are to test networks with that never saw them [thesis, 4.5.1].

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


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return `; did you mean ...?` with the known word that is most like `word`, or nothing where none is."""
    close = get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else ""
