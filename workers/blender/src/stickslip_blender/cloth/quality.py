"""How good a clip is: its squared error against direct renderings of its own, without their noise.

At seeded instants, Cycles renders the cloth directly, with several seeds and no denoiser. At a
pixel, let P be the clip's linear light, X and Y that of two renderings, and f the sRGB encoding in
8-bit levels. The noises of X and Y are independent, so that in

    e = f'(P)^2 (P - X) (P - Y)
    E[e] = f'(P)^2 (P - T)^2, near (f(P) - f(T))^2, T: the exact light

nothing of the noise of the references is left, however few samples they have; e is the mean over
all pairs. Landed cloth in a penumbra has paths that rarely meet the lamp, and more renderings.
Frames with cloth in the shade, where a level is little light, or lit by other cloth, are worst, and
may be missed. So the sum of e over that of weights, 1 / sqrt(L) + BOUNCED B^2 / L, times the mean
of these over all frames, is the mean squared error; L: light on the cloth, B: what an albedo of
0.25 elsewhere adds to it. Blocks of pixels, and instants, tell the deviation.

One rendering serves three textures: red, green and blue of its print are the green of the three.
Trios are fixed: a clip gets the same numbers alone or with others. A user's picture is measured by
itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.arrays import REGIONS
from stickslip_schemas.spec.cameras import Camera
from stickslip_schemas.spec.names import Texture

from stickslip_blender.cloth.geometry import Geometry
from stickslip_blender.cloth.shading import FINE
from stickslip_blender.raster import Window, decoded, projected, see

# per pixel of a shading of a direct rendering, after as many: the first is through the middle of
# the pixel
PATHS = 2
WHOLE, OF_LANDED = (
    3,
    3,
)  # direct renderings of all cloth, and of its landed part, usually half of it in area
_FIXED, _SET_UP = (
    22,
    1,
)  # what else a frame of a shading costs, and a rendering [paths per pixel of its window]
_TRIO = 3  # textures that are measured together; eight make as many
LANDED = 0.04  # height above the floor up to which cloth counts as landed [m]
BAND = 2  # half the width of the band along the silhouette [px]
FEWEST = 30  # pixels of a region, over all measured instants, below which nothing is said of it
DEVIATIONS = 2.0  # standard deviations below a floor that are taken for chance
_SPREAD = 0.6  # deviation of the errors of instants over their mean, before a clip's own are known
_TRUST = 4  # instants that it counts for
DARK = 0.003  # light on the cloth below which errors do not grow
BOUNCED = 40.0  # fitted: the composition errs where much light comes from other cloth
# side of the blocks whose sums give the spread [px]: errors of a denoised picture reach some pixels
_BLOCK = 8

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """PSNR of a clip by region, in the order of `REGIONS`, and their deviations [dB].

    NaN where none is in sight.
    """

    psnr: tuple[float, ...]
    deviations: tuple[float, ...]

    def shortfall(self, floors: Sequence[float]) -> str:
        """Say which regions are below their floors [dB] by more than chance; nothing if none is."""
        numbers = zip(REGIONS, self.psnr, self.deviations, floors, strict=True)
        return "; ".join(
            f"psnr_{name} must be at least {floor:g} dB; got {psnr:.1f} dB (deviation "
            f"{deviation:.1f} dB)"
            for name, psnr, deviation, floor in numbers
            if psnr + DEVIATIONS * deviation < floor
        )

    @property
    def labels(self) -> dict[str, object]:
        psnr, deviations = (
            [None if np.isnan(x) else x for x in values] for values in (self.psnr, self.deviations)
        )
        return {f"psnr_{name}": x for name, x in zip(REGIONS, psnr, strict=True)} | {
            "psnr_deviation": deviations
        }


UNMEASURED = Measured((np.nan,) * 3, (np.nan,) * 3)


def trio(texture: str) -> tuple[str, ...]:
    """Return the textures that are measured together with one."""
    names = [str(name) for name in Texture]
    if texture not in names:
        return (texture,)
    first = names.index(texture) // _TRIO * _TRIO
    return tuple(names[first : first + _TRIO])


def instants(frames: int, share: float, paths: int, seed: Sequence[int]) -> list[int]:
    """Draw the frames that are measured, each from an equal part of the clip.

    At least one frame is measured.

    To measure eight textures costs a share of their shading, which has so many paths in each part
    of a pixel.
    """
    cost = (
        _TRIO * (WHOLE + 0.5 * OF_LANDED) * (PATHS * FINE**2 + _SET_UP) / (FINE**2 * paths + _FIXED)
    )
    count = min(max(1, round(share * frames / cost)), frames)
    draws = np.random.Generator(np.random.PCG64(seed)).random(count)
    return [int((k + draw) / count * frames) for k, draw in enumerate(draws)]


def landed_top(geometry: Geometry) -> float:
    """Return the height below which cloth counts as landed [m]."""
    floor = geometry.surroundings.floor
    return -np.inf if floor is None else floor + LANDED


def regions(geometry: Geometry, points: Floats, camera: Camera) -> npt.NDArray[np.bool_]:
    """Return the cloth, landed cloth, and the band along its edge, (3, height, width)."""
    seen = see(
        projected(camera, points),
        geometry.triangles,
        Window(0, 0, camera.width, camera.height),
        grid=1,
    )
    cloth = (seen.triangle >= 0) & (seen.triangle < geometry.cloth_triangles)
    low = seen.at_centers(points[:, 2:])[..., 0] < landed_top(geometry)
    return np.stack([cloth, cloth & low, _grown(cloth, BAND) & _grown(~cloth, BAND)])


def _grown(mask: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    for _ in range(by):
        padded = np.pad(mask, 1)
        mask = mask | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
    return mask


def errors(picture: npt.NDArray[np.uint8], references: npt.NDArray[Any], channel: int) -> Floats:
    """Return a picture's green minus a channel of linear light; NaN if not visible.

    The light is (renderings, height, width, 3).
    """
    levels = picture[..., 1]
    others = references[..., channel]
    light = decoded(levels).astype(np.float64)
    slope = 255.0 * np.where(
        light <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(light, 0.0031308) ** (1.0 / 2.4 - 1.0)
    )
    top = np.where(levels == 255, 1.0, np.inf)  # brighter light has no other level
    known = np.isfinite(others).sum(axis=0)
    off = np.nan_to_num(light - np.minimum(others, top))
    pairs = off.sum(axis=0) ** 2 - (off**2).sum(axis=0)
    return np.asarray(slope**2 * pairs / np.maximum(known * (known - 1), 1))


def pooled(
    measured: Sequence[tuple[Floats, npt.NDArray[Any]]], usual: Sequence[float] = (1.0,) * 3
) -> Measured:
    """Return the PSNR from errors (height, width) of instants and weights by region.

    Weights are (3, height, width), and 0 outside of a region.

    `usual`: means of weights over the regions in all frames.
    """
    # Each region has weights of its own: all cloth, landed cloth, and the edge.
    values = []
    for region in range(len(REGIONS)):
        of_region = [(error, weights[region]) for error, weights in measured]
        values.append(_pooled(of_region, usual[region]))
    return Measured(*zip(*values, strict=True))


def _pooled(
    measured: Sequence[tuple[Floats, npt.NDArray[Any]]], usual: float
) -> tuple[float, float]:
    sums = np.concatenate(
        [_blocks(np.where(weights > 0, error, 0.0)) for error, weights in measured]
    )
    sizes = np.concatenate([_blocks(weights.astype(np.float64)) for _, weights in measured])
    if sum(np.count_nonzero(weights) for _, weights in measured) < FEWEST:
        return np.nan, np.nan
    mean = sums.sum() / (size := sizes.sum())
    spread = float(np.sqrt(((sums - mean * sizes) ** 2).sum())) / size
    bounded = max(mean, spread)  # chance can make the mean of products negative
    count = len(measured)
    parts = np.array(
        [
            np.sum(np.where(weights > 0, error - bounded * weights, 0.0))
            for error, weights in measured
        ]
    )
    between = (
        (np.sum((parts * count / size / bounded) ** 2) + _TRUST * _SPREAD**2)
        / (count - 1 + _TRUST)
        / count
    )
    deviation = float(np.sqrt((spread / bounded) ** 2 + between))
    return float(10.0 * np.log10(255.0**2 / (bounded * usual))), 10.0 / np.log(10.0) * deviation


def _blocks(values: Floats) -> Floats:
    height, width = (-(-size // _BLOCK) for size in values.shape)
    padded = np.zeros((height * _BLOCK, width * _BLOCK))
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(height, _BLOCK, width, _BLOCK).sum(axis=(1, 3)).ravel())
