"""The picture of a dataset version: some of its samples beside one another, moving where they are clips."""

import io
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from stickslip_schemas.arrays import ArrayLayout
from stickslip_schemas.axes import AnyAxis
from stickslip_schemas.codecs import decode_sample
from stickslip_schemas.jobs import JobSpec
from stickslip_schemas.layout import layout
from stickslip_schemas.samples import grid

PREVIEW_NAME = "preview.webp"
SHOWN = 12
_COLUMNS = 4
_SIDE = 120  # of a picture [px]
_LABEL_HEIGHT = 12  # [px]
_FRAME_MILLISECONDS = 120
_WEBP_QUALITY = 60

Pictures = npt.NDArray[np.uint8]


def pictured(spec: JobSpec) -> ArrayLayout | None:
    """Return the array that a dataset of `spec` is best seen by; None where it has no pictures."""
    seen = (array for array in layout(spec) if array.per_sample and array.dimensions[-3:] == ("y", "x", "rgb"))
    return next(seen, None)


def preview(spec: JobSpec, array: ArrayLayout, valid: Sequence[int], chunk: Callable[[int], bytes]) -> bytes | None:
    """Return a WebP of valid slots, evenly spread, with the values of their axes; None where none is valid.

    `chunk` returns the encoded chunk of a slot. A clip moves; of several views, the first is shown.
    """
    if not valid:
        return None
    shown = [valid[place * len(valid) // min(SHOWN, len(valid))] for place in range(min(SHOWN, len(valid)))]
    points = {slot: point for slot, point in enumerate(grid(spec)) if slot in shown}
    tiles = []
    for slot in shown:
        pictures = np.empty(array.shape, dtype=np.uint8)
        decode_sample(array, chunk(slot), pictures)
        tiles.append(_tile(pictures if array.is_clip else pictures[:1], _text(spec.named_axes, points[slot])))
    while len(tiles) % _COLUMNS and len(tiles) > _COLUMNS:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[first : first + _COLUMNS], axis=2) for first in range(0, len(tiles), _COLUMNS)]
    frames = [Image.fromarray(frame) for frame in np.concatenate(rows, axis=1)]
    file = io.BytesIO()
    frames[0].save(
        file,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=_FRAME_MILLISECONDS,
        loop=0,
        quality=_WEBP_QUALITY,
        method=2,
    )
    return file.getvalue()


def _text(axes: dict[str, AnyAxis], values: dict[str, object]) -> str:
    """Return the values of the axes that have several."""
    varied = [value for name, value in values.items() if axes[name].num > 1]
    return " ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in varied)


def _tile(pictures: Pictures, text: str) -> Pictures:
    """Return pictures (n, height, width, 3) made small, with a label above them."""
    small = [np.asarray(Image.fromarray(picture).resize((_SIDE, _SIDE), Image.Resampling.BOX)) for picture in pictures]
    label = Image.new("RGB", (_SIDE, _LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(label).text((2, 0), text, fill=(0, 0, 0), font_size=9)
    strip = np.broadcast_to(np.asarray(label), (len(small), _LABEL_HEIGHT, _SIDE, 3))
    return np.concatenate([strip, np.stack(small)], axis=1)
