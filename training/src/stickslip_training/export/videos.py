"""Videos without loss: pictures in RGB, and depth in the twelve bits in which LeRobot has it.

With the range of a dataset, depth d [m] has the code q [huggingface/lerobot, DepthEncoderConfig
with use_log = False]:

    q = round(4095 (d - near) / (far - near))

`far` is a step beyond the farthest point, so that 4095 means that nothing is there.
"""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stickslip_training.arrays import Array

KEY_FRAMES = 10
"""Frames from one that is whole to the next: a frame is found by decoding so many at most."""

LARGEST_CODE = 4095
"""Code of depth where nothing is there: the largest of twelve bits."""

LEAST_SPAN = 0.1
"""Least range of depth [m]: with it a step is 24 micrometres."""

_RGB = ("libx264rgb", "rgb24", {"qp": "0", "bf": "0", "g": str(KEY_FRAMES)})
# Every frame is whole: x265 predicts frames of twelve bits from others with errors. One pool: the
# same clip has the same bytes.
_TWELVE_BITS = (
    "libx265",
    "gray12le",
    {"x265-params": "lossless=1:keyint=1:log-level=none:pools=none:frame-threads=1"},
)


class DepthRange(NamedTuple):
    """Depths of the codes 0 and 4095 [m]."""

    near: float
    far: float

    @classmethod
    def spanning(cls, clips: Iterable[Array]) -> "DepthRange":
        """Return the range of all finite depths of clips [m], which are read one by one."""
        near = np.inf
        far = -np.inf
        for depth in clips:
            for frame in depth:
                finite = frame[np.isfinite(frame)]
                if finite.size:
                    near = min(near, float(finite.min()))
                    far = max(far, float(finite.max()))
        if far < near:  # nothing is seen in any frame
            near = far = 0.0
        # One code is left for what is not there.
        span = max(far - near, LEAST_SPAN)
        return cls(near, near + span * LARGEST_CODE / (LARGEST_CODE - 1))

    def codes(self, depth: Array) -> Array:
        """Return the codes of depths [m]; infinite ones have the largest code."""
        share = (depth.astype(np.float64) - self.near) / (self.far - self.near)
        codes: Array = np.rint(np.minimum(share, 1.0) * LARGEST_CODE).astype(np.uint16)
        return codes

    @property
    def levels(self) -> Array:
        """Depth of each code [m]."""
        return np.linspace(self.near, self.far, LARGEST_CODE + 1)


def encode_pictures(video: Array, path: Path, rate: Fraction) -> None:
    """Write a clip (frames, height, width, 3), 8-bit sRGB, as a video without loss."""
    _encode(video, path, rate, _RGB)


def encode_depth(codes: Array, path: Path, rate: Fraction) -> None:
    """Write codes of depth (frames, height, width), twelve bits, as a video without loss."""
    _encode(codes, path, rate, _TWELVE_BITS)


def _encode(
    frames: Array, path: Path, rate: Fraction, encoder: tuple[str, str, dict[str, str]]
) -> None:
    import av

    codec, pixels, options = encoder
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = pixels
        stream.thread_count = 1  # the same clip has the same bytes
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=pixels)
            file.mux(stream.encode(picture))
        file.mux(stream.encode())


def statistics_of_codes(codes: Array, levels: Array) -> dict[str, Any]:
    """Return the statistics with which LeRobot normalises, of pictures (frames, height, width, k).

    `levels` are the values of the codes 0, 1, ... They are lists of the shape (k, 1, 1).
    """
    channels = codes.shape[3]
    counts = np.zeros((channels, len(levels)), dtype=np.int64)
    # Frame by frame: a large clip as floating-point numbers would fill the memory.
    for frame in codes:
        for channel in range(channels):
            counts[channel] += np.bincount(frame[..., channel].ravel(), minlength=len(levels))
    count = int(counts[0].sum())
    mean = counts @ levels / count
    variance = (counts * (levels - mean[:, None]) ** 2).sum(axis=1) / count
    occurring = [levels[np.flatnonzero(row)] for row in counts]
    statistics = {
        "min": np.array([values[0] for values in occurring]),
        "max": np.array([values[-1] for values in occurring]),
        "mean": mean,
        "std": np.sqrt(variance),
    }
    lists = {name: value.reshape(channels, 1, 1).tolist() for name, value in statistics.items()}
    return lists | {"count": [count]}
