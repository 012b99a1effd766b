"""Frames of pictures and of ground truth as sRGB, and clips as MP4."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.arrays import ArrayLayout

Picture = npt.NDArray[np.uint8]

_OKABE_ITO = bytes.fromhex("000000 e69f00 56b4e9 009e73 f0e442 0072b2 d55e00 cc79a7")
_PALETTE = np.frombuffer(_OKABE_ITO, np.uint8).reshape(-1, 3)
"""Colours of the codes of segments, which people with any colour vision can tell apart.

[Okabe and Ito 2008]
"""

FRAMES_PER_SECOND = 10
CONSTANT_RATE_FACTOR = "18"
"""Quality of H.264, at which the eye sees no loss."""


Range = tuple[float, float]
"""Least and largest number of a clip, or of several that are compared."""


def range_of(values: npt.NDArray[np.generic]) -> Range:
    """Return the range of the finite numbers of a clip; (0, 0) without any."""
    finite = values[np.isfinite(values)].astype(np.float32)
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)


def coloured(
    array: ArrayLayout, values: npt.NDArray[np.generic], index: int, scale: Range | None = None
) -> Picture:
    """Return a frame of pictures or of ground truth (y, x, 3) as sRGB.

    Codes get a colour each. Numbers are scaled by a range, by default theirs over the clip.
    """
    frame = values[index]
    if array.dimensions[-1] == "rgb":
        return np.asarray(frame)
    if "categories" in array.attributes:
        return np.asarray(_PALETTE[frame % len(_PALETTE)])
    low, high = scale or range_of(values)
    if low < 0.0:
        # Of two signs: grey is 0.
        high = max(-low, high)
        low = -high
    fraction = (frame.astype(np.float32) - low) / ((high - low) or 1.0)
    fraction = np.nan_to_num(fraction, nan=0.0, posinf=0.0, neginf=0.0)
    planes = _three_planes(fraction.reshape(*fraction.shape[:2], -1))
    return np.asarray(255 * planes, dtype=np.uint8)


def _three_planes(planes: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return red, green and blue of one number a pixel, of two or of three."""
    count = planes.shape[2]
    if count == 1:
        return np.repeat(planes, 3, axis=2)
    if count == 2:
        blue = np.full((*planes.shape[:2], 1), 0.5, planes.dtype)
        return np.concatenate([planes, blue], axis=2)
    return planes


def mp4(frames: Sequence[Picture]) -> bytes:
    """Return pictures (y, x, rgb) of even sizes as H.264 in MP4, 10 a second.

    Raise ImportError without PyAV.
    """
    import av

    file = BytesIO()
    with av.open(file, "w", format="mp4") as film:
        options = {"crf": CONSTANT_RATE_FACTOR}
        stream = film.add_stream("libx264", rate=FRAMES_PER_SECOND, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            film.mux(stream.encode(picture))
        film.mux(stream.encode())  # what the encoder has held back
    return file.getvalue()
