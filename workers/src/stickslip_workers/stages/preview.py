"""The picture of a dataset version: some of its samples beside one another, moving where they are clips."""

import io
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from stickslip_schemas.format.codecs import decode_sample
from stickslip_schemas.format.layout import layout
from stickslip_schemas.plan.points import grid
from stickslip_schemas.spec.appearance import shown_frames
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

PREVIEW_NAME = "preview.webp"
SHOWN, FRAMES = 12, 20
"""Samples and instants that the picture has at most."""
_COLUMNS = 4
_SIDE = 120  # of a picture [px]
_LABEL_HEIGHT = 12  # [px]

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
    shown = [valid[place] for place in shown_frames(min(SHOWN, len(valid)), len(valid))]
    points = {slot: point for slot, point in enumerate(grid(spec)) if slot in shown}
    tiles = []
    for slot in shown:
        pictures = np.empty(array.shape, dtype=np.uint8)
        decode_sample(array, chunk(slot), pictures)
        count = min(FRAMES, len(pictures)) if array.is_clip else 1
        varied = {name: value for name, value in points[slot].items() if spec.named_axes[name].num > 1}
        tiles.append(labelled(pictures[list(shown_frames(count, len(pictures)))], text_of(varied), _SIDE))
    return moving(sheet(tiles, _COLUMNS))


def text_of(values: Mapping[str, object]) -> str:
    """Return parameters as people read them."""
    return " ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in values.values())


def labelled(pictures: Pictures, text: str, side: int) -> Pictures:
    """Return pictures (n, height, width, 3) made small, `side` pixels wide and high, with a text above them."""
    small = [np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.BOX)) for picture in pictures]
    label = Image.new("RGB", (side, _LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(label).text((2, 0), text, fill=(0, 0, 0), font_size=9)
    strip = np.broadcast_to(np.asarray(label), (len(small), _LABEL_HEIGHT, side, 3))
    return np.concatenate([strip, np.stack(small)], axis=1)


def sheet(tiles: Sequence[Pictures], columns: int) -> Pictures:
    """Put pictures (n, height, width, 3), all of one shape, in rows."""
    columns = min(columns, len(tiles))
    filled = [*tiles, *[np.full_like(tiles[0], 255)] * (-len(tiles) % columns)]
    rows = [np.concatenate(filled[first : first + columns], axis=2) for first in range(0, len(filled), columns)]
    return np.concatenate(rows, axis=1)


def moving(pictures: Pictures, *, milliseconds: int = 120, quality: int = 50) -> bytes:
    """Return a WebP of pictures (n, height, width, 3) that follow one another for ever."""
    frames = [Image.fromarray(picture) for picture in pictures]
    file = io.BytesIO()
    frames[0].save(
        file,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        quality=quality,
        method=2,
    )
    return file.getvalue()
