"""Looks of fabrics, lamps and floors. The lamps and floors are drawn from a seed.

A fabric has a shader, a hem and the grain of its material.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.surface import Surface
from stickslip_blender.cycles.pixels import encode
from stickslip_blender.raster import decoded

if TYPE_CHECKING:
    from stickslip_schemas.spec.names import FloorNumbers, LampNumbers

Field = npt.NDArray[np.float64]
Grain = Literal[
    "plain", "twill", "check", "melange", "rib", "sparkle", "ribbon", "target", "waves", "pin-dots"
]

WHITE = 0.85  # largest albedo: no fabric scatters more, and grain shows on a white print


@dataclass(frozen=True)
class FabricAppearance:
    """The look of one fabric."""

    roughness: float
    """Roughness of the gloss, from 0 to 1, in the scale of Blender's Principled shader."""
    specular: float
    """Strength of the gloss. The value 0.5 stands for an index of refraction of 1.5."""
    sheen: float
    """Weight of the fuzz that shines at grazing angles."""
    translucency: float
    """Share of the light that passes through, from 0 to 1."""
    hem: float
    """Half the thickness of the hem [mm]."""
    grain: Grain
    """Pattern of the weave or knit in the colour."""
    contrast: float
    """Contrast of the grain, as a share of the light that the fabric scatters.

    The value 0 means no grain.
    """


def _table(name: str) -> dict[str, Any]:
    return tomllib.loads(
        files("stickslip_blender.cloth").joinpath(name).read_text(encoding="utf-8")
    )


LOOKS = {
    material: FabricAppearance(**numbers) for material, numbers in _table("fabrics.toml").items()
}
PLAIN = FabricAppearance(
    roughness=0.85,
    specular=0.2,
    sheen=0.15,
    translucency=0.05,
    hem=0.6,
    grain="plain",
    contrast=0.1,
)
"""Look of a fabric that is not in fabrics.toml, for example a custom one."""


def fabric_appearance(material: str) -> FabricAppearance:
    """Return the look of a material, or `PLAIN` for a custom one."""
    return LOOKS.get(material, PLAIN)


def print_on_fabric(
    picture: npt.NDArray[np.uint8], look: FabricAppearance, surface: Surface
) -> npt.NDArray[np.uint8]:
    """Return a texture (size, size, 3), 8-bit sRGB, printed on a sheet.

    The sheet has the grain of its fabric. A rectangular sheet also has the stitches of a hem.

    Row 0 is the lower edge of the sheet. The picture covers the longer side. White has at most the
    albedo WHITE.
    """
    wide, high = (1e3 * side for side in surface.size)
    across = (np.arange(len(picture)) + 0.5) / len(picture) * max(wide, high)
    u, v = np.meshgrid(across, across)
    shade = 1.0 + look.contrast * _GRAINS[look.grain](u, v)
    if surface.is_rectangle:
        shade *= 1.0 - 0.55 * _stitches(u, v, wide, high)
    brightest = max(1.0, float(np.quantile(shade, 0.95)))  # sparkles are brighter, and saturate
    light = WHITE / brightest * decoded(picture) * shade[..., None]
    return encode(np.clip(light, 0.0, WHITE).astype(np.float32))


def _stitches(u: Field, v: Field, wide: float, high: float) -> Field:
    """Return 1 on the stitches of the hem at (u, v) [mm], and 0 elsewhere.

    Stitches are 4.5 mm from the edge and 3 mm long.
    """
    from_side = np.minimum(u, wide - u)
    from_end = np.minimum(v, high - v)
    seam = np.abs(np.minimum(from_side, from_end) - 4.5) < 0.45
    along = np.where(from_side < from_end, v, u)
    return (seam & (np.mod(along, 4.0) < 3.0)).astype(np.float64)


def _noise(shape: tuple[int, ...], blur: tuple[int, int], seed: int) -> Field:
    """Return smooth noise of unit deviation that wraps around.

    `blur` is its extent down and across [texels].
    """
    noise = np.random.Generator(np.random.PCG64(seed)).standard_normal(shape)
    for axis, extent in enumerate(blur):
        noise = sum((np.roll(noise, shift, axis) for shift in range(extent)), np.zeros(shape))
    return np.asarray((noise - noise.mean()) / noise.std())


