"""Substrates: floor finishes, drawn from a seed within the ranges of substrates.toml."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

if TYPE_CHECKING:
    from stickslip_schemas.spec.appearance import FloorNumbers

GRAIN_SIZE = 512  # side of the picture of a floor's grain [texels]
GRAIN_EXTENT = 0.5  # what the picture covers; it repeats [m]
_SUBSAMPLES = 3
HARD = ("aluminium", "aluminium-pet", "ceramic", "rough-glass", "smooth-glass", "polyester-mirror", "stainless-steel")
"""The substrates of the thesis, 4.2.2."""


@dataclass(frozen=True)
class Substrate:
    """One floor. Cycles renders it grey and plain; `floor_factor` adds its marks and colour."""

    name: str
    albedo: float
    """Share of the light that it scatters or, as a metal, reflects."""
    roughness: float
    """Of its gloss."""
    metallic: float
    """1 for a metal."""
    specular: float
    """Strength of a dielectric's gloss, 0.5 for an index of refraction of 1.5."""
    grain: float
    """Contrast of its marks; motion over a floor without marks is hard to see."""
    seed: int
    """Of the marks."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of its colour, mean 1."""

    @property
    def mirrors(self) -> bool:
        """Whether it mirrors shapes; a rough floor that is no metal shows only the mean colour of the cloth."""
        return self.metallic > 0.5 or self.roughness < 0.25

    @property
    def numbers(self) -> list[float]:
        """The numbers of the label: albedo, roughness, metallic, specular, grain, tint."""
        return [self.albedo, self.roughness, self.metallic, self.specular, self.grain, *self.tint]


@cache
def finishes() -> dict[str, dict[str, Any]]:
    """Return the ranges of every finish, by its name."""
    text = files("stickslip_blender.cloth").joinpath("substrates.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def drawn_substrate(name: str, seed: int, custom: FloorNumbers | None = None) -> Substrate:
    """Draw a substrate of a finish (`any`: of a hard one or the matt plate), or of a custom one."""
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    finish = str(random.choice(["matt", *HARD])) if name == "any" else name
    ranges = finishes()[finish] if custom is None else custom.model_dump()
    color = np.array(ranges.get("tint", (1.0, 1.0, 1.0)))
    if finish == "cloth":
        color = 0.15 + 0.85 * random.random(3)
    r, g, b = (color / color.mean()).tolist()
    return Substrate(
        name=finish,
        albedo=float(random.uniform(*ranges["albedo"])),
        roughness=float(random.uniform(*ranges["roughness"])),
        metallic=ranges["metallic"],
        specular=ranges["specular"],
        grain=ranges["grain"],
        seed=int(random.integers(2**31)),
        tint=(r, g, b),
    )


def floor_factor(substrate: Substrate, camera: Camera, height: float) -> npt.NDArray[np.float32]:
    """Return what the floor's marks and colour do to its light in each pixel, shape (height, width, 3).

    Marks and colour lie on top: a factor of all the light that the floor sends back. The floor is at a height [m].
    """
    step = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES - 0.5
    rows, columns = ((np.arange(size)[:, None] + step).ravel() for size in (camera.height, camera.width))
    across, down = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    ray = np.stack([across, down, np.ones_like(down)], axis=-1) @ np.asarray(camera.rotation)
    reach = (height - camera.position[2]) / np.minimum(ray[..., 2:], -1e-3)
    place = (camera.position[:2] + reach * ray[..., :2]) * (GRAIN_SIZE / GRAIN_EXTENT)
    low = np.floor(place).astype(int)
    (right, lower), marks = np.moveaxis(place - low, -1, 0), _marks(substrate)
    (i, j), (k, m) = (np.moveaxis(corner % GRAIN_SIZE, -1, 0) for corner in (low, low + 1))
    upper_row = marks[j, i] + right * (marks[j, k] - marks[j, i])
    lower_row = marks[m, i] + right * (marks[m, k] - marks[m, i])
    samples = upper_row + lower * (lower_row - upper_row)
    factor = samples.reshape(camera.height, _SUBSAMPLES, camera.width, _SUBSAMPLES).mean(axis=(1, 3))
    return np.asarray(factor[..., None] * substrate.tint, dtype=np.float32)


def _marks(substrate: Substrate) -> npt.NDArray[np.float64]:
    """Return the factor of a square of the floor that repeats, shape (GRAIN_SIZE, GRAIN_SIZE)."""
    random = np.random.Generator(np.random.PCG64(substrate.seed))
    if substrate.name == "cloth":  # a plain weave, drawn four times too coarse to be seen at all
        thread = np.arange(GRAIN_SIZE) // 4
        over = (thread[:, None] + thread[None, :]) % 2
        marks = np.where(over == 1, 0.5, -0.5) + 0.5 * _spots(random, 4.0)
    else:
        marks = 0.5 * _spots(random, 10.0) + 0.5 * _spots(random, 30.0)  # finer ones would be noise far away
    return np.asarray(np.clip(1.0 + substrate.grain * marks, 0.2, 1.8))


def _spots(random: np.random.Generator, extent: float) -> npt.NDArray[np.float64]:
    """Return smooth noise of unit deviation that repeats; `extent` of its spots [texels]."""
    down, along = np.fft.fftfreq(GRAIN_SIZE)[:, None], np.fft.rfftfreq(GRAIN_SIZE)
    decay = np.exp(-2.0 * (np.pi * extent) ** 2 * (down**2 + along**2))
    spectrum = np.fft.rfft2(random.standard_normal((GRAIN_SIZE, GRAIN_SIZE)))
    noise = np.fft.irfft2(spectrum * decay, (GRAIN_SIZE, GRAIN_SIZE))
    return np.asarray(noise / noise.std())
