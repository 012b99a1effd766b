"""Calibrated cameras, as data.

A point X [scene units] lands on the pixel (u, v), with the distortion of the lens as in OpenCV
[Brown 1971]:

    (X', Y', Z) = R X + t            camera axes: x right, y down, z forward; Z is the depth
    x = X' / Z,   y = Y' / Z,   s = x^2 + y^2,   g = 1 + k1 s + k2 s^2 + k3 s^3
    u = fx (x g + 2 p1 x y + p2 (s + 2 x^2)) + cx
    v = fy (y g + p1 (s + 2 y^2) + 2 p2 x y) + cy

Integer pixel coordinates are pixel centres: the image covers [-0.5, width - 0.5] x [-0.5, height -
0.5] and v grows downwards. A camera is nothing but a name and numbers, so its JSON form
enters a content key.
"""

from __future__ import annotations

import tomllib
from functools import cache
from itertools import chain, product
from math import ceil, floor
from operator import mul
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, FiniteFloat, TypeAdapter, field_validator

from stickslip_schemas.base import Document, content_key
from stickslip_schemas.spec.resolution import DEFAULT_RESOLUTION

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Matrix3 = tuple[Vector3, Vector3, Vector3]  # rows

RIGS = Path(__file__).parents[1] / "rigs"
"""Folder of the rigs that this package ships."""

Lens = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
"""k1, k2, p1, p2, k3, in the order of OpenCV."""

NO_LENS: Lens = (0.0, 0.0, 0.0, 0.0, 0.0)
ROTATION_TOLERANCE = 1e-6  # of R R^T - 1: calibration files print six digits or more

_INVERSIONS = 60
"""Fixed-point steps that invert a lens: each leaves two thirds of the error, or less."""
_BORDER = 16
"""Points along each side of a picture at which the reach of a lens is measured."""


def distorted(x: Any, y: Any, lens: Lens) -> tuple[Any, Any]:
    """Return the images of points of the plane at depth 1; numbers or arrays."""
    k1, k2, p1, p2, k3 = lens
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    u = x * g + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    v = y * g + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return u, v


def undistorted(u: Any, v: Any, lens: Lens) -> tuple[Any, Any]:
    """Return the places that a lens shows at (u, v), by fixed-point steps; numbers or arrays."""
    if not any(lens):
        return u, v
    x = u
    y = v
    k1, k2, p1, p2, k3 = lens
    # Solve the formula above for x and y where they stand alone, with the last s, g and x y.
    for _ in range(_INVERSIONS):
        s = x * x + y * y
        g = 1.0 + s * (k1 + s * (k2 + s * k3))
        xy = 2.0 * x * y
        next_x = (u - p1 * xy - p2 * (s + 2.0 * x * x)) / g
        y = (v - p1 * (s + 2.0 * y * y) - p2 * xy) / g
        x = next_x
    return x, y