# A grain maps places on the cloth [mm] to the departure of a factor from 1, about -1 to 1. A pixel
# of a clip of 224 x 224 covers 1.5 to 3 mm of cloth, so the threads are coarser than real ones. A
# period of at least 5 mm is visible. A finer one would give moire.
_GRAINS: dict[Grain, Callable[[Field, Field], Field]] = {
    "plain": lambda u, v: 0.5 * _noise(u.shape, (6, 6), 1),
    "twill": lambda u, v: (
        0.8 * np.sin(2.0 * np.pi * (u + v) / 9.0) + 0.2 * _noise(u.shape, (24, 6), 2)
    ),
    "check": lambda u, v: np.where(np.minimum(np.mod(u, 12.5), np.mod(v, 12.5)) < 3.0, -1.0, 0.3),
    "melange": lambda u, v: 0.6 * _noise(u.shape, (8, 40), 3),
    "rib": lambda u, v: np.cos(2.0 * np.pi * u / 7.0),
    "sparkle": lambda u, v: np.where(_noise(u.shape, (6, 6), 4) > 2.0, 2.0, -0.35),
    "ribbon": lambda u, v: np.where(np.mod(v, 20.0) < 10.0, 0.7, -0.7),
    "target": lambda u, v: np.cos(
        np.pi * np.hypot(np.mod(u, 50.0) - 25.0, np.mod(v, 50.0) - 25.0) / 5.0
    ),
    "waves": lambda u, v: np.sin(2.0 * np.pi * (u + 4.0 * np.sin(2.0 * np.pi * v / 40.0)) / 20.0),
    "pin-dots": lambda u, v: np.where(
        np.hypot(np.mod(u, 10.0) - 5.0, np.mod(v, 10.0) - 5.0) < 2.2, 0.95, -0.35
    ),
}


@dataclass(frozen=True)
class Source:
    """A sort of light: the ranges of its lamps, and the properties that all its lamps share."""

    ranges: tuple[tuple[float, float], ...]
    """Ranges of azimuth, elevation [degree] and power over the nominal power."""
    diameter: float = 3.0
    """Diameter of the lamp [m]. The lamp is 7.2 m from the cloth."""
    surround: float = 0.012
    """Radiance from all around. Cameras do not see it: a studio has black curtains."""


SOURCES = {
    "drawn": Source(((-75.0, 15.0), (42.0, 62.0), (0.8, 1.25))),
    "held-out": Source(((25.0, 80.0), (25.0, 40.0), (0.6, 0.8))),  # outside of all training lights
    "room": Source(((-75.0, 15.0), (55.0, 80.0), (0.5, 0.8)), diameter=9.6, surround=0.45),
    "window": Source(((-125.0, -95.0), (20.0, 34.0), (0.9, 1.3)), diameter=7.2, surround=0.12),
}


@dataclass(frozen=True)
class Light:
    """The lamp of one clip.

    It stands still. It is so far away that it lights the whole cloth evenly [thesis, 4.2.3].
    """

    azimuth: float
    """Azimuth from the middle of the cloth's way, from +x towards +y [degree]."""
    elevation: float
    """Angle above the floor [degree]."""
    power: float
    """Power over the nominal power."""
    source: Source

    @property
    def numbers(self) -> list[float]:
        """The numbers of the label: azimuth, elevation, power."""
        return [self.azimuth, self.elevation, self.power]


def drawn_light(name: str, seed: int, custom: LampNumbers | None = None) -> Light:
    """Draw a lamp from a named range, or from custom ranges in a studio."""
    source = Source((custom.azimuth, custom.elevation, custom.power)) if custom else SOURCES[name]
    uniform = np.random.Generator(np.random.PCG64(seed)).uniform
    azimuth, elevation, power = (float(uniform(low, high)) for low, high in source.ranges)
    return Light(azimuth, elevation, power, source)


GRAIN_SIZE = 512  # side of the picture of a floor's grain [texels]
GRAIN_EXTENT = 0.5  # side of the square that the picture covers [m]; the picture repeats
_SUBSAMPLES = 3
_FACTOR_PIXELS = 2**17  # pixels whose rays are traced at once: they take 200 MB of memory
HARD = (
    "aluminium",
    "aluminium-pet",
    "ceramic",
    "rough-glass",
    "smooth-glass",
    "polyester-mirror",
    "stainless-steel",
)
"""The substrates of the thesis, 4.2.2."""


@dataclass(frozen=True)
class Substrate:
    """One floor.

    Cycles renders it grey and plain. `floor_factor` adds its marks and colour.
    """

    name: str
    albedo: float
    """Share of the light that the floor scatters or, as a metal, reflects."""
    roughness: float
    """Roughness of the gloss."""
    metallic: float
    """1 for a metal."""
    specular: float
    """Strength of a dielectric's gloss. The value 0.5 stands for an index of refraction of 1.5."""
    grain: float
    """Contrast of the marks. Motion over a floor without marks is hard to see."""
    seed: int
    """Seed of the marks."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of the colour, with a mean of 1."""

    @property
    def mirrors(self) -> bool:
        """Whether the floor mirrors shapes.

        A rough floor that is not a metal shows only the mean colour of the cloth.
        """
        return self.metallic > 0.5 or self.roughness < 0.25

    @property
    def numbers(self) -> list[float]:
        """The numbers of the label: albedo, roughness, metallic, specular, grain, tint."""
        return [self.albedo, self.roughness, self.metallic, self.specular, self.grain, *self.tint]


FINISHES = _table("substrates.toml")
"""Ranges of every finish, by its name."""


