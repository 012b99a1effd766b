"""Facts about real things beside the model: for certificates, dataset cards and docs/reality.md.

They are frozen with a date. A certificate says how well the solver solves its model, and these say
how far the model is from measurements.
"""

import tomllib
from functools import cache
from importlib.resources import files
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
    pairs = zip(yarn["length_mm"], yarn["bending_length_mm"], strict=True)
    return Reality(
        date=table["date"],
        yarn=tuple(YarnFit(length, bending_length) for length, bending_length in pairs),
        yarn_source=yarn["source"],
        yarn_meaning=yarn["meaning"],
        drape_source=table["drape"]["source"],
        bands=tuple(
            Band(band["class"], band["low"], band["high"], band["source"])
            for band in table["bands"]
        ),
        left_out=tuple(LeftOut(**item) for item in table["left_out"]),
    )
