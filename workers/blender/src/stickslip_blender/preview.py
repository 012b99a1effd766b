"""Drawings of a scene before its simulation.

They show the starts of all parts, and the motion of bodies and holders.

`python -m stickslip_blender.preview RECORD.npz SCENE.json DIR` writes `CAMERA.png` of the start and
`motion.webp`, which has all cameras side by side. The record has the arrays of `cloth_scene` that
the cameras and bodies need. The drawing traces no light.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.format.pictures import moving, png
from stickslip_schemas.spec.cameras import FRAMING, Camera
from stickslip_schemas.spec.names import Texture

from stickslip_blender.cloth.geometry import Geometry
from stickslip_blender.cloth.stage import Stage
from stickslip_blender.cloth.textures import custom_texture, texture_image
from stickslip_blender.raster import Window, projected, scaled, see

SIDE = 320
"""Side of a picture [px]."""
_SHARPNESS = 2  # samples across a pixel
_LIGHT = np.array([0.35, -0.45, 0.82])
_DIFFUSE = 0.6
_SHADOW = 0.72
_SHEET = np.array(
    [[0.93, 0.90, 0.84], [0.20, 0.42, 0.72]]
)  # sRGB colours of the squares of a sheet without a picture
_SQUARES = 8
_GROUND = 0.62
_LINE = 0.5
_SKY = 0.9
_LINE_DISTANCE = 0.1  # distance between lines on the floor [m]
_LINE_WIDTH = 0.003  # [m]

Array = npt.NDArray[Any]


def draw(scene: Mapping[str, Any], record: Mapping[str, Array], out: Path) -> list[str]:
    """Draw a scene, and return the names of the pictures.

    Args:
        scene: Four entries. `scene`: `Staged`, as JSON, with paths of files. `sheet`: the sheet
            that takes the texture. `segments`: names of the codes. `cameras`: cameras of the
            scene, as JSON, or none if cameras frame everything that moves.
        record: Arrays of the scene at the instants of the animation.
        out: Directory for the pictures.
    """

    def picture(name: str) -> npt.NDArray[np.uint8]:
        built_in = name in list(Texture)
        return texture_image(Texture(name)) if built_in else custom_texture(Path(name).read_bytes())

    sheet = scene["sheet"]
    stage = Stage(scene["scene"], sheet, scene["segments"], record, picture)
    geometry = Geometry(record[f"{sheet}.triangles"], record[f"{sheet}.rest"], stage)
    scene_cameras = [Camera.model_validate(camera) for camera in scene["cameras"]]
    # Pictures stand side by side in the clip, so all of them have one height.
    cameras = [scaled(camera, SIDE / camera.height) for camera in scene_cameras] or [
        stage.camera(name, geometry, (SIDE, SIDE)) for name in FRAMING
    ]
    colors = _colors(geometry)
    rows = []
    for instant, positions in enumerate(record[f"{sheet}.positions"]):
        points = geometry.points(positions, instant)
        rows.append([_drawn(geometry, points, colors, camera) for camera in cameras])
    for camera, first in zip(cameras, rows[0], strict=True):
        (out / f"{camera.name}.png").write_bytes(png(first))
    clip = np.stack([np.concatenate(row, axis=1) for row in rows])
    (out / "motion.webp").write_bytes(moving(clip))
    return [*(f"{camera.name}.png" for camera in cameras), "motion.webp"]


def _colors(geometry: Geometry) -> Array:
    """Return the colour of each triangle (T, 3), sRGB from 0 to 1.

    A triangle of a sheet has the colour of the picture at the middle of the triangle.
    """
    corners = geometry.uv[geometry.triangles].mean(axis=1)
    squares = np.floor(_SQUARES * corners).astype(int).sum(axis=1) % 2
    parts = [_SHEET[squares[: geometry.cloth_triangles]]]
    begin = geometry.cloth_triangles
    for prop in geometry.surroundings.props:
        count = len(prop.tints)
        if prop.sheet is None:
            linear = np.clip(prop.tints * prop.grey, 0.0, 1.0)
            parts.append(
                np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
            )
        else:
            texels = np.minimum(
                (corners[begin : begin + count] * len(prop.sheet.picture)).astype(int), 10**6
            )
            u, v = np.clip(texels, 0, len(prop.sheet.picture) - 1).T
            parts.append(prop.sheet.picture[v, u] / 255.0)
        begin += count
    return np.concatenate(parts)


def _drawn(
    geometry: Geometry, points: Array, colors: Array, camera: Camera
) -> npt.NDArray[np.uint8]:
    """Return a picture (height, width, 3) with flat shading, and with shadows on the floor."""
    window = Window(0, 0, camera.width, camera.height)
    visible = see(projected(camera, points), geometry.triangles, window, _SHARPNESS).triangle
    a, b, c = (points[geometry.triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    light = _LIGHT / np.linalg.norm(_LIGHT)
    facing = np.abs(normals @ light) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    shaded = colors * (1.0 - _DIFFUSE + _DIFFUSE * facing[:, None])
    ground = _floor(geometry, points, camera, visible.shape, light)
    picture = np.where(visible[..., None] < 0, ground[..., None], shaded[visible])
    small = picture.reshape(camera.height, _SHARPNESS, camera.width, _SHARPNESS, 3).mean(
        axis=(1, 3)
    )
    return np.asarray(np.rint(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8))


def _floor(
    geometry: Geometry, points: Array, camera: Camera, shape: tuple[int, ...], light: Array
) -> Array:
    """Return the brightness of each sample of the background.

    The background is the sky, or the floor with its lines and shadows.
    """
    height = geometry.surroundings.floor
    if height is None:
        return np.full(shape, _SKY)
    row, column = ((np.arange(size) + 0.5) / _SHARPNESS - 0.5 for size in shape)
    u, v = np.meshgrid((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.asarray(camera.rotation)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(ray[..., 2] < 0.0, (height - camera.position[2]) / ray[..., 2], np.inf)
        place = camera.position[:2] + depth[..., None] * ray[..., :2]
        # Find the distance from the nearest line, along each axis of the floor.
        distance = np.abs((place + 0.5 * _LINE_DISTANCE) % _LINE_DISTANCE - 0.5 * _LINE_DISTANCE)
        lines = (distance < _LINE_WIDTH).any(axis=-1)
    shadow = points - (points[:, 2:] - height) / light[2] * light
    window = Window(0, 0, camera.width, camera.height)
    dark = see(projected(camera, shadow), geometry.triangles, window, _SHARPNESS).triangle >= 0
    ground = np.where(lines, _LINE, _GROUND) * np.where(dark, _SHADOW, 1.0)
    return np.where(np.isfinite(depth), ground, _SKY)


if __name__ == "__main__":
    _record, _scene, _out = map(Path, sys.argv[1:])
    with np.load(_record, allow_pickle=False) as _arrays:
        _names = draw(json.loads(_scene.read_text(encoding="utf-8")), dict(_arrays), _out)
    sys.stdout.write("\n".join(_names) + "\n")
