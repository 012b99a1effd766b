"""The cloth textures, drawn by formula: a square of cloth in a flat view.

Periods are at least a centimetre on a cloth of 20 cm. At 224 x 224, a thread would be noise, but a
pattern is visible.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import numpy.typing as npt
from PIL import Image
from stickslip_schemas.format.pictures import read_picture
from stickslip_schemas.spec.names import Texture

SIZE = 512
"""Side of a texture [texels].

A texel is 0.4 mm on the cloth, a seventh of a pixel.
"""
_OVERSAMPLING = 2

Field = npt.NDArray[np.float64]
Rgb = tuple[int, int, int]  # sRGB


@cache
def texture_image(texture: Texture) -> npt.NDArray[np.uint8]:
    """Return the picture of a texture, 8-bit sRGB, shape (SIZE, SIZE, 3).

    Row 0 is the lower edge of the cloth.
    """
    fine = SIZE * _OVERSAMPLING
    across = (np.arange(fine) + 0.5) / fine
    u, v = np.meshgrid(across, across)
    picture = _DRAWN_BY[texture](u, v)
    boxes = picture.reshape(SIZE, _OVERSAMPLING, SIZE, _OVERSAMPLING, 3)
    mean: npt.NDArray[np.uint8] = np.rint(boxes.mean(axis=(1, 3))).astype(np.uint8)
    mean.flags.writeable = False  # the cache returns the same array again
    return mean


def custom_texture(data: bytes) -> npt.NDArray[np.uint8]:
    """Return the picture in a file of a user, as `texture_image` does.

    The upper edge of the picture is the held edge of the cloth.

    Raises:
        UnfitPictureError: The file is not a picture that can be printed on a cloth.
    """
    picture = Image.fromarray(np.flipud(read_picture(data))).resize(
        (SIZE, SIZE), Image.Resampling.BILINEAR
    )
    return np.asarray(picture, dtype=np.uint8)


def _mix(where: npt.NDArray[np.bool_] | Field, there: Rgb | Field, elsewhere: Rgb | Field) -> Field:
    share = np.asarray(where, dtype=np.float64)[..., None]
    return share * np.asarray(there, dtype=np.float64) + (1.0 - share) * np.asarray(
        elsewhere, dtype=np.float64
    )


def _phase(x: Field, count: float) -> Field:
    """Return the position of a point in its period, [0, 1), with `count` periods on the cloth."""
    return np.asarray(np.mod(x * count, 1.0))


def _dots(u: Field, v: Field) -> Field:
    odd = np.mod(np.floor(v * 8), 2) == 1
    x = _phase(u + np.where(odd, 1 / 16, 0.0), 8) - 0.5
    y = _phase(v, 8) - 0.5
    return _mix(np.hypot(x, y) < 0.3, (240, 234, 220), (38, 62, 122))


def _plaid(u: Field, v: Field) -> Field:
    """Draw a tartan.

    The warp and the weft have the same sett, and each gives half of the colour.
    """

    def threads(x: Field) -> Field:
        place = _phase(x, 3)
        sett = _mix(np.abs(place - 0.5) < 0.17, (24, 46, 96), (30, 92, 62))
        sett = _mix((np.abs(place - 0.5) > 0.19) & (np.abs(place - 0.5) < 0.24), (16, 20, 28), sett)
        sett = _mix(np.abs(place - 0.5) < 0.035, (226, 182, 58), sett)
        return _mix(np.minimum(place, 1.0 - place) < 0.045, (198, 40, 40), sett)

    return 0.5 * (threads(u) + threads(v))


def _herringbone(u: Field, v: Field) -> Field:
    """Draw a twill that turns, and breaks, at every column."""
    place = _phase(u, 8)
    odd = np.mod(np.floor(u * 8), 2) == 1
    twill = np.where(odd, v + place / 8, v - place / 8 + 1 / 20)
    return _mix(_phase(twill, 10) < 0.5, (92, 64, 46), (214, 190, 156))


def _houndstooth(u: Field, v: Field) -> Field:
    """Weave four dark and four light threads, over two and under two."""
    warp = np.floor(u * 48)
    weft = np.floor(v * 48)
    warp_on_top = np.mod(warp + weft, 4) < 2
    return _mix(
        np.where(warp_on_top, np.mod(warp, 8) < 4, np.mod(weft, 8) < 4),
        (28, 28, 32),
        (236, 232, 224),
    )


def _floral(u: Field, v: Field) -> Field:
    """Strew five-petalled flowers of three colours and leaves over cream, seeded.

    The pattern repeats at the edges.
    """
    picture = np.broadcast_to(np.asarray((240, 230, 208), dtype=np.float64), (*u.shape, 3))
    random = np.random.Generator(np.random.PCG64(7))
    petals: tuple[Rgb, ...] = ((200, 52, 76), (232, 140, 60), (110, 78, 168))
    rows = 5
    for place in range(rows * rows):
        row, column = divmod(place, rows)
        x = (column + 0.5 * (row % 2) + 0.5 + random.uniform(-0.1, 0.1)) / rows
        y = (row + 0.5 + random.uniform(-0.1, 0.1)) / rows
        du = np.mod(u - x + 0.5, 1.0) - 0.5
        dv = np.mod(v - y + 0.5, 1.0) - 0.5
        radius = np.hypot(du, dv)
        angle = np.arctan2(dv, du) + random.uniform(0.0, 2.0 * np.pi)
        size = random.uniform(0.068, 0.088)
        leaf = size * 1.45 * np.maximum(np.cos(1.5 * angle), 0.0) ** 3
        petal = size * (0.62 + 0.38 * np.abs(np.cos(2.5 * angle)))
        picture = _mix(radius < leaf, (66, 116, 66), picture)
        picture = _mix(radius < petal, petals[place % 3], picture)
        picture = _mix(radius < 0.3 * size, (250, 206, 84), picture)
    return picture


def _argyle(u: Field, v: Field) -> Field:
    """Draw diamonds of two colours, and fine lines across them."""
    x = np.abs(_phase(u, 4) - 0.5)
    y = np.abs(_phase(v, 3) - 0.5)
    column = np.mod(np.floor(u * 4), 2) == 1
    diamond = _mix(column, (152, 60, 70), (40, 70, 80))
    picture = _mix(x + y < 0.5, diamond, (222, 214, 196))
    rising = np.abs(_phase(u * 4 - v * 3, 1) - 0.5)
    falling = np.abs(_phase(u * 4 + v * 3, 1) - 0.5)
    return _mix(np.minimum(falling, rising) < 0.03, (250, 248, 240), picture)


def _camouflage(u: Field, v: Field) -> Field:
    """Draw seeded blots of three colours in places with high sums of waves.

    The pattern repeats at the edges.
    """
    random = np.random.Generator(np.random.PCG64(11))
    picture = np.broadcast_to(np.asarray((108, 112, 76), dtype=np.float64), (*u.shape, 3))
    for color in ((58, 64, 44), (150, 136, 96), (34, 34, 30)):
        height = np.zeros_like(u)
        for _ in range(14):
            across, down = random.integers(-5, 6, 2)
            height += np.cos(2.0 * np.pi * (across * u + down * v + random.random()))
        picture = _mix(height > 2.6, color, picture)
    return picture


def _terrazzo(u: Field, v: Field) -> Field:
    """Strew chips of five colours over off-white, seeded.

    The pattern repeats at the edges.
    """
    picture = np.broadcast_to(np.asarray((226, 222, 214), dtype=np.float64), (*u.shape, 3))
    random = np.random.Generator(np.random.PCG64(13))
    chips: tuple[Rgb, ...] = (
        (188, 92, 70),
        (70, 104, 110),
        (222, 172, 96),
        (54, 56, 62),
        (150, 160, 130),
    )
    for number in range(90):
        x = random.random()
        y = random.random()
        turn = random.uniform(0.0, np.pi)
        size = random.uniform(0.02, 0.05)
        du = np.mod(u - x + 0.5, 1.0) - 0.5
        dv = np.mod(v - y + 0.5, 1.0) - 0.5
        along = du * np.cos(turn) + dv * np.sin(turn)
        across = dv * np.cos(turn) - du * np.sin(turn)
        chip = np.abs(along) + 1.8 * np.abs(across + 0.3 * along) < size
        picture = _mix(chip, chips[number % len(chips)], picture)
    return picture


_DRAWN_BY: dict[Texture, Callable[[Field, Field], Field]] = {
    Texture.checker: lambda u, v: _mix(
        (_phase(u, 4) < 0.5) == (_phase(v, 4) < 0.5), (34, 37, 46), (236, 230, 214)
    ),
    Texture.dots: _dots,
    Texture.stripes: lambda u, _: _mix(_phase(u, 8) < 0.5, (176, 38, 44), (238, 230, 216)),
    Texture.plaid: _plaid,
    Texture.gingham: lambda u, v: _mix(
        0.5 * ((_phase(u, 6) < 0.5).astype(float) + (_phase(v, 6) < 0.5)),
        (46, 104, 176),
        (244, 242, 236),
    ),
    Texture.herringbone: _herringbone,
    Texture.houndstooth: _houndstooth,
    Texture.floral: _floral,
    Texture.argyle: _argyle,
    Texture.camouflage: _camouflage,
    Texture.chevron: lambda u, v: _mix(
        _phase(v + np.abs(_phase(u, 5) - 0.5) / 5, 7) < 0.5, (232, 188, 64), (62, 66, 74)
    ),
    Texture.terrazzo: _terrazzo,
}
