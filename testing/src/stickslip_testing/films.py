"""Films of cloth as a phone records them: lens distortion, camera shake and lossy H.264.

Needs PyAV and OpenCV.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from stickslip_schemas.spec.cameras import Camera
from stickslip_training.arrays import Array, Floats, SingleFloats
from stickslip_training.cloth.clips import RATE
from stickslip_training.cloth.crop import holder_path
from stickslip_training.cloth.runs import Runs


def meshes_at(run: Runs, seconds: Array) -> SingleFloats:
    """Return the meshes of one run at times after the start, (F, side, side, 3) [m].

    Between two instants that are known the shape changes evenly, while it moves with the holders.
    """
    times = np.maximum(np.asarray(seconds), 0.0) * RATE
    known = np.array(run.instants)
    after = np.clip(np.searchsorted(known, times, side="right"), 1, len(known) - 1)
    share = np.clip((times - known[after - 1]) / (known[after] - known[after - 1]), 0.0, 1.0)[
        :, None, None, None
    ]

    def moved(instants: Array) -> Floats:
        x, z = holder_path(instants)
        return np.stack([x, np.zeros(len(x)), z], axis=-1)[:, None, None]

    first, second = (run.positions[0, frame] - moved(known[frame]) for frame in (after - 1, after))
    return np.asarray((1 - share) * first + share * second + moved(times), dtype=np.float32)


def write_film(
    path: Path,
    pictures: Iterable[Array],
    camera: Camera,
    *,
    rate: int,
    distortion: tuple[float, ...],
    shake: Floats,
    quality: int = 20,
) -> None:
    """Write pictures (height, width, 3), 0 to 255, as an H.264 film through a lens.

    They are those of a pinhole camera.

    Each is moved by its row of `shake` (F, 2) [px]. `quality` is x264's constant rate factor:
    larger is worse.
    """
    import av
    import cv2

    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    columns, rows = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(pixels, matrix, np.array(distortion), P=matrix).reshape(
        camera.height, camera.width, 2
    )
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height = camera.width, camera.height
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(quality)}
        for picture, off in zip(pictures, shake, strict=True):
            across, down = np.moveaxis((flat - off).astype(np.float32), -1, 0)
            distorted = cv2.remap(np.asarray(picture, np.float32), across, down, cv2.INTER_CUBIC)
            levels = np.round(np.clip(distorted, 0, 255)).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(levels, format="rgb24")))
        container.mux(stream.encode())
