"""Picture files: textures that are read, and previews in PNG and animated WebP.

Pillow is an extra: each function that needs it imports it.
"""

import io
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "JPEG")
SIDES = (64, 4096)
"""Of a picture [px]."""
MAX_BYTES = 8 * 2**20
"""Of a file."""

_MODES = ("RGB", "RGBA", "L", "LA", "P")
_LABEL_HEIGHT = 12  # [px]

Pictures = npt.NDArray[np.uint8]


class UnfitPictureError(ValueError):
    """A file is no picture that a cloth can be printed with.

    The message has the rule and the value.
    """


def read_picture(data: bytes) -> npt.NDArray[np.uint8]:
    """Return a picture file as 8-bit sRGB, shape (side, side, 3), row 0 on top.

    Raise UnfitPictureError.

    Sizes are checked before anything is decoded, so that a small file cannot ask for much memory.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    if len(data) > MAX_BYTES:
        raise UnfitPictureError(
            f"a texture must have at most {MAX_BYTES} bytes, and it has {len(data)}"
        )
    low, high = SIDES
    try:
        # The header alone is read here. Our own limit of the size follows.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(io.BytesIO(data), formats=FORMATS)
        width, height = picture.size
        if width != height or not low <= width <= high:
            raise UnfitPictureError(
                f"a texture must be square, of {low} to {high} pixels a side, and it has {width} x "
                f"{height}"
            )
        if picture.mode not in _MODES or getattr(picture, "is_animated", False):
            raise UnfitPictureError(
                "a texture must be one picture in grey or colour with 8 bits a channel, and its "
                f"mode is {picture.mode}"
                + (", animated" if getattr(picture, "is_animated", False) else "")
            )
        # Byte 24 of a PNG file has the bits of a channel. Pillow would cut the lower ones off.
        if picture.format == "PNG" and data[24] > 8:
            raise UnfitPictureError(
                f"a texture must have at most 8 bits a channel, and it has {data[24]}"
            )
        upright = ImageOps.exif_transpose(picture)
        if upright.mode in ("RGBA", "LA") or "transparency" in upright.info:
            upright = upright.convert("RGBA")
            # Cloth has no holes.
            if upright.getchannel("A").getextrema()[0] != 255:
                raise UnfitPictureError("a texture must be opaque, and it has transparent pixels")
        return np.array(upright.convert("RGB"), dtype=np.uint8)
    except UnfitPictureError:
        raise
    except UnidentifiedImageError as error:  # its message has the repr of a buffer
        raise UnfitPictureError(
            "a texture must be a whole PNG or JPEG file, and its beginning is that of none"
        ) from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UnfitPictureError(
            f"a texture must be a whole PNG or JPEG file: {error}"[:300]
        ) from error


def png(picture: Pictures) -> bytes:
    """Return a picture (height, width, 3) as a PNG file."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(file, format="PNG", compress_level=6)
    return file.getvalue()


def moving(pictures: Pictures, *, side: int | None = None, quality: int = 75) -> bytes:
    """Return pictures (n, height, width, 3) as an animated WebP that repeats forever.

    Each picture lasts 120 ms.

    With `side`, larger pictures are reduced until their longer side has so many pixels.
    """
    height, width = pictures.shape[1:3]
    if side is not None:
        width, height = _reduced_size((width, height), side)
    frames = [_reduced(picture, (width, height)) for picture in pictures]
    file = io.BytesIO()
    frames[0].save(
        file,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=120,
        loop=0,
        quality=quality,
        method=2,
    )
    return file.getvalue()


def labelled(pictures: Pictures, text: str, side: int) -> Pictures:
    """Return pictures (n, height, width, 3) as squares of `side` pixels with a text above.

    A picture of another shape has white beside it.
    """
    from PIL import Image, ImageDraw

    height, width = pictures.shape[1:3]
    reduced_width, reduced_height = _reduced_size((width, height), side)
    left = (side - reduced_width) // 2
    top = (side - reduced_height) // 2
    small = np.full((len(pictures), side, side, 3), 255, dtype=np.uint8)
    for square, picture in zip(small, pictures, strict=True):
        reduced = _reduced(picture, (reduced_width, reduced_height))
        square[top : top + reduced_height, left : left + reduced_width] = np.asarray(reduced)
    label = Image.new("RGB", (side, _LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(label).text((2, 0), text, fill=(0, 0, 0), font_size=9)
    strip = np.broadcast_to(np.asarray(label), (len(small), _LABEL_HEIGHT, side, 3))
    return np.concatenate([strip, small], axis=1)


def _reduced_size(size: tuple[int, int], side: int) -> tuple[int, int]:
    """Return the size (width, height) of a reduced picture whose longer side is `side` [px].

    A picture that is smaller keeps its size.
    """
    width, height = size
    scale = min(1.0, side / max(size))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _reduced(picture: Pictures, size: tuple[int, int]) -> "Image.Image":
    """Return a picture (height, width, 3) at a size (width, height) [px]."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(picture))
    return image if image.size == size else image.resize(size, Image.Resampling.BOX)


def sheet(tiles: Sequence[Pictures], columns: int) -> Pictures:
    """Arrange pictures (n, height, width, 3), all of one shape, in rows.

    The last row is filled with white.
    """
    # White tiles fill the last row.
    columns = min(columns, len(tiles))
    filled = [*tiles, *[np.full_like(tiles[0], 255)] * (-len(tiles) % columns)]
    rows = [
        np.concatenate(filled[first : first + columns], axis=2)
        for first in range(0, len(filled), columns)
    ]
    return np.concatenate(rows, axis=1)
