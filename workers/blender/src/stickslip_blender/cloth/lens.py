"""What a lens shows: the pictures of the pinhole camera that sees all of it, bent."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cycles.pixels import encode
from stickslip_blender.raster import decoded


def bent(video: npt.NDArray[np.uint8], camera: Camera) -> npt.NDArray[np.uint8]:
    """Return what a camera shows of a video (frames, height, width, 3) that its `pinhole` took, 8-bit sRGB.

    A pixel is interpolated between four, in linear light.
    """
    if not any(camera.distortion):
        return video
    _, _, places = traced(camera)
    corner = np.floor(places).astype(int)
    share = (places - corner)[..., None].astype(np.float32)
    column, row = corner[..., 0], corner[..., 1]
    across, down = share[:, :, 0], share[:, :, 1]
    result = np.empty((len(video), *column.shape, 3), dtype=np.uint8)
    for frame, picture in enumerate(video):
        a, b, c, d = (decoded(picture[row + y, column + x]) for y in range(2) for x in range(2))
        upper, lower = a + across * (b - a), c + across * (d - c)
        result[frame] = encode(upper + down * (lower - upper))
    return result


@lru_cache(maxsize=4)  # every frame and every texture asks
def traced(camera: Camera) -> tuple[Camera, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return a camera's pinhole, its rays (height, width, 3), and where in the pinhole's frame they land [px]."""
    pinhole, rays = camera.pinhole(), camera.rays()
    return pinhole, rays, rays[..., :2] * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
