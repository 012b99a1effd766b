"""Clips as MP4."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
import numpy.typing as npt


def mp4(frames: Sequence[npt.NDArray[np.uint8]], *, rate: int = 10) -> bytes:
    """Return pictures (y, x, rgb) of even sizes as H.264 in MP4, `rate` a second; raise ImportError without PyAV."""
    import av

    made = BytesIO()
    with av.open(made, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=rate, options={"crf": "18"})
        (stream.height, stream.width), stream.pix_fmt = frames[0].shape[:2], "yuv420p"
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        film.mux(stream.encode())
    return made.getvalue()
