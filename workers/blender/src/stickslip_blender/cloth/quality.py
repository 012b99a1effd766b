"""The quality of a clip: its squared error against direct renderings, without their noise.

At seeded instants, Cycles renders the cloth directly, with several seeds and no denoiser. At a
pixel, let P be the clip's linear light, X and Y the light of two renderings, and f the sRGB
encoding in 8-bit levels. The noises of X and Y are independent, so that in

    e = f'(P)^2 (P - X) (P - Y)
    E[e] = f'(P)^2 (P - T)^2, near (f(P) - f(T))^2, T: the exact light

the noise of the references cancels, for any number of samples. The code takes the mean of e over
all pairs of renderings. Landed cloth in a penumbra has paths that rarely meet the lamp, so it gets
more renderings.

Frames with cloth in the shade have the largest errors, because a level is little light there.
Frames with light from other cloth have large errors too. The draw of instants may miss such frames.
So each pixel has a weight, 1 / sqrt(L) + BOUNCED B^2 / L. Here L is the light on the cloth, and B
is the light that an albedo of 0.25 elsewhere adds to it. The mean squared error is the sum of e
over the sum of the weights, times the mean weight over all frames. Blocks of pixels, and instants,
give the deviation.

One rendering serves three textures: the red, green and blue of its print are the greens of the
three textures. The groups of three are fixed, so a clip gets the same numbers alone or with others.
A custom picture is measured alone.
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

PATHS = 2
"""Paths per pixel of a shading in a direct rendering of a large window.

The rendering skips as many paths before them, because Cycles sends the first path through the
middle of the pixel.
"""
WHOLE = 3
"""Number of direct renderings of all cloth in a measured frame."""
OF_LANDED = 3
"""Number of direct renderings of the landed cloth.

Landed cloth covers about half of the area of all cloth.
"""
_FIXED_PATHS = 22  # cost of a frame of a shading beside its paths [paths per pixel of its window]
_SET_UP_PATHS = 1  # cost of a rendering beside its paths [paths per pixel of its window]
_GROUP_SIZE = 3  # textures that are measured together: one in each colour channel
LANDED = 0.04  # height above the floor up to which cloth counts as landed [m]
BAND = 2  # half the width of the band along the silhouette [px]
LEAST_FRAMES = 4
"""Frames of a clip that are measured at least, or all of a shorter clip.

