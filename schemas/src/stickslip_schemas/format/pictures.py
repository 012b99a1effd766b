"""Pictures that users bring along as textures: which are taken, and how they are read."""

import io
import warnings

import numpy as np
import numpy.typing as npt

FORMATS = ("PNG", "JPEG")
SIDES = (64, 4096)
"""Of a picture [px]."""
MAX_BYTES = 8 * 2**20
"""Of a file."""

_MODES = ("RGB", "RGBA", "L", "LA", "P")


class UnfitPictureError(ValueError):
    """A file is no picture that a cloth can be printed with; the message has the rule and what was found."""


def read_picture(data: bytes) -> npt.NDArray[np.uint8]:
    """Return a picture file as 8-bit sRGB, shape (side, side, 3), row 0 on top; raise UnfitPictureError.

    Sizes are looked at before anything is decoded, so that a small file cannot ask for much memory.
    """
    from PIL import Image, ImageOps  # an extra: only who looks at pictures needs it

    if len(data) > MAX_BYTES:
        raise UnfitPictureError(f"a texture must have at most {MAX_BYTES} bytes, and it has {len(data)}")
    low, high = SIDES
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(io.BytesIO(data), formats=FORMATS)
        width, height = picture.size
        if width != height or not low <= width <= high:
            raise UnfitPictureError(
                f"a texture must be square, of {low} to {high} pixels a side, and it has {width} x {height}"
            )
        if picture.mode not in _MODES or getattr(picture, "is_animated", False):
            raise UnfitPictureError(
                f"a texture must be one picture in grey or colour with 8 bits a channel, and its mode is {picture.mode}"
                + (", animated" if getattr(picture, "is_animated", False) else "")
            )
        upright = ImageOps.exif_transpose(picture)
        if upright.mode in ("RGBA", "LA") or "transparency" in upright.info:
            upright = upright.convert("RGBA")
            if upright.getchannel("A").getextrema()[0] != 255:
                raise UnfitPictureError("a texture must be opaque, and it has transparent pixels")
        return np.array(upright.convert("RGB"), dtype=np.uint8)
    except UnfitPictureError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UnfitPictureError(f"a texture must be a whole PNG or JPEG file: {error}"[:300]) from error
