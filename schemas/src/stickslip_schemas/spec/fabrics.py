"""Fabrics: the card of one, its rules, and fabrics that are drawn from statistics.

A card states the numbers of a fabric. Ten are built in, users write their own, and an axis may draw
many. Each of the three ends as a card with a name, so no other module knows where it comes from.
"""

import math
import random
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Annotated, Any, Literal, Never, Self, TypeVar, get_args

from pydantic import (
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    Strict,
    Tag,
    ValidationError,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType

from stickslip_schemas.base import WHOLE, Document, Float, content_key
from stickslip_schemas.spec.axes import Seed, Shorthand, long_form
from stickslip_schemas.spec.measured import measured_draw, measured_softening
from stickslip_schemas.spec.names import Material
from stickslip_schemas.spec.reality import measured_fabrics

Stiffness = Annotated[Float, Field(ge=0, le=1e6)]
Rigidity = Annotated[Float, Field(ge=1e-12, le=1)]

MEMBRANE_MAX = 1e6
"""Upper bound on membrane stiffness: entries of the stretching table, and E h [N/m]."""
PLATE_BOUNDS = (1e-11, 1.0)
"""Bounds on the plate rigidity from `young`, `poisson` and `thickness` [N m]."""

GRAVITY = 9.81
"""Acceleration of gravity in a bending length [m/s^2]."""
LENGTH_BOUNDS = (0.002, 0.1)
"""Bounds of the bending length of a fabric [m].

Of 618 measured fabrics, four standard deviations are within 5 to 75 mm. A rigidity in mN m or in
uN m that is read as N m makes the length ten or a hundred times as large.
"""
RATIO_MAX = 50.0
"""Largest ratio of the rigidities along the warp and the weft.

Of 618 measured fabrics, four standard deviations are within 12 to 1 and 28 to 1. A number in mN m
beside one in N m has a ratio of about 1,000.
"""
SOFTENING_BOUNDS = (50.0, 1e5)
"""Bounds of the curvature by which bending softens [1/m].

Below, the bound is reached at radii of centimetres; above, nothing softens that a mesh resolves.
"""
PER_CENTIMETRE, PER_MILLIMETRE = 100.0, 1000.0
"""Over 1/m."""
LEAST_TWIST = 0.1
"""Least rigidity of twist, over the smaller of the other two: it must be positive, and the
difference of measured numbers may not be."""

DIGITS = 6
"""Significant digits of drawn and converted numbers: all machines have the same cards, and the
same key for one rigidity in two units."""

UNITS: Mapping[str, float] = {
    "N m": 1.0,
    "mN m": 1e-3,
    "uN m": 1e-6,
    "nN m": 1e-9,
    "gf cm2/cm": 9.80665e-5,
}
"""Units of a bending rigidity of cloth, over N m: its moment per width, over a curvature."""

Unit = Literal["N m", "mN m", "uN m", "nN m", "gf cm2/cm"]
Positive = Annotated[Float, Field(gt=0)]


class BendingOfDirections(Document):
    """Bending rigidities against curvature along three directions, as they are measured."""

    warp: Positive = Field(description="rigidity against curvature along the warp")
    weft: Positive = Field(description="rigidity against curvature along the weft")
    diagonal: Positive = Field(description="rigidity against curvature at 45 degrees to both")
    unit: Unit = Field(description="unit of the three")

    def rigidities(self) -> tuple[float, float, float]:
        """Return the plate rigidities along the warp, along the weft and of twist [N m].

        D66 = D(45 degrees) - (D11 + D22) / 4, without a coupling D12.
        """
        scale = UNITS[self.unit]
        warp, weft, diagonal = self.warp * scale, self.weft * scale, self.diagonal * scale
        return _rounded(warp), _rounded(weft), _rounded(twist_of(warp, weft, diagonal))


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def twist_of(warp: float, weft: float, diagonal: float) -> float:
    """Return the rigidity of twist of a fabric from three directions, in their unit."""
    return max(diagonal - 0.25 * (warp + weft), LEAST_TWIST * min(warp, weft))


def bending_length(rigidity: float, density: float) -> float:
    """Return (D / (rho g))^(1/3) [m] of a rigidity [N m] and a mass per area [kg/m^2].

    It is the bending length of ASTM D1388, half of the overhang at 41.5 degrees.
    """
    return math.cbrt(rigidity / (density * GRAVITY))


def _name_or_other(value: Any) -> str:
    return "name" if isinstance(value, str) else "other"


BY_FORM = Discriminator(_name_or_other)
"""Tells a name from a document or a table, so that an error is about the one that is meant."""

Table = tuple[tuple[Stiffness, Stiffness, Stiffness, Stiffness], ...]
Stretching = Annotated[Annotated[Material, Tag("name")] | Annotated[Table, Tag("other")], BY_FORM]


class FabricNumbers(Document):
    """The card of a custom fabric: its constitutive numbers, and where they come from.

    Give the resistance to stretching either as `stretching`, or as `young`, `poisson` and
    `thickness`. Give the resistance to bending as `bending`. With `young` you may leave it out: it
    is then that of a plate of this thickness. A card may be a file `fabrics/NAME.yaml` beside the
    spec or the scene that names it.
    """

    density: Float = Field(ge=0.01, le=5, description="mass per area [kg/m^2]")
    stretching: Stretching | None = Field(
        default=None,
        description="the name of a measured fabric whose stretching it has, or a table: 6 rows of "
        "(k0, k1, k2, k3) [N/m]; energy per area k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3 G01^2 "
        "[Wang et al. 2011]. Row 0: no strain; rows 1 to 5: a stretch of 1 + 1/6 at 0, 22.5, 45, "
        "67.5 and 90 degrees "
        "from the warp",
    )
    young: Float | None = Field(
        default=None, ge=1, le=1e12, description="Young's modulus [Pa] of an isotropic sheet"
    )
    poisson: Float | None = Field(
        default=None, ge=0, le=0.49, description="Poisson's ratio of an isotropic sheet"
    )
    thickness: Float | None = Field(
        default=None, ge=1e-6, le=0.01, description="thickness [m] of an isotropic sheet"
    )
    bending: tuple[Rigidity, Rigidity, Rigidity] | None = Field(
        default=None,
        description="plate rigidities (along the warp, along the weft, twist) [N m], energy per "
        "area H:D:H/2; or a mapping with `warp`, `weft`, `diagonal` and their `unit`: N m, mN m, "
        "uN m, nN m or gf cm2/cm",
    )
    damping: Float = Field(
        default=0.0, ge=0, le=10, description="damping force over momentum [1/s]"
    )
    softening: Float | None = Field(
        default=None,
        exclude_if=lambda softening: softening is None,
        description="curvature D0/|b| [1/m] by which bending softens, M = (D0 - |b| k) k for "
        "curvatures k up to half of it, and D0 k/2 beyond; measured fabrics have 160 to 1,090. "
        "Null: the rigidity is constant",
    )
    source: str | None = Field(
        default=None,
        max_length=500,
        exclude_if=lambda source: source is None,
        description="where the numbers come from, for people; it enters no key",
    )

    @model_validator(mode="before")
    @classmethod
    def _plain(cls, card: Any) -> Any:
        """Return a card with rigidities in N m, whatever form and unit they have."""
        if not isinstance(card, dict):
            return card
        _check_softening(card.get("softening"))
        stated = card.get("bending")
        density = card.get("density")
        if not isinstance(stated, dict):
            # A number above the bound of the field gets no better message than that of the unit.
            _check_magnitudes(stated, "N m", density)
            return card
        bending = _nested(BendingOfDirections, stated, ("bending",))
        _check_magnitudes((bending.warp, bending.weft), bending.unit, density)
        return card | {"bending": bending.rigidities()}

    @model_validator(mode="after")
    def _complete(self) -> Self:
        # A table of stretching, or three numbers of an isotropic sheet.
        isotropic = (self.young, self.poisson, self.thickness)
        if self.stretching is not None:
            if any(number is not None for number in isotropic):
                raise ValueError("give stretching, or young, poisson and thickness, but not both")
            if not isinstance(self.stretching, Material):
                _check_table(self.stretching)
            if self.bending is None:
                raise ValueError(
                    "bending must be given with stretching: a table says nothing of bending"
                )
        elif self.young is None or self.poisson is None or self.thickness is None:
            raise ValueError("give stretching, or all of young, poisson and thickness")
        else:
            # E h is the stiffness of the sheet in its plane.
            membrane = self.young * self.thickness
            if membrane > MEMBRANE_MAX:
                raise ValueError(
                    f"young times thickness must be at most {MEMBRANE_MAX:g} N/m, and it is "
                    f"{membrane:g}"
                )
            # E h^3 / (12 (1 - nu^2))
            plate = membrane * self.thickness**2 / (12 * (1 - self.poisson**2))
            if not PLATE_BOUNDS[0] <= plate <= PLATE_BOUNDS[1]:
                low, high = PLATE_BOUNDS
                raise ValueError(
                    f"young and thickness must give a plate rigidity from {low:g} to {high:g} N m, "
                    f"and it is {plate:g}"
                )
        return self

    def numbers(self) -> dict[str, Any]:
        """Return the card as JSON without its source: all that a simulation depends on."""
        return self.model_dump(mode="json", exclude={"source"})

    @property
    def identity(self) -> str:
        """A name that follows the numbers alone, for content keys and seeds."""
        return f"fabric-{content_key('fabric', self.numbers())[:16]}"

    @property
    def size_words(self) -> str:
        """The bending length to one digit: fabrics of one size cost about the same."""
        rigidity = self.bending
        if rigidity is None:
            return "isotropic"
        length = bending_length(math.sqrt(rigidity[0] * rigidity[1]), self.density)
        return f"bending length {1e3 * length:.1g} mm"


def _check_softening(softening: Any) -> None:
    """Raise ValidationError for a curvature of softening that no cloth has, or of another unit."""
    # Wrong types, and what is not finite, have errors of their own.
    is_number = isinstance(softening, int | float) and not isinstance(softening, bool)
    if not (is_number and math.isfinite(softening)):
        return
    low, high = SOFTENING_BOUNDS
    if low <= softening <= high:
        return
    hint = ""
    if softening < 0:
        hint = "; give D0 over the size of b: a negative b softens"
    elif low <= softening * PER_CENTIMETRE <= high:
        hint = "; is it in 1/cm?"
    elif low <= softening * PER_MILLIMETRE <= high:
        hint = "; is it in 1/mm?"
    rule = f"must be from {low:g} to {high:g} 1/m{hint}"
    _refuse("FabricNumbers", ("softening",), rule, softening)


def _check_table(table: Sequence[tuple[float, float, float, float]]) -> None:
    """Raise ValueError for a table of stretching with which some strain has no energy."""
    if len(table) != 6:
        raise ValueError(f"stretching must have 6 rows, and it has {len(table)}")
    for row, (k0, k1, k2, _) in enumerate(table):
        if not k1 * k1 < k0 * k2:
            raise ValueError(
                "stretching must be positive definite: k1^2 < k0 k2 in every row, but row "
                f"{row} has k0 = {k0:g}, k1 = {k1:g}, k2 = {k2:g}"
            )


def _check_magnitudes(rigidities: Any, unit: Unit, density: Any) -> None:
    """Raise ValidationError for rigidities along warp and weft that no cloth has.

    They and the mass per area are as the user wrote them: wrong types have errors of their own.
    """
    if not (isinstance(rigidities, list | tuple) and len(rigidities) >= 2):
        return
    warp, weft = rigidities[:2]
    if not all(_is_positive(number) for number in (warp, weft, density)):
        return
    low, high = LENGTH_BOUNDS
    for direction, rigidity in (("warp", warp), ("weft", weft)):
        length = bending_length(rigidity * UNITS[unit], density)
        if not low <= length <= high:
            rule = (
                f"must fit the density: {rigidity:g} {unit} along the {direction} and "
                f"{density:g} kg/m^2 have a bending length of {1e3 * length:.3g} mm, and cloth "
                f"has {1e3 * low:g} to {1e3 * high:g} mm{_unit_question(rigidity, density)}"
            )
            _refuse("FabricNumbers", ("bending",), rule, list(rigidities))
    ratio = max(warp / weft, weft / warp)
    if ratio > RATIO_MAX:
        rule = (
            f"must have one unit: {warp:g} and {weft:g} {unit} along warp and weft have a ratio "
            f"of {ratio:.3g}, and cloth has at most {RATIO_MAX:g}; is one of them in another unit?"
        )
        _refuse("FabricNumbers", ("bending",), rule, list(rigidities))


def _is_positive(number: Any) -> bool:
    # In Python, True is an int.
    is_number = isinstance(number, int | float) and not isinstance(number, bool)
    return is_number and math.isfinite(number) and number > 0


def _unit_question(rigidity: float, density: float) -> str:
    """Return a question for the units in which a number would be that of cloth; or nothing."""
    low, high = LENGTH_BOUNDS
    units = [
        unit
        for unit, scale in UNITS.items()
        if low <= bending_length(rigidity * scale, density) <= high
    ]
    return f"; is it in {' or '.join(units)}?" if units else ""


Location = tuple[str | int, ...]
D = TypeVar("D", bound=Document)
_KNOWN_ERRORS = frozenset(get_args(ErrorType))


def _refuse(title: str, location: Location, rule: str, value: Any) -> Never:
    """Raise a ValidationError for one value of a card."""
    broken = PydanticCustomError("broken_rule", "{rule}", {"rule": rule})
    details = InitErrorDetails(type=broken, loc=location, input=value)
    raise ValidationError.from_exception_data(title, [details])


def _nested(model: type[D], value: Any, location: Location) -> D:
    """Return a part of a document; errors have its location before their own."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        details = [_moved(item, location) for item in error.errors(include_url=False)]
        raise ValidationError.from_exception_data(model.__name__, details) from error


def _moved(item: ErrorDetails, location: Location) -> InitErrorDetails:
    """Return an error at a location below another one."""
    moved = (*location, *item["loc"])
    # Errors of our own checks have a text alone; pydantic words its own from their context.
    if item["type"] in _KNOWN_ERRORS and item["type"] != "value_error":
        context = item.get("ctx", {})
        return InitErrorDetails(type=item["type"], loc=moved, input=item["input"], ctx=context)
    rule = {"rule": item["msg"].removeprefix("Value error, ")}
    broken = PydanticCustomError("broken_rule", "{rule}", rule)
    return InitErrorDetails(type=broken, loc=moved, input=item["input"])


# ---- Fabrics that are drawn ------------------------------------------------------------------


def nearest_by_weight(density: float) -> Material:
    """Return the built-in fabric whose mass per area is nearest by its ratio."""
    fabrics = measured_fabrics()
    return Material(min(fabrics, key=lambda name: abs(math.log(fabrics[name].density / density))))


DRAWN_MAX = 2_000
"""Most fabrics that an axis draws: a spec holds the card of each."""
TRIES_MAX = 100
"""Draws for each fabric: so many that none is one of cloth mean wrong ranges."""

Range = tuple[Positive, Positive]


class FabricRanges(Document):
    """Ranges of the numbers of fabrics: each is drawn by itself, and its logarithm is uniform."""

    density: Range = Field(description="mass per area, low and high [kg/m^2]")
    warp: Range = Field(description="rigidity along the warp, low and high")
    weft: Range = Field(description="rigidity along the weft, low and high")
    diagonal: Range = Field(description="rigidity at 45 degrees to both, low and high")
    unit: Unit = Field(description="unit of the rigidities")
    softening: Range | None = Field(
        default=None,
        description="curvature by which bending softens, low and high [1/m]; null: none softens",
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("density", "warp", "weft", "diagonal", "softening"):
            if getattr(self, name) is None:
                continue
            low, high = getattr(self, name)
            if not low <= high:
                rule = f"must be [low, high], low at most high, and it is {[low, high]}"
                _refuse(type(self).__name__, (name,), rule, [low, high])
        return self

    def draw(self, normals: Sequence[float]) -> tuple[float, float, float, float]:
        """Return density, warp, weft and diagonal [SI] from four standard normal numbers."""
        scale = UNITS[self.unit]
        ranges = (self.density, self.warp, self.weft, self.diagonal)
        drawn = []
        for (low, high), normal in zip(ranges, normals, strict=True):
            share = NormalDist().cdf(normal)
            drawn.append(low * (high / low) ** share)
        density, warp, weft, diagonal = drawn
        return density, warp * scale, weft * scale, diagonal * scale


class FabricDistribution(Document):
    """An axis of fabrics that are drawn: from the statistics of 618 measured ones, or ranges."""

    distribution: Annotated[
        Annotated[Literal["measured-618"], Tag("name")] | Annotated[FabricRanges, Tag("other")],
        BY_FORM,
    ] = Field(
        description="`measured-618`, the statistics of 618 fabrics [Feng et al. 2022], or ranges"
    )
    num: Annotated[int, Strict(), Field(ge=1, le=DRAWN_MAX), WHOLE] = Field(
        description="number of fabrics; a larger one keeps those of a smaller one"
    )
    seed: Seed = 0
    stretching: Material | None = Field(
        default=None,
        description="a measured fabric whose stretching all have; null: for each the nearest "
        "by mass per area",
    )

    def cards(self) -> dict[str, dict[str, Any]]:
        """Return the cards of the drawn fabrics by name.

        Draws that are not of cloth, by their bending length or their ratio, are drawn again.

        Raises:
            ValidationError: Too few draws are of cloth.
        """
        stream = random.Random(self.seed)
        # It has a stream of its own, since nothing is known of how it goes with the other numbers.
        of_softening = random.Random(f"softening {self.seed}")
        cards: dict[str, dict[str, Any]] = {}
        for number in range(self.num):
            card = self._drawn_card(stream)
            if card is None:
                rule = (
                    f"must hold fabrics: of {TRIES_MAX} draws none has bending lengths from "
                    f"{1e3 * LENGTH_BOUNDS[0]:g} to {1e3 * LENGTH_BOUNDS[1]:g} mm, ratios of warp "
                    f"to weft up to {RATIO_MAX:g} and 0.01 to 5 kg/m^2; is the unit right?"
                )
                value = self.model_dump(mode="json")["distribution"]
                _refuse(type(self).__name__, ("distribution",), rule, value)
            softening = self._softening(_within(of_softening.random()))
            if softening is not None:
                card["softening"] = softening
            cards[f"{self._word}-{self.seed}-{number}"] = card
        return cards

    @property
    def _word(self) -> str:
        return self.distribution if isinstance(self.distribution, str) else "drawn"

    def _drawn_card(self, stream: random.Random) -> dict[str, Any] | None:
        for _ in range(TRIES_MAX):
            normals = [NormalDist().inv_cdf(_within(stream.random())) for _ in range(4)]
            if isinstance(self.distribution, FabricRanges):
                drawn = self.distribution.draw(normals)
            else:
                drawn = measured_draw(normals)
            density, warp, weft, diagonal = (_rounded(number) for number in drawn)
            if 0.01 <= density <= 5.0 and is_of_cloth(density, warp, weft):
                twist = _rounded(twist_of(warp, weft, diagonal))
                return {
                    "density": density,
                    "stretching": str(self.stretching or nearest_by_weight(density)),
                    "bending": [warp, weft, twist],
                    "source": f"drawn from {self._word}, seed {self.seed}",
                }
        return None

    def _softening(self, share: float) -> float | None:
        """Return the curvature of softening [1/m] for a share of (0, 1), or None."""
        if not isinstance(self.distribution, FabricRanges):
            return _rounded(measured_softening(share))
        if self.distribution.softening is None:
            return None
        low, high = self.distribution.softening
        return _rounded(low * (high / low) ** share)


def _within(share: float) -> float:
    """Return a share of (0, 1) from one of [0, 1): the normal distribution has no value at 0."""
    return max(share, 2.0**-53)


def is_of_cloth(density: float, warp: float, weft: float) -> bool:
    """Return whether rigidities [N m] are those of cloth of this mass per area [kg/m^2]."""
    low, high = LENGTH_BOUNDS
    lengths = (bending_length(warp, density), bending_length(weft, density))
    return all(low <= length <= high for length in lengths) and (
        1.0 / RATIO_MAX <= warp / weft <= RATIO_MAX
    )


class _FabricShorthand(Shorthand):
    """Accepts the short forms of an axis of fabrics; the JSON schema has the distribution, too."""

    def __get_pydantic_json_schema__(
        self, core: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        schema = super().__get_pydantic_json_schema__(core, handler)
        # A spec that has been read has the names of the cards.
        if handler.mode == "serialization":
            return schema
        drawn = handler(FabricDistribution.__pydantic_core_schema__)
        return {**schema, "anyOf": [*schema["anyOf"], drawn]}


FABRIC_SHORTHAND = _FabricShorthand(long_form)
"""Lets an axis of fabrics be written in its short form, or be drawn."""


def is_distribution(axis: Any) -> bool:
    """Return whether an axis, as it is written, draws fabrics."""
    return isinstance(axis, dict) and "distribution" in axis


def drawn_cards(axis: Any, location: Location, known: Any) -> dict[str, dict[str, Any]]:
    """Return the cards that an axis draws, beside those that a document defines.

    `location` is that of the axis. Raises ValidationError for a wrong axis, or a name that the
    document defines otherwise.
    """
    distribution = _nested(FabricDistribution, axis, location)
    try:
        cards = distribution.cards()
    except ValidationError as error:
        details = [_moved(item, location) for item in error.errors(include_url=False)]
        raise ValidationError.from_exception_data("axes", details) from error
    defined = known if isinstance(known, dict) else {}
    for name, card in cards.items():
        if name in defined and defined[name] != card:
            rule = f"must not define {name}, which the axis draws"
            _refuse("materials", (*location, "distribution"), rule, name)
    return cards