def drawn_substrate(name: str, seed: int, custom: FloorNumbers | None = None) -> Substrate:
    """Draw a substrate of a named finish, or of a custom one.

    The name `any` stands for a hard finish or the matt plate, chosen at random.
    """
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    finish = str(random.choice(["matt", *HARD])) if name == "any" else name
    ranges = FINISHES[finish] if custom is None else custom.model_dump()
    color = np.array(ranges.get("tint", (1.0, 1.0, 1.0)))
    if finish == "cloth":
        color = 0.15 + 0.85 * random.random(3)
    r, g, b = (color / color.mean()).tolist()
    drawn = {number: float(random.uniform(*ranges[number])) for number in ("albedo", "roughness")}
    fixed = {number: ranges[number] for number in ("metallic", "specular", "grain")}
    return Substrate(
        name=finish, **drawn, **fixed, seed=int(random.integers(2**31)), tint=(r, g, b)
    )


def floor_factor(
    substrate: Substrate, camera: Camera, height: float | None
) -> npt.NDArray[np.float32]:
    """Return the factor of the floor's marks and colour on its light, (height, width, 3).

    The marks and the colour lie on top, so they scale all the light that the floor sends back. The
    floor is at a height [m]. If the height is None, the scene has no floor and the factor is 1.
    """
    if height is None:
        return np.ones((camera.height, camera.width, 3), dtype=np.float32)
    marks = _marks(substrate)
    rows_at_once = max(_FACTOR_PIXELS // camera.width, 1)
    bands = []
    for top in range(0, camera.height, rows_at_once):
        band = range(top, min(top + rows_at_once, camera.height))
        bands.append(_factor_of_rows(marks, camera, height, band))
    factor = np.concatenate(bands)
    return np.asarray(factor[..., None] * substrate.tint, dtype=np.float32)


def _factor_of_rows(
    marks: npt.NDArray[np.float64], camera: Camera, height: float, band: range
) -> npt.NDArray[np.float64]:
    """Return the factor of the marks in some rows of the frame, (rows, width)."""
    # Trace several rays through each pixel, because marks far away are finer than a pixel.
    step = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES - 0.5
    rows, columns = (
        (np.arange(pixels.start, pixels.stop)[:, None] + step).ravel()
        for pixels in (band, range(camera.width))
    )
    across, down = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    ray = np.stack([across, down, np.ones_like(down)], axis=-1) @ np.asarray(camera.rotation)
    # Follow each ray down to the floor. Rays that do not go down reach a point far away.
    reach = (height - camera.position[2]) / np.minimum(ray[..., 2:], -1e-3)
    place = (camera.position[:2] + reach * ray[..., :2]) * (GRAIN_SIZE / GRAIN_EXTENT)
    low = np.floor(place).astype(int)
    right, lower = np.moveaxis(place - low, -1, 0)

    # Marks repeat over the floor. Interpolate between the four marks around each sample.
    (i, j), (k, m) = (np.moveaxis(corner % GRAIN_SIZE, -1, 0) for corner in (low, low + 1))
    upper_row = marks[j, i] + right * (marks[j, k] - marks[j, i])
    lower_row = marks[m, i] + right * (marks[m, k] - marks[m, i])
    samples = upper_row + lower * (lower_row - upper_row)
    factor: npt.NDArray[np.float64] = samples.reshape(
        len(band), _SUBSAMPLES, camera.width, _SUBSAMPLES
    ).mean(axis=(1, 3))
    return factor


def _marks(substrate: Substrate) -> npt.NDArray[np.float64]:
    """Return the factor of a square of the floor that repeats, shape (GRAIN_SIZE, GRAIN_SIZE)."""
    random = np.random.Generator(np.random.PCG64(substrate.seed))
    if substrate.name == "cloth":  # a plain weave, four times too coarse, so that it is visible
        thread = np.arange(GRAIN_SIZE) // 4
        over = (thread[:, None] + thread[None, :]) % 2
        marks = np.where(over == 1, 0.5, -0.5) + 0.5 * _spots(random, 4.0)
    else:
        marks = 0.5 * _spots(random, 10.0) + 0.5 * _spots(
            random, 30.0
        )  # finer spots would be noise far away
    return np.asarray(np.clip(1.0 + substrate.grain * marks, 0.2, 1.8))


def _spots(random: np.random.Generator, extent: float) -> npt.NDArray[np.float64]:
    """Return smooth noise of unit deviation that repeats.

    `extent` is the size of its spots [texels].
    """
    down = np.fft.fftfreq(GRAIN_SIZE)[:, None]
    along = np.fft.rfftfreq(GRAIN_SIZE)
    decay = np.exp(-2.0 * (np.pi * extent) ** 2 * (down**2 + along**2))
    spectrum = np.fft.rfft2(random.standard_normal((GRAIN_SIZE, GRAIN_SIZE)))
    noise = np.fft.irfft2(spectrum * decay, (GRAIN_SIZE, GRAIN_SIZE))
    return np.asarray(noise / noise.std())
