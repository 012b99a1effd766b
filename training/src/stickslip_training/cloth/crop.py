"""The holder-registered crop: every frame is seen from the two holders, at one scale.

The path of the holders is known, and so is the camera: the middle of the two holders lands on a
known pixel, at a known depth. A crop puts that pixel at one place of the picture and shows `SCALE`
pixels a metre at that depth, whatever the camera. This removes errors of a pixel, or of a few parts
of a thousand in scale, of a real recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Array, Floats

HEIGHT = 72
WIDTH = 88
"""Of a crop [px]."""

SCALE = 290.0
"""[px/m] at the depth of the holders."""

ANCHOR = (14.0, (WIDTH - 1) / 2)
"""Row and column of the middle of the holders."""

PATCH = 0.095
"""y of the middle of a held patch, and of the other its negative [m]; they are 1 cm wide."""


@dataclass(frozen=True)
class Cameras:
    """Cameras of a batch of clips, as tensors."""

    rotation: torch.Tensor
    """(B, 3, 3), rows are the camera's axes."""
    translation: torch.Tensor
    """(B, 3) [m]"""
    focal: torch.Tensor
    """(B, 2) [px]"""
    center: torch.Tensor
    """(B, 2) [px]"""

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "Cameras":
        if bent := [camera.name for camera in cameras if any(camera.distortion)]:
            raise ValueError(
                "clips must be without lens distortion, and those of "
                f"{', '.join(sorted(set(bent)))} have it"
            )
        return Cameras(
            torch.tensor([camera.rotation for camera in cameras], dtype=torch.float32),
            torch.tensor([camera.translation for camera in cameras], dtype=torch.float32),
            torch.tensor([(camera.fx, camera.fy) for camera in cameras], dtype=torch.float32),
            torch.tensor([(camera.cx, camera.cy) for camera in cameras], dtype=torch.float32),
        )

    def __getitem__(self, chosen: slice | torch.Tensor) -> "Cameras":
        return Cameras(
            self.rotation[chosen], self.translation[chosen], self.focal[chosen], self.center[chosen]
        )

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Project points (B, ..., 3) [m] to pixels (B, ..., 2) and depths (B, ...) [m]."""
        flat = points.reshape(len(points), -1, 3)
        x = flat @ self.rotation.transpose(1, 2) + self.translation[:, None]
        pixels = self.focal[:, None] * x[..., :2] / x[..., 2:] + self.center[:, None]
        return pixels.reshape(*points.shape[:-1], 2), x[..., 2].reshape(points.shape[:-1])


@dataclass(frozen=True)
class Crops:
    """Positions of the crops of a batch: crop pixel = (pixel - origin) * scale + anchor."""

    origin: torch.Tensor
    """(B, F, 2) [px]: column and row of the middle of the holders."""
    scale: torch.Tensor
    """(B, F): pixels of the crop over pixels of the picture."""

    def __getitem__(self, chosen: slice) -> "Crops":
        return Crops(self.origin[chosen], self.scale[chosen])

    def off_by(self, shift: torch.Tensor, stretch: torch.Tensor) -> "Crops":
        """Return crops with an error of the registration.

        It is a shift by pixels of the crop (B, F, 2), and a factor (B,) in scale.
        """
        scale = self.scale * stretch[:, None]
        return Crops(self.origin - shift / scale[..., None], scale)

    def of_pixels(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return pixels of the picture (B, F, ..., 2) in the crop, (column, row)."""
        extra = (1,) * (pixels.ndim - 3)
        anchor = pixels.new_tensor((ANCHOR[1], ANCHOR[0]))
        origin = self.origin.reshape(*self.origin.shape[:2], *extra, 2)
        return (pixels - origin) * self.scale.reshape(*self.scale.shape, *extra, 1) + anchor


def holder_path(instants: Sequence[float] | Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the path of the middle of the holders: x and z, (F,) [m] [thesis, 4.2.3].

    Instants are of 2.4 a second, whole or not.

    6 cm down, then 30 cm to and fro: 10 mm/s^2 up to 10 mm/s, and as it began to an end.
    """
    t = np.asarray(instants) / 2.4

    def travel(since: Floats, distance: float) -> Floats:
        duration = distance / 0.01 + 1.0
        s = np.clip(since, 0.0, duration)
        cruise = 0.01 * (s - 0.5)
        braking = distance - 0.005 * (duration - s) ** 2
        return np.asarray(
            np.where(s < 1.0, 0.005 * s**2, np.where(s > duration - 1.0, braking, cruise))
        )

    x = sum((-1) ** leg * travel(t - 7.0 - 31.0 * leg, 0.3) for leg in range(4))
    z = 0.21 - travel(t, 0.06)
    return torch.tensor(x, dtype=torch.float32), torch.tensor(z, dtype=torch.float32)


def holder_crops(cameras: Cameras, instants: Sequence[float]) -> Crops:
    """Return the positions of the crops of clips by `cameras`, at each of the instants."""
    x, z = holder_path(instants)
    middle = torch.stack([x, torch.zeros_like(x), z], dim=-1).expand(len(cameras.focal), -1, -1)
    origin, depth = cameras.project(middle)
    return Crops(origin, SCALE * depth / cameras.focal.mean(dim=1)[:, None])


def cut(video: torch.Tensor, crops: Crops) -> torch.Tensor:
    """Cut the crops out of a video (B, F, H, W), grey levels: (B, F, 72, 88), 0 beyond its frame.

    A crop's pixel is the mean of 3 x 3 places in it, so that a picture that is larger is not
    sampled too thinly.
    """
    clips, frames, height, width = video.shape
    rows, columns = torch.meshgrid(_thirds(HEIGHT), _thirds(WIDTH), indexing="ij")
    crop = torch.stack([columns - ANCHOR[1], rows - ANCHOR[0]], dim=-1).to(video.device)
    pixels = crop / crops.scale[..., None, None, None] + crops.origin[..., None, None, :]
    size = pixels.new_tensor([width, height])
    grid = ((2 * pixels + 1) / size - 1).reshape(clips * frames, *pixels.shape[2:])
    fine = torch.nn.functional.grid_sample(
        video.reshape(clips * frames, 1, height, width), grid, mode="bilinear", align_corners=False
    )
    return torch.nn.functional.avg_pool2d(fine, 3).reshape(clips, frames, HEIGHT, WIDTH)


def _thirds(count: int) -> torch.Tensor:
    return torch.arange(3 * count, dtype=torch.float32) / 3 - 1 / 3


def grey(video: torch.Tensor) -> torch.Tensor:
    """Return the grey levels, 0 to 1, (..., H, W), of 8-bit sRGB (..., H, W, 3).

    The colour of cloth says nothing about its friction.
    """
    weights = torch.tensor([0.299, 0.587, 0.114], device=video.device) / 255
    return video.to(torch.float32) @ weights
