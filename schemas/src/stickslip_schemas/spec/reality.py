"""Facts about real things beside the model: for certificates, dataset cards and docs/reality.md.

They are frozen with a date. A certificate says how well the solver solves its model, and these say
how far the model is from measurements.
"""

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Literal, NamedTuple

Subject = Literal["cloth", "rods"]


class Band(NamedTuple):
    """Published drape coefficients of a class of fabrics."""

    name: str
    low: float
    """[%]."""
    high: float
    """[%]."""
    source: str


class LeftOut(NamedTuple):
    """Physics that the model does not have."""

    of: Subject
    missing: str
    size: str


class YarnFit(NamedTuple):
    """The bending length that photographs of yarn of one length give."""

    length: float
    """Overhanging length [mm]."""
    bending_length: float
    """[mm]."""
    error: float
    """Standard deviation of the bending length [mm]."""


class MeasuredFabric(NamedTuple):
    """Facts of a built-in fabric: it is one specimen, and its name says no more."""

    density: float
    """Mass per area [kg/m^2]."""
    bending: tuple[float, float, float]
    """Rigidities along the warp, along the weft, and at 45 degrees [N m]."""
    bending_length: tuple[float, float]
    """Along the warp and the weft [mm]."""
    drape: float
    """Drape coefficient by Cusick's test, simulated [%]: see docs/reality.md for its accuracy."""
    folds: int
    """Folds of the draped disc."""

    @property
    def words(self) -> str:
        """Bending length and drape in words."""
        warp, weft = self.bending_length
        return f"bending length {warp:g} and {weft:g} mm, drape coefficient {self.drape:.0f} %"


@cache
def measured_fabrics() -> Mapping[str, MeasuredFabric]:
    """Return the built-in fabrics by name; `benchmarks/reality.py` writes their table."""
    text = files("stickslip_schemas").joinpath("fabrics", "measured.toml").read_text("utf-8")
    table = tomllib.loads(text)
    return MappingProxyType(
        {
            name: MeasuredFabric(
                facts["density"],
                tuple(facts["bending"]),
                tuple(facts["bending_length"]),
                facts["drape"],
                facts["folds"],
            )
            for name, facts in table.items()
        }
    )


class Reality(NamedTuple):
    """All facts, with their sources."""

    date: str
    yarn: tuple[YarnFit, ...]
    yarn_source: str
    yarn_meaning: str
    drape_source: str
    bands: tuple[Band, ...]
    left_out: tuple[LeftOut, ...]

    def missing_of(self, subject: Subject) -> tuple[LeftOut, ...]:
        """Return the physics that the model of a subject leaves out."""
        return tuple(item for item in self.left_out if item.of == subject)


@cache
def reality() -> Reality:
    """Return the frozen facts of the package."""
    text = files("stickslip_schemas").joinpath("fabrics", "reality.toml").read_text("utf-8")
    table = tomllib.loads(text)
    yarn = table["yarn"]
    columns = (yarn["length_mm"], yarn["bending_length_mm"], yarn["error_mm"])
    return Reality(
        date=table["date"],
        yarn=tuple(YarnFit(*row) for row in zip(*columns, strict=True)),
        yarn_source=yarn["source"],
        yarn_meaning=yarn["meaning"],
        drape_source=table["drape"]["source"],
        bands=tuple(
            Band(band["class"], band["low"], band["high"], band["source"])
            for band in table["bands"]
        ),
        left_out=tuple(LeftOut(**item) for item in table["left_out"]),
    )
