"""Frames of pictures and of ground truth as sRGB, and clips as MP4."""

from collections.abc import Iterable, Iterator
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


def coloured(
    array: ArrayLayout,
    values: npt.NDArray[np.generic],
    indices: Iterable[int],
    scale: Range | None = None,
) -> Iterator[Picture]:
    """Yield frames of pictures or of ground truth (y, x, 3) as sRGB.

    Codes get a colour each. Numbers are scaled by a range, by default theirs over the clip.
    """
    # The range is that of all frames, so it is looked up once.
    is_number = array.dimensions[-1] != "rgb" and "categories" not in array.attributes
    low, high = _balanced(scale or range_of(values)) if is_number else (0.0, 0.0)
    for index in indices:
        frame = values[index]
        if is_number:
            yield _scaled(frame, low, high)
        elif array.dimensions[-1] == "rgb":
            yield np.asarray(frame)
        else:
            yield np.asarray(_PALETTE[frame % len(_PALETTE)])


def range_of(values: npt.NDArray[np.generic]) -> Range:
    """Return the least and the largest finite number of a clip; (0, 0) without any."""
    low, high = np.inf, -np.inf
    # Frame by frame, for a clip of large pictures has gigabytes.
    for frame in values:
        finite = frame[np.isfinite(frame)]
        if finite.size:
            low = min(low, float(finite.min()))
            high = max(high, float(finite.max()))
    return (0.0, 0.0) if high < low else (low, high)


def _balanced(scale: Range) -> Range:
    """Return a range whose ends are opposite if it has numbers of two signs."""
    low, high = scale
    if low < 0.0:
        # Of two signs: grey is 0.
        high = max(-low, high)
        low = -high
    return low, high


def _scaled(frame: npt.NDArray[np.generic], low: float, high: float) -> Picture:
    """Return numbers of a frame (y, x, ...) from `low` to `high` as sRGB."""
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


def shown_part(
    array: ArrayLayout, values: npt.NDArray[np.generic], size: npt.NDArray[np.generic] | None
) -> npt.NDArray[np.generic]:
    """Return the part of the frames (frame, y, x, ...) of a sample that its picture covers.

    `size` is the label `picture_size` of the sample, or None if pictures fill their frames.
    """
    if size is None or array.dimensions[1:3] != ("y", "x"):
        return values
    width, height = (int(side) for side in size)
    return values[:, :height, :width]


def mp4(frames: Iterable[Picture]) -> bytes:
    """Return pictures (y, x, rgb) as H.264 in MP4, 10 a second.

    H.264 for browsers stores colours of 2 x 2 pixels, so a film has even sides: the last row or
    column of an odd picture is there twice. Raise ImportError without PyAV.
    """
    import av

    file = BytesIO()
    with av.open(file, "w", format="mp4") as film:
        options = {"crf": CONSTANT_RATE_FACTOR}
        stream = film.add_stream("libx264", rate=FRAMES_PER_SECOND, options=options)
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            rows, columns = frame.shape[:2]
            even = np.pad(frame, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
            if number == 0:
                stream.height, stream.width = even.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            film.mux(stream.encode(picture))
        film.mux(stream.encode())  # what the encoder has held back
    return file.getvalue()
