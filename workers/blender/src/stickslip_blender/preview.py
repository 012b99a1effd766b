"""Small pictures for pages: stills in a row, moving clips, and sheets of them with labels."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

_FRAME_MILLISECONDS = 120
_LABEL_HEIGHT = 14  # [px]

Pictures = npt.NDArray[np.uint8]


def side_by_side(views: Pictures) -> bytes:
    """Return a PNG of views (n, height, width, 3) in a row."""
    file = io.BytesIO()
    Image.fromarray(np.concatenate(list(views), axis=1)).save(file, format="PNG", compress_level=6)
    return file.getvalue()


def moving(clip: Pictures, *, side: int = 160, quality: int = 75) -> bytes:
    """Return an animated WebP of a clip (frames, height, width, 3), `side` pixels wide, that repeats for ever."""
    height = round(side * clip.shape[1] / clip.shape[2])
    frames = [Image.fromarray(frame).resize((side, height), Image.Resampling.BOX) for frame in clip]
    file = io.BytesIO()
    frames[0].save(
        file,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=_FRAME_MILLISECONDS,
        loop=0,
        quality=quality,
        method=2,
    )
    return file.getvalue()


def sheet(rows: Sequence[Sequence[Pictures]], labels: Sequence[Sequence[str]]) -> Pictures:
    """Put clips (frames, height, width, 3), all of one shape, in rows and columns under their labels."""
    return np.concatenate(
        [
            np.concatenate([_labelled(clip, text) for clip, text in zip(clips, texts, strict=True)], axis=2)
            for clips, texts in zip(rows, labels, strict=True)
        ],
        axis=1,
    )


def _labelled(clip: Pictures, text: str) -> Pictures:
    strip = Image.new("RGB", (clip.shape[2], _LABEL_HEIGHT), (255, 255, 255))
    ImageDraw.Draw(strip).text((3, 1), text, fill=(0, 0, 0))
    label = np.broadcast_to(np.asarray(strip), (len(clip), _LABEL_HEIGHT, clip.shape[2], 3))
    return np.concatenate([label, clip], axis=1)
