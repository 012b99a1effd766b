"""Looks of fabrics (shader, hem and grain of each material) and of lamps, drawn from a seed."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.surface import Surface

if TYPE_CHECKING:
    from stickslip_schemas.spec.appearance import LampNumbers

Field = npt.NDArray[np.float64]
Grain = Literal["plain", "twill", "melange", "rib", "sparkle", "ribbon", "mesh", "pin-dots"]


@dataclass(frozen=True)
class Look:
    """The look of one fabric."""

    roughness: float
    """Of its gloss, 0 to 1 as Blender's Principled shader takes it."""
    specular: float
    """Strength of its gloss, 0.5 for an index of refraction of 1.5."""
    sheen: float
    """Weight of the fuzz that shines at grazing angles."""
    translucency: float
    """Share of the light that goes through, 0 to 1."""
    hem: float
    """Half the thickness of its hem [mm]."""
    grain: Grain
    """Pattern of the weave or knit in the colour."""
    contrast: float
    """Of the grain: 0 is none."""


@cache
def looks() -> dict[str, Look]:
    """Return the look of every material, by its name."""
    data = tomllib.loads(files("stickslip_blender.cloth").joinpath("fabrics.toml").read_text(encoding="utf-8"))
    return {material: Look(**numbers) for material, numbers in data.items()}


PLAIN = Look(roughness=0.85, specular=0.2, sheen=0.15, translucency=0.05, hem=0.6, grain="plain", contrast=0.05)
"""Of a fabric that is not in fabrics.toml: a user's own."""


def look_of(material: str) -> Look:
    """Return the look of a material, `PLAIN` for a custom one."""
    return looks().get(material, PLAIN)


def grained(picture: npt.NDArray[np.uint8], look: Look, surface: Surface) -> npt.NDArray[np.uint8]:
    """Return a texture (size, size, 3), 8-bit sRGB, printed on a sheet, with the grain of its fabric and a hem.

    Row 0 is the lower edge of the sheet; the picture covers the longer side.
    """
    wide, high = (1e3 * side for side in surface.size)
    across = (np.arange(len(picture)) + 0.5) / len(picture) * max(wide, high)
    u, v = np.meshgrid(across, across)
    shade = 1.0 + look.contrast * _GRAINS[look.grain](u, v)
    if surface.is_rectangle:
        shade *= 1.0 - 0.3 * _stitches(u, v, wide, high)
    return np.rint(np.clip(picture * shade[..., None], 0.0, 255.0)).astype(np.uint8)


def _stitches(u: Field, v: Field, wide: float, high: float) -> Field:
    """Return 1 on the stitches of the hem, 4.5 mm from the edge and 3 mm long, at (u, v) [mm]; 0 elsewhere."""
    from_side, from_end = np.minimum(u, wide - u), np.minimum(v, high - v)
    seam = np.abs(np.minimum(from_side, from_end) - 4.5) < 0.45
    along = np.where(from_side < from_end, v, u)
    return (seam & (np.mod(along, 4.0) < 3.0)).astype(np.float64)


def _noise(shape: tuple[int, ...], blur: tuple[int, int], seed: int) -> Field:
    """Return smooth noise of unit deviation that wraps around; `blur` is its extent down and across [texels]."""
    noise = np.random.Generator(np.random.PCG64(seed)).standard_normal(shape)
    for axis, extent in enumerate(blur):
        noise = sum((np.roll(noise, shift, axis) for shift in range(extent)), np.zeros(shape))
    scaled: Field = (noise - noise.mean()) / noise.std()
    return scaled


# Grains: from places on the cloth [mm] to a factor's departure from 1, about -1 to 1. A pixel of 224 is 1.5 to 3 mm, so
# threads are drawn too coarse: periods are those that a camera sees at all.
_GRAINS: dict[Grain, Callable[[Field, Field], Field]] = {
    "plain": lambda u, v: 0.5 * _noise(u.shape, (6, 6), 1),
    "twill": lambda u, v: 0.7 * np.sin(2.0 * np.pi * (u + v) / 4.0) + 0.3 * _noise(u.shape, (24, 2), 2),
    "melange": lambda u, v: 0.8 * _noise(u.shape, (2, 12), 3),
    "rib": lambda u, v: np.cos(2.0 * np.pi * u / 5.0),
    "sparkle": lambda u, v: np.where(_noise(u.shape, (3, 3), 4) > 2.6, 2.4, -0.12),
    "ribbon": lambda u, v: np.where(np.mod(v, 16.0) < 8.0, 0.7, -0.7),
    "mesh": lambda u, v: 0.6 * np.cos(2.0 * np.pi * u / 4.0) * np.cos(2.0 * np.pi * v / 4.0) - 0.2,
    "pin-dots": lambda u, v: np.where(np.hypot(np.mod(u, 7.0) - 3.5, np.mod(v, 7.0) - 3.5) < 1.2, 0.95, -0.25),
}


@dataclass(frozen=True)
class Source:
    """A sort of light: ranges that a lamp is drawn from, and what all its lamps have."""

    ranges: tuple[tuple[float, float], ...]
    """Azimuth, elevation [degree] and power over the nominal power."""
    diameter: float = 0.5
    """Of the lamp [m], which is 1.2 m from the cloth."""
    surround: float = 0.012
    """Radiance from all around, of which cameras see none: a studio has black curtains."""


_SOURCES = {
    "drawn": Source(((-75.0, 15.0), (42.0, 62.0), (0.8, 1.25))),
    "held-out": Source(((25.0, 80.0), (25.0, 40.0), (0.6, 0.8))),  # what no training light has
    "room": Source(((-75.0, 15.0), (55.0, 80.0), (0.5, 0.8)), diameter=1.6, surround=0.45),
    "window": Source(((-160.0, -115.0), (20.0, 34.0), (0.9, 1.3)), diameter=1.2, surround=0.12),
}
LIGHTS = tuple(_SOURCES)
"""Names of the ranges that lights are drawn from."""


@dataclass(frozen=True)
class Light:
    """The lamp of one clip; it follows the cloth, which is then lit alike everywhere [thesis, 4.2.3]."""

    azimuth: float
    """Seen from the cloth, from +x towards +y [degree]."""
    elevation: float
    """Above the floor [degree]."""
    power: float
    """Over the nominal power."""
    source: Source

    @property
    def numbers(self) -> list[float]:
        """The numbers of the label: azimuth, elevation, power."""
        return [self.azimuth, self.elevation, self.power]


def drawn_light(name: str, seed: int, custom: LampNumbers | None = None) -> Light:
    """Draw a lamp from a named range, or from custom ones in a studio."""
    if custom is not None:
        source = Source((custom.azimuth, custom.elevation, custom.power))
    elif name in _SOURCES:
        source = _SOURCES[name]
    else:
        raise ValueError(f"light must be one of {', '.join(LIGHTS)}; got {name!r}")
    uniform = np.random.Generator(np.random.PCG64(seed)).uniform
    azimuth, elevation, power = (float(uniform(low, high)) for low, high in source.ranges)
    return Light(azimuth, elevation, power, source)