The squared errors of frames differ by 60 %, and those of a short clip, which shows far apart
instants, by more: one of three frames was up to 5 dB off the clip."""
FEWEST = 30  # least pixels of a region, over all measured instants, for a PSNR
DEVIATIONS = 2.0  # standard deviations below a floor that count as chance
_SPREAD = 0.6  # usual deviation of the errors of instants over their mean
_TRUST = 4  # number of instants that the usual deviation counts as
DARK = 0.003  # light on the cloth below which errors do not grow
BOUNCED = 40.0  # fitted: the composition errs in much light from other cloth
# Side of the blocks whose sums give the spread [px]. The errors of a denoised picture reach over
# some pixels.
_BLOCK = 8

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """PSNR of a clip by region, in the order of `REGIONS`, and their deviations [dB].

    A region has NaN if the measured frames show too little of it.
    """

    psnr: tuple[float, ...]
    deviations: tuple[float, ...]

    def shortfall(self, floors: Sequence[float]) -> str:
        """Return the regions that are below their floors [dB] by more than chance.

        The text is empty if no region is.
        """
        numbers = zip(REGIONS, self.psnr, self.deviations, floors, strict=True)
        return "; ".join(
            f"psnr_{name} must be at least {floor:g} dB; got {psnr:.1f} dB (deviation "
            f"{deviation:.1f} dB)"
            for name, psnr, deviation, floor in numbers
            if psnr + DEVIATIONS * deviation < floor
        )

    @property
    def labels(self) -> dict[str, object]:
        """The labels of a sample, with None for a region without a measurement."""
        labels: dict[str, object] = {
            f"psnr_{name}": _number_or_none(psnr)
            for name, psnr in zip(REGIONS, self.psnr, strict=True)
        }
        labels["psnr_deviation"] = [_number_or_none(deviation) for deviation in self.deviations]
        return labels


def _number_or_none(value: float) -> float | None:
    return None if np.isnan(value) else value


UNMEASURED = Measured((np.nan,) * 3, (np.nan,) * 3)


def measured_group(texture: str) -> tuple[str, ...]:
    """Return the group of textures that are measured together with a texture."""
    names = [str(name) for name in Texture]
    if texture not in names:
        return (texture,)
    first = names.index(texture) // _GROUP_SIZE * _GROUP_SIZE
    return tuple(names[first : first + _GROUP_SIZE])


def instants(
    frames: int, share: float, paths: int, reference_paths: int, seed: Sequence[int]
) -> list[int]:
    """Draw the frames to measure, each from an equal part of the clip.

    Measuring three groups of textures costs about `share` of the cost of their shading, and more of
    a clip of which only `LEAST_FRAMES` are measured. A shading has `paths` paths in each part of a
    pixel, and a direct rendering has `reference_paths`.
    """
    # Cost of measuring a frame for three groups, over the cost of its shading.
    reference_cost = (
        _GROUP_SIZE * (WHOLE + 0.5 * OF_LANDED) * (reference_paths * FINE**2 + _SET_UP_PATHS)
    )
    shading_cost = FINE**2 * paths + _FIXED_PATHS
    cost = reference_cost / shading_cost
    count = min(max(LEAST_FRAMES, round(share * frames / cost)), frames)

    # Draw one frame in each of `count` equal parts. The draws cover the whole clip, and no instant
    # is fixed.
    draws = np.random.Generator(np.random.PCG64(seed)).random(count)
    return [int((k + draw) / count * frames) for k, draw in enumerate(draws)]


def landed_top(geometry: Geometry) -> float:
    """Return the height below which cloth counts as landed [m]."""
    floor = geometry.surroundings.floor
    return -np.inf if floor is None else floor + LANDED


def regions(geometry: Geometry, points: Floats, camera: Camera) -> npt.NDArray[np.bool_]:
    """Return the cloth, landed cloth, and the band along its edge, (3, height, width)."""
    visible = see(
        projected(camera, points),
        geometry.triangles,
        Window(0, 0, camera.width, camera.height),
        grid=1,
    )
    # The triangles of the cloth come first. A prop in front of the cloth takes its pixels.
    cloth = (visible.triangle >= 0) & (visible.triangle < geometry.cloth_triangles)
    low = visible.at_centers(points[:, 2:])[..., 0] < landed_top(geometry)
    return np.stack([cloth, cloth & low, _grown(cloth, BAND) & _grown(~cloth, BAND)])


def _grown(mask: npt.NDArray[np.bool_], by: int) -> npt.NDArray[np.bool_]:
    for _ in range(by):
        padded = np.pad(mask, 1)
        mask = mask | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
    return mask


def errors(picture: npt.NDArray[np.uint8], references: npt.NDArray[Any], channel: int) -> Floats:
    """Return the squared error of a picture's green against a channel of linear light.

    The light has the shape (renderings, height, width, 3). The error is in squared 8-bit levels.
    Pixels that no pair of renderings shows have 0.
    """
    levels = picture[..., 1]
    channel_light = references[..., channel]
    light = decoded(levels).astype(np.float64)

    # The slope of the sRGB curve turns differences of light into differences of levels.
    slope = 255.0 * np.where(
        light <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(light, 0.0031308) ** (1.0 / 2.4 - 1.0)
    )
    top = np.where(levels == 255, 1.0, np.inf)  # brighter light has no other level
    renderings = np.isfinite(channel_light).sum(axis=0)
    difference = np.nan_to_num(light - np.minimum(channel_light, top))

    # Sum the products over all pairs of different renderings: the square of the sum less the
    # squares. The product of a rendering with itself would contain the square of its noise.
    products = difference.sum(axis=0) ** 2 - (difference**2).sum(axis=0)
    return np.asarray(slope**2 * products / np.maximum(renderings * (renderings - 1), 1))


def pool_errors(
    frames: Sequence[tuple[Floats, npt.NDArray[Any]]],
    mean_weights: Sequence[float] = (1.0,) * 3,
    frame_count: float = np.inf,
) -> Measured:
    """Return the PSNR of a clip by region, from the errors and weights of its measured frames.

    Errors are (height, width), in squared 8-bit levels. Weights are (3, height, width), and 0
    outside of a region. `mean_weights` are the means of the weights over the regions in all frames
    of the clip, and `frame_count` is their number.
    """
    # Of a clip whose frames are all measured, none has another error (finite population).
    unmeasured = 1.0 - len(frames) / frame_count
    psnr: list[float] = []
    deviations: list[float] = []
    for region, mean_weight in zip(range(len(REGIONS)), mean_weights, strict=True):
        region_frames = [(error, weights[region]) for error, weights in frames]
        level, deviation = _pool_region(region_frames, mean_weight, unmeasured)
        psnr.append(level)
        deviations.append(deviation)
    return Measured(tuple(psnr), tuple(deviations))


def _pool_region(
    frames: Sequence[tuple[Floats, npt.NDArray[Any]]], mean_weight: float, unmeasured: float
) -> tuple[float, float]:
    """Return the PSNR of one region and its standard deviation [dB].

    `unmeasured` is the share of the frames that were not measured. Both are NaN if the region is
    too small.
    """
    if sum(np.count_nonzero(weights) for _, weights in frames) < FEWEST:
        return np.nan, np.nan

    # Errors grow in proportion to the weights, so their ratio estimates the error per weight.
    block_errors = np.concatenate(
        [_block_sums(np.where(weights > 0, error, 0.0)) for error, weights in frames]
    )
    block_weights = np.concatenate(
        [_block_sums(weights.astype(np.float64)) for _, weights in frames]
    )
    total_weight = block_weights.sum()
    ratio = block_errors.sum() / total_weight

    # Errors of neighbouring pixels depend on each other, but errors of blocks do not. The residuals
    # of the blocks give the deviation of the ratio within the measured frames.
    residuals = block_errors - ratio * block_weights
    within = float(np.sqrt((residuals**2).sum())) / total_weight
    bounded = max(ratio, within)  # chance can make the mean of products negative

    # Other frames would have other errors. A few frames show little of that spread, so the usual
    # spread counts as _TRUST more frames.
    frame_residuals = np.array(
        [np.sum(np.where(weights > 0, error - bounded * weights, 0.0)) for error, weights in frames]
    )
    count = len(frames)
    spread_squares = np.sum((frame_residuals * count / total_weight / bounded) ** 2)
    between = (spread_squares + _TRUST * _SPREAD**2) / (count - 1 + _TRUST) / count

    # Convert the relative deviation of the squared error to decibels.
    deviation = float(np.sqrt((within / bounded) ** 2 + unmeasured * between))
    psnr = float(10.0 * np.log10(255.0**2 / (bounded * mean_weight)))
    return psnr, 10.0 / np.log(10.0) * deviation


def _block_sums(values: Floats) -> Floats:
    height, width = (-(-size // _BLOCK) for size in values.shape)
    padded = np.zeros((height * _BLOCK, width * _BLOCK))
    padded[: values.shape[0], : values.shape[1]] = values
    return np.asarray(padded.reshape(height, _BLOCK, width, _BLOCK).sum(axis=(1, 3)).ravel())