class Camera(Document):
    """One calibrated view: intrinsics in pixels, extrinsics from the world to the camera."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    """The viewpoint's name, unique in its rig."""
    width: Annotated[int, Field(ge=1, le=16384)]
    """Image width [px]."""
    height: Annotated[int, Field(ge=1, le=16384)]
    """Image height [px]."""
    fx: Annotated[FiniteFloat, Field(gt=0)]
    """Focal length along a row [px]."""
    fy: Annotated[FiniteFloat, Field(gt=0)]
    """Focal length along a column [px]."""
    cx: FiniteFloat
    """Principal point, column [px]; (width - 1) / 2 is the middle of the image."""
    cy: FiniteFloat
    """Principal point, row [px]."""
    rotation: Matrix3
    """R, rows: the camera's x, y and z axes in world coordinates, shape (3, 3)."""
    translation: Vector3
    """t [scene units]: the world's origin in camera coordinates, shape (3,)."""
    distortion: Lens = NO_LENS
    """k1, k2, p1, p2, k3 of the lens."""

    @field_validator("rotation")
    @classmethod
    def _is_rotation(cls, rotation: Matrix3) -> Matrix3:
        # R R^T must be the identity: rows of length 1 at right angles.
        error = 0.0
        for (i, row), (j, other) in product(enumerate(rotation), repeat=2):
            error = max(error, abs(sum(map(mul, row, other)) - (i == j)))
        # A mirror image has the determinant -1.
        (a, b, c), (d, e, f), (g, h, k) = rotation
        det = a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g)
        if error > ROTATION_TOLERANCE or det < 0:
            raise ValueError(
                f"rotation must be orthonormal to {ROTATION_TOLERANCE:g} and right-handed; "
                f"R R^T is off by {error:.2g}, det R = {det:.6g}"
            )
        return rotation

    @field_validator("distortion", mode="before")
    @classmethod
    def _all_five(cls, distortion: Any) -> Any:
        """Complete the numbers of OpenCV for a simpler lens: none, or k1, k2, p1, p2."""
        short = isinstance(distortion, list | tuple) and len(distortion) in (0, 4)
        return [*distortion, *NO_LENS[len(distortion) :]] if short else distortion

    @property
    def straight(self) -> Camera:
        """The same camera without distortion; its frame may not have all that the lens sees."""
        return self.model_copy(update={"distortion": NO_LENS})

    @property
    def position(self) -> Vector3:
        """The camera's centre in the world, -R^T t [scene units]."""
        x, y, z = (
            0.0 - sum(map(mul, axis, self.translation)) for axis in zip(*self.rotation, strict=True)
        )
        return x, y, z

    def project(
        self, points: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Project world points (..., 3) [scene units] to pixels (..., 2) and depths (...).

        A point that is not in front of the camera has no image: its pixel is NaN.
        """
        import numpy as np  # the extra `arrays`

        x = np.asarray(points, dtype=np.float64) @ np.asarray(self.rotation).T + np.asarray(
            self.translation
        )
        depth = x[..., 2]
        inverse = 1.0 / np.where(depth > 0.0, depth, np.nan)
        u, v = distorted(x[..., 0] * inverse, x[..., 1] * inverse, self.distortion)
        return np.stack([self.fx * u + self.cx, self.fy * v + self.cy], axis=-1), depth

    def rays(self) -> npt.NDArray[np.float64]:
        """Return the rays of depth 1 through the middle of all pixels, (height, width, 3).

        They are in the axes of the camera.
        """
        import numpy as np

        v, u = np.mgrid[: self.height, : self.width]
        x, y = undistorted((u - self.cx) / self.fx, (v - self.cy) / self.fy, self.distortion)
        return np.stack([x, y, np.ones(x.shape)], axis=-1)

    def border(self) -> list[tuple[float, float]]:
        """Return the points of the plane at depth 1 that the lens shows along the border."""
        fractions = [k / _BORDER for k in range(_BORDER + 1)]
        points = [*product(fractions, (0.0, 1.0)), *product((0.0, 1.0), fractions)]
        pixels = ((a * self.width - 0.5, b * self.height - 0.5) for a, b in points)
        return [
            undistorted((u - self.cx) / self.fx, (v - self.cy) / self.fy, self.distortion)
            for u, v in pixels
        ]

    def pinhole(self) -> Camera:
        """Return the pinhole camera of the same focal lengths that sees all that this one sees."""
        if not any(self.distortion):
            return self
        x, y = zip(*self.border(), strict=True)
        # Whole pixels outwards, so that the frame holds all of the border.
        left = floor(self.fx * min(x) + self.cx)
        top = floor(self.fy * min(y) + self.cy)
        right = ceil(self.fx * max(x) + self.cx)
        bottom = ceil(self.fy * max(y) + self.cy)
        size = {
            "width": right - left + 1,
            "height": bottom - top + 1,
            "cx": self.cx - left,
            "cy": self.cy - top,
        }
        return self.straight.model_copy(update=size)

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the camera at the same place for pictures of another size (width, height) [px].

        All that this camera sees stays in the picture, as large as fits. A picture of another shape
        shows more at two of its sides.
        """
        width, height = size
        if size == (self.width, self.height):
            return self
        scale = min(width / self.width, height / self.height)
        # Places about the middle of the frame, where the pixel centres are whole numbers less 1/2.
        x = self.cx - (self.width - 1) / 2
        y = self.cy - (self.height - 1) / 2
        intrinsics = {
            "width": width,
            "height": height,
            "fx": self.fx * scale,
            "fy": self.fy * scale,
            "cx": (width - 1) / 2 + x * scale,
            "cy": (height - 1) / 2 + y * scale,
        }
        return self.model_copy(update=intrinsics)

    @property
    def numbers(self) -> list[float]:
        """The numbers of the label: fx, fy, cx, cy, R by rows, t."""
        return [
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            *chain.from_iterable(self.rotation),
            *self.translation,
        ]

    def overflow(self, points: npt.ArrayLike, radius: float = 0.0, margin: float = 0.0) -> float:
        """Measure by how much balls about points (..., 3) leave the frame [px].

        The balls have a radius [scene units].

        The frame is narrowed by a margin [px] on every side. Negative: the room left. A ball's
        image is taken as a disc, which is right to first order in its angular size. Infinite if a
        ball reaches behind the camera. A lens may fold points that it does not see into its
        picture: the pinhole camera says how far out that is.
        """
        import numpy as np

        # A lens may fold points far outside into its picture. The pinhole camera does not.
        if any(self.distortion):
            outside = self.pinhole().overflow(points, radius, margin)
            if outside > 0.0:
                return outside
        pixels, depth = self.project(points)
        if not bool(np.all(depth > radius)):
            return float("inf")
        disc = radius / depth[..., None] * np.array([self.fx, self.fy])
        low = -0.5 + margin
        high = np.array([self.width, self.height]) - 0.5 - margin
        return float(max((low - (pixels - disc)).max(), (pixels + disc - high).max()))


def central(
    name: str, size: tuple[int, int], focal: float, rotation: Any, translation: Vector3
) -> Camera:
    """Return a camera whose axis meets the middle of its frame.

    `size` (width and height) and `focal` are in pixels.
    """
    width, height = size
    return Camera(
        name=name,
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        rotation=rotation,
        translation=translation,
    )


FRAMING = {"front": (-90.0, 15.0), "side": (-20.0, 25.0), "high": (-60.0, 50.0)}
"""Azimuth, from +x towards +y, and elevation of each camera that frames, seen from the framed
points [degree]."""

DEFAULT_SIDE = min(DEFAULT_RESOLUTION)
"""Shorter side of the pictures that lengths in pixels are given for [px]."""

_FRAMED_FOCAL = 560.0  # [px] at the default side: a lens of 90 mm, as the rigs have
_FRAMED_MARGIN = 10.0  # [px] at the default side


def framed(name: str, points: npt.ArrayLike, *, size: tuple[int, int], turn: float = 0.0) -> Camera:
    """Return the nearest upright camera that has all points (n, 3) in its frame.

    A point (X, Y, Z) in the camera's directions is in the frame if |X + t_x| <= k (Z + t_z), and
    the same of Y with the k of the height. So t_z is the larger of
    (max(X - k Z) + max(-X - k Z)) / 2 k and of the same of Y, and t_x centres the points.

    Args:
        name: One of `FRAMING`.
        points: All that must be in the frame.
        size: Width and height of the frame [px].
        turn: By which it goes around the points, from +x towards +y [degree].
    """
    import numpy as np

    # The axes of the camera: it looks at the points from azimuth a and elevation e.
    a, e = np.radians(FRAMING[name]) + np.array([np.radians(turn), 0.0])
    forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    R = np.stack([right, np.cross(forward, right), forward])
    # The points along these axes, and the narrowest frame around them.
    x, y, z = R @ np.asarray(points, dtype=np.float64).reshape(-1, 3).T
    # The lens is that of the shorter side: a longer side sees more.
    scale = min(size) / DEFAULT_SIDE
    focal = _FRAMED_FOCAL * scale
    slope_x, slope_y = ((side / 2.0 - 0.5 - _FRAMED_MARGIN * scale) / focal for side in size)
    left, right_ = (-x - slope_x * z).max(), (x - slope_x * z).max()
    top, bottom = (-y - slope_y * z).max(), (y - slope_y * z).max()
    distance = max((left + right_) / (2.0 * slope_x), (top + bottom) / (2.0 * slope_y))
    t = ((left - right_) / 2.0, (top - bottom) / 2.0, distance)
    return central(name, size, focal, R.tolist(), t)


class _Rig(Document):
    about: str
    unit: str
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1)]

    @field_validator("cameras")
    @classmethod
    def _names_are_unique(cls, cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
        names = [camera.name for camera in cameras]
        if len(set(names)) != len(names):
            raise ValueError(f"camera names must be unique in a rig; got {', '.join(names)}")
        return cameras


_RIG_FILE: TypeAdapter[dict[str, _Rig]] = TypeAdapter(dict[str, _Rig])


def read_rigs(path: str | Path) -> dict[str, tuple[Camera, ...]]:
    """Read the rigs of a calibration file, laid out like the shipped ones."""
    data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    return {name: rig.cameras for name, rig in _RIG_FILE.validate_python(data).items()}


@cache
def rig_names() -> tuple[str, ...]:
    """Return the names of the shipped rigs, in order."""
    return tuple(sorted(file.stem for file in RIGS.glob("*.toml")))


@cache
def load_rig(name: str) -> tuple[Camera, ...]:
    """Return the cameras of a shipped rig, in the order in which their views are stored."""
    if name not in rig_names():
        raise ValueError(f"rig must be one of {', '.join(rig_names())}; got {name!r}")
    return read_rigs(RIGS / f"{name}.toml")[name]


def rig_cameras(name: str, size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return the cameras of a shipped rig for pictures of a size (width, height) [px]."""
    return tuple(camera.resized(size) for camera in load_rig(name))


@cache
def rig_digest(name: str) -> str:
    """Return the content key of a shipped rig: its cameras' numbers, in order."""
    return content_key("rig", [camera.model_dump(mode="json") for camera in load_rig(name)])
