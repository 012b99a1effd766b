"""The scene around a sheet: further sheets, bodies and holders.

They come from the document of the scene and a record. The arrays have the names of a record of
`cloth_scene`. Everything in a document is in the order of its names.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.scene.shapes import cell_side, with_roundings
from stickslip_schemas.spec.cameras import Camera, framed

from stickslip_blender.cloth.geometry import (
    BACKGROUND,
    FLOOR,
    HOLDER_COLOR,
    HOLDER_ROUGHNESS,
    Faces,
    Geometry,
    Print,
    Prop,
    box,
    gores,
    rounded,
    square,
    tiled,
)
from stickslip_blender.cloth.looks import fabric_appearance, print_on_fabric
from stickslip_blender.cloth.surface import surface
from stickslip_blender.raster import Window, _raster, projected, see

# Distance of a visible body inside the simulated one [m]: half the thickness of a cloth that lies
# on it.
SUNK = -FLOOR
ENDLESS = 1.0  # half the visible size of an endless cylinder, or of a plane besides the floor [m]
TILE = 0.1  # side of the tiles of bodies [m]
JAWS = 0.004  # excess of a holder over the held part, along each axis [m]
MOVING = 0.005  # least way of a moving vertex [m]: cameras frame all moving vertices
PLAIN = (168, 164, 156)  # sRGB colour of a sheet without a texture from the scene or an axis

_DEFAULT_COLOR = (0.2, 0.2, 0.2)  # linear colour of a body without a look, the document's default
_DEFAULT_ROUGHNESS = 0.5  # roughness of a body without a look
# Turns of the camera about the scene [degree], the smallest first.
_TURNS = (0.0, *(sign * 30.0 * step for step in range(1, 6) for sign in (1, -1)), 180.0)
# Fraction of the most cloth that any turn shows. The smallest turn that reaches it is used.
_ENOUGH = 0.6
_WATCHED = 60  # instants for finding the moving vertices
_TURN_INSTANTS = 5  # instants for measuring the visible cloth of a turn
_THUMB = 56  # shorter side of the pictures for turns [px]

Array = npt.NDArray[Any]


class Stage:
    """The surroundings of one sheet of a scene: the sheet that takes the axis `texture`."""

    def __init__(
        self,
        scene: Mapping[str, Any],
        sheet: str,
        segments: Sequence[str],
        record: Mapping[str, Array],
        picture: Callable[[str], npt.NDArray[np.uint8]],
    ) -> None:
        """Make the props of a scene.

        Args:
            scene: `Staged` of stickslip_schemas.scene, as JSON.
            sheet: The sheet that is not a prop.
            segments: Names of the codes of the segmentation.
            record: Arrays of a sample.
            picture: Returns a texture by name.
        """
        codes = {name: code for code, name in enumerate(segments)}
        self._record = record
        self._sheet = sheet
        self.segment = codes[sheet]
        self.floor: float | None = None
        self.ground = BACKGROUND
        self._placers: list[Callable[[int], Array]] = []
        props: list[Prop] = []

        # Sheets come first, because the composer reads their pictures from the first triangles.
        for name, other in scene["sheets"].items():
            if name != sheet:
                props.append(
                    self._printed(
                        name, other, scene["looks"]["sheets"].get(name), picture, codes[name]
                    )
                )

        # The first level plane is the floor. It has marks and a mirror image, but no mesh.
        bodies = with_roundings(scene["bodies"], self._largest_cell(scene["sheets"]))
        for number, (name, body) in enumerate(bodies.items()):
            if body["type"] == "plane" and body["normal"][:2] == [0.0, 0.0] and self.floor is None:
                self.floor = body["origin"][2] + FLOOR
                self.ground = codes[name]
                continue
            look = scene["looks"]["bodies"].get(name) or {
                "color": _DEFAULT_COLOR,
                "roughness": _DEFAULT_ROUGHNESS,
            }
            props.append(self._body(name, number, body, look, codes[name]))

        # A holder is a box around the part that it holds. A holder without such a part has no box.
        for number, sides in enumerate(
            record["holder_box"].tolist() if "holder_box" in record else ()
        ):
            if not np.isnan(sides).any():
                vertices, faces = box(tuple(side + JAWS for side in sides), (0.0, 0.0, 0.0))
                self._placers.append(self._posed("holder_pose", number, vertices))
                look = HOLDER_COLOR, HOLDER_ROUGHNESS
                props.append(
                    Prop(f"holder-{number}", vertices, faces, *look, segment=codes["holders"])
                )
        self.props = tuple(props)

    def placed(self, instant: int, _vertices: Array) -> list[Array]:
        return [place(instant) for place in self._placers]

    def moving(self) -> Array:
        """Return the places (n, 3) [m], over time, of all moving vertices and of the sheet."""
        track = self._record[f"{self._sheet}.positions"]
        instants = np.unique(np.linspace(0, len(track) - 1, _WATCHED).astype(int))
        parts = [track.reshape(-1, 3)]
        # Props that stand still do not count, whatever their size.
        for place in self._placers:
            places = np.stack([place(instant) for instant in instants])
            moves = (np.ptp(places, axis=0) > MOVING).any(axis=1)
            parts.append(places[:, moves].reshape(-1, 3))
        return np.concatenate(parts)

    def camera(self, name: str, geometry: Geometry, size: tuple[int, int]) -> Camera:
        """Return the camera that frames everything that moves in pictures of a size [px].

        It is turned until enough of the sheet is visible.
        """
        points = self.moving()
        track = self._record[f"{self._sheet}.positions"]
        instants = np.linspace(0, len(track) - 1, _TURN_INSTANTS).astype(int)
        scenes = [geometry.points(track[instant], int(instant)) for instant in instants]
        # Take the first turn that shows nearly as much as the best one. A camera from far around
        # would surprise.
        reduction = _THUMB / min(size)
        thumb = (round(reduction * size[0]), round(reduction * size[1]))
        pixel_counts = [
            _count_sheet_pixels(framed(name, points, size=thumb, turn=turn), geometry, scenes)
            for turn in _TURNS
        ]
        turn = next(
            turn
            for turn, pixel_count in zip(_TURNS, pixel_counts, strict=True)
            if pixel_count >= _ENOUGH * max(pixel_counts)
        )
        return framed(name, points, size=size, turn=turn)

    def _printed(
        self,
        name: str,
        sheet: Mapping[str, Any],
        print_document: Mapping[str, Any] | None,
        picture: Any,
        segment: int,
    ) -> Prop:
        positions = self._record[f"{name}.positions"]
        skin = surface(self._record[f"{name}.triangles"], self._record[f"{name}.rest"])
        look = fabric_appearance(sheet["material"])
        skin.apply_relief(hem=1e-3 * look.hem)
        texture = (
            np.full((64, 64, 3), PLAIN, dtype=np.uint8)
            if print_document is None
            else picture(print_document["texture"])
        )
        self._placers.append(lambda instant: skin(positions[instant]))
        faces = list(map(tuple, skin.triangles.tolist()))
        printed = Print(skin.uv, print_on_fabric(texture, look, skin), look)
        return Prop(
            name,
            skin(positions[0]),
            faces,
            np.zeros((1, 3)),
            look.roughness,
            segment=segment,
            sheet=printed,
        )

    def _body(
        self, name: str, number: int, body: Mapping[str, Any], look: Mapping[str, Any], segment: int
    ) -> Prop:
        color = np.asarray(look["color"], dtype=np.float64).reshape(1, 3)
        if body["type"] == "mesh":
            triangles = self._record[f"{name}.triangles"]
            moved = self._record.get(f"{name}.vertices")
            vertices = _sunk(self._record[f"{name}.rest"], triangles)
            faces = list(map(tuple, triangles.tolist()))
            posed = self._posed("body_pose", number, vertices)
            self._placers.append(
                posed if moved is None else lambda instant: _sunk(moved[instant], triangles)
            )
            return Prop(name, vertices, faces, color, look["roughness"], segment=segment)
        vertices, shape = _shape(body)
        vertices, faces, owners = tiled(vertices, shape, TILE)
        if body["type"] in ("sphere", "cylinder", "capsule"):
            color = gores(color, len(shape))[owners]
        self._placers.append(self._posed("body_pose", number, vertices))
        return Prop(name, vertices, faces, color, look["roughness"], segment=segment)

    def _largest_cell(self, sheets: Iterable[str]) -> float:
        cells = []
        for name in sheets:
            cells.append(cell_side(self._record[f"{name}.rest"], self._record[f"{name}.triangles"]))
        return max(cells)

    def _posed(self, array: str, number: int, vertices: Array) -> Callable[[int], Array]:
        poses = np.asarray(self._record[array][:, number], dtype=np.float64)

        def place(instant: int) -> Array:
            return np.asarray(vertices @ poses[instant, :, :3].T + poses[instant, :, 3])

        return place


def _sunk(points: Array, triangles: Array) -> Array:
    """Return the vertices (n, 3) of a mesh, moved inwards by `SUNK`."""
    vertices = np.asarray(points, dtype=np.float64)
    return np.asarray(
        vertices - SUNK * _raster.normals(vertices, np.ascontiguousarray(triangles, dtype=np.int32))
    )


def _shape(body: Mapping[str, Any]) -> tuple[Array, Faces]:
    """Return the vertices of a body that is not a mesh, in its axes [m], and its faces."""
    kind = body["type"]
    if kind == "plane":
        vertices, faces = square(body["normal"], 2.0 * ENDLESS)
        return vertices - SUNK * np.asarray(body["normal"]) / np.linalg.norm(body["normal"]), faces
    if kind == "box":
        rounding = max(body["rounding"], 2.0 * SUNK)
        return rounded(0.5 * np.asarray(body["size"]) - rounding, rounding - SUNK)
    half = {"sphere": 0.0, "capsule": 0.5 * body.get("length", 0.0), "cylinder": ENDLESS}[kind]
    return rounded((0.0, 0.0, half), body["radius"] - SUNK)


def _count_sheet_pixels(camera: Camera, geometry: Geometry, scenes: list[Array]) -> int:
    """Return the number of pixels that show the sheet, over several instants."""
    window = Window(0, 0, camera.width, camera.height)
    count = 0
    for points in scenes:
        visible = see(projected(camera, points), geometry.triangles, window, grid=1).triangle
        count += int(((visible >= 0) & (visible < geometry.cloth_triangles)).sum())
    return count
