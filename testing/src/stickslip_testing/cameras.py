"""Cameras that tests place."""

import numpy as np
from stickslip_schemas.spec.cameras import Camera, Vector3


def looking_at(
    target: Vector3,
    *,
    azimuth: float,
    elevation: float,
    distance: float,
    name: str,
    width: int,
    height: int,
    focal: float,
) -> Camera:
    """Place a camera around a target, upright, the target in the middle of its image.

    Azimuth is the camera's direction seen from the target, from +x towards +y [degree]; elevation
    is above the horizon [degree], within (-90, 90); distance [scene units]; focal [px].
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    R = np.stack([right, np.cross(-outward, right), -outward])
    t = -R @ (np.asarray(target) + distance * outward)
    return Camera(
        name=name,
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        rotation=tuple(map(tuple, R.tolist())),
        translation=tuple(t.tolist()),
    )
