"""Mesh files of other programs: one cube in every format and dialect, and broken files."""

import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.files import counts_of, frames_of, read_file, weld_notes
from stickslip_schemas.scene.mesh_files import FARTHEST, read_polygons
from stickslip_schemas.scene.plain_obj import read_tables

BODY = ("bodies", "cube", "file")
MESH = ("sheets", "towel", "mesh", "file")
START = ("sheets", "towel", "start", "file")
SIDE = 0.04
"""Of the cube [m]."""

CORNERS = SIDE * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [half for a, b, c, d in FACES for half in ((a, b, c), (a, c, d))]


def obj(*, face: Callable[[int, int], str] = lambda vertex, _: f"{vertex}", head: str = "") -> str:
    """Return the cube as an OBJ file; `face` writes a corner by its vertex and its number."""
    lines = [head, *(f"v {x:g} {y:g} {z:g}" for x, y, z in CORNERS)]
    number = 0
    for corners in FACES:
        words = []
        for corner in corners:
            number += 1
            words.append(face(corner + 1, number))
        lines.append(f"f {' '.join(words)}")
    return "\n".join(lines) + "\n"


def textured() -> str:
    """Return the cube with a texture coordinate for each corner of each face, as exporters do."""
    texture = "\n".join(f"vt {0.1 * (n % 4):g} {0.2 * (n // 4):g}" for n in range(24))
    normal = "vn 0 0 1"
    return obj(face=lambda vertex, n: f"{vertex}/{n}/1", head=f"o Cube\n{texture}\n{normal}")


def binary_stl(*, text: bytes = b"exported", scale: float = 1.0) -> bytes:
    data = text.ljust(80) + struct.pack("<I", len(TRIANGLES))
    for triangle in TRIANGLES:
        data += struct.pack("<12fH", 0, 0, 0, *(scale * CORNERS[list(triangle)]).ravel(), 0)
    return data


def text_stl() -> str:
    lines = ["solid cube"]
    for triangle in TRIANGLES:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += ["      vertex " + " ".join(f"{v:e}" for v in CORNERS[i]) for i in triangle]
        lines += ["    endloop", "  endfacet"]
    return "\n".join([*lines, "endsolid cube", ""])


def ply(form: str, *, index: str = "vertex_indices") -> bytes:
    """Return the cube as a PLY file with normals, colours and an element of edges."""
    header = f"""ply
format {form} 1.0
comment made for a test
element vertex 8
property float x
property float y
property float z
property uchar red
element face 6
property list uchar int {index}
property uchar flags
element edge 1
property int vertex1
end_header
"""
    if form == "ascii":
        rows = [f"{x:g} {y:g} {z:g} 7" for x, y, z in CORNERS]
        rows += [f"4 {' '.join(map(str, face))} 0" for face in FACES]
        return (header + "\n".join(rows) + "\n0\n").encode()
    order = ">" if "big" in form else "<"
    data = header.encode()
    for corner in CORNERS:
        data += struct.pack(f"{order}3fB", *corner, 7)
    for face in FACES:
        data += struct.pack(f"{order}B4iB", 4, *face, 0)
    return data + struct.pack(f"{order}i", 0)


DIALECTS: dict[str, bytes] = {
    "obj": obj().encode(),
    "texture coordinates with seams": textured().encode(),
    "normals only": obj(face=lambda vertex, _: f"{vertex}//1", head="vn 0 0 1").encode(),
    "negative indices": obj(face=lambda vertex, _: str(vertex - 9)).encode(),
    "byte order mark": b"\xef\xbb\xbf" + obj().encode(),
    "UTF-16": obj(head="# café").encode("utf-16"),
    "names in Latin-1": b"g caf\xe9\nusemtl m\xfcll\n" + obj().encode(),
    "Windows lines": obj().replace("\n", "\r\n").encode(),
    "old Mac lines": obj().replace("\n", "\r").encode(),
    "continued lines": obj().replace(" ", " \\\n ").encode(),
    "continued Windows lines": obj().replace(" ", " \\\r\n ").encode(),
    "groups, comments and colours": (
        obj(head="mtllib a.mtl\ng one two\ns off")
        .replace("\nf", "  0.5 0.5 0.5\nusemtl red\nf", 1)
        .replace("\nf", " # a comment\nf", 2)
        .encode()
    ),
    "triangles": (
        obj().split("f ")[0] + "\n".join(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in TRIANGLES)
    ).encode(),
    "binary STL": binary_stl(),
    "binary STL that begins with solid": binary_stl(text=b"solid cube\nfacet"),
    "STL in text": text_stl().encode(),
    "STL in capitals": text_stl().upper().encode(),
    "PLY in text": ply("ascii"),
    "PLY in text, Windows lines": ply("ascii").replace(b"\n", b"\r\n"),
    "little-endian PLY": ply("binary_little_endian"),
    "big-endian PLY": ply("binary_big_endian"),
    "PLY with vertex_index": ply("binary_little_endian", index="vertex_index"),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_every_dialect_is_the_same_cube(name: str) -> None:
    body = read_file(BODY, DIALECTS[name])
    (positions,) = body["positions"]
    triangles = body["triangles"]
    # A closed cube: 8 vertices, 12 triangles, 18 edges of two triangles each, and its volume.
    assert positions.shape == (8, 3)
    assert triangles.shape == (12, 3)
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert len(np.unique(edges, axis=0)) == 18
    a, b, c = positions[triangles].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(SIDE**3, rel=1e-6)
    assert np.unique(positions.round(7), axis=0).tolist() == CORNERS.round(7).tolist()


def test_the_order_of_an_obj_file_is_kept() -> None:
    assert np.array_equal(read_file(BODY, textured().encode())["positions"][0], CORNERS)
    assert counts_of(textured().encode()) == (8, 12)


def test_counts_are_those_of_the_file() -> None:
    assert counts_of(binary_stl()) == (36, 12)
    assert counts_of(ply("ascii")) == (8, 12)


def scene_with(file: str, **body: Any) -> Scene:
    return Scene.model_validate(
        {
            "format": "stickslip-scene/1",
            "duration": 1.0,
            "sheets": {
                "towel": {
                    "material": "gray-interlock",
                    "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [2, 2]},
                }
            },
            "bodies": {"cube": {"type": "mesh", "file": file, **body}},
            "default_friction": 0.3,
        }
    )


def test_welded_vertices_are_stated() -> None:
    digest = "0" * 64
    scene = scene_with(f"sha256:{digest}")
    (note,) = weld_notes(scene, {digest: binary_stl()})
    assert note.startswith("bodies.cube.file: 28 of 36 vertices were at the position of another")
    assert not list(weld_notes(scene, {digest: obj().encode()}))
    assert not list(weld_notes(scene, {}))


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "must be an OBJ, STL, PLY or NPZ file, and is none"),
        (obj().encode().replace(b"f 1", b"f 99"), r"line 10 .* and is 'f 99 2 4 3'"),
        (obj().encode().replace(b"f 1", b"f 0"), r"line 10 .* and is 'f 0 2 4 3'"),
        (obj().replace(" ", " \\\n ").replace("f \\\n 1", "f x").encode(), "line 34 must be"),
        (b"v 0 0 0\nv 1 0 0\nf 1 2\n", "line 3 must be"),
        (b"v 0 0 0\nv 0 0\nf 1 2\n", "line 2 must be"),
        (b"v 0 0 0\nv 0 0 200\nf 1 2\n", "line 2 must be a vertex within 100 m"),
        (
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 3 2\n",
            "each triangle must be there once, and 1 repeat",
        ),
        (binary_stl(scale=1000.0), r"0.001 to 10 m across, and is 40 m; did you mean mm\?"),
        (binary_stl(scale=1e-3), r"0.001 to 10 m across, and is 4e-05 m; did you mean 0.04 m\?"),
        (text_stl().replace("4", "x").encode(), "must be three numbers"),
        (text_stl().replace("endloop\n  endfacet", "", 1).encode(), "36 vertices and 11 facets"),
        (ply("ascii").replace(b"uchar", b"colour"), "must not have the line 'property colour red'"),
        (ply("ascii").replace(b"format ascii", b"comment"), "must have a format"),
        (ply("ascii").replace(b"property float x", b"property float u"), "with x, y and z"),
        (ply("ascii").replace(b"end_header", b"end"), "must have end_header"),
        (ply("ascii").replace(b"face 6", b"face 99"), "ends early or has other values"),
        (ply("binary_big_endian")[:-20], "ends early or has other values"),
        (ply("ascii").replace(b"4 0 1 3 2", b"4 0 1 3 9"), "vertices 0 to 7, and one names 9"),
        (ply("ascii").replace(b"4 0 1 3 2", b"2 0 1"), "3 to 1000 corners, and face 0 has 2"),
        (ply("ascii").replace(b"0.04 0 0", b"nan 0 0"), r"vertex 4 is at \(nan, 0, 0\) m"),
    ],
)
def test_a_broken_mesh_is_refused(data: bytes, rule: str) -> None:
    with pytest.raises(UnfitFileError, match=rule):
        read_file(BODY, data)


def ply_with_face_of(corners: int) -> bytes:
    header = ply("binary_little_endian").split(b"element face")[0]
    header += b"element face 1\nproperty list uint uchar vertex_indices\nend_header\n"
    return header + bytes(8 * 13) + struct.pack("<I", corners) + bytes(corners)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(obj().encode() + b"f 1 2 3\n" * 2_000_000, id="two million faces"),
        pytest.param(obj().encode() + b"f" + b" 1" * 8_000_000, id="a face of 8 million corners"),
        pytest.param(
            obj().encode() + b"f" + b" 1\\\n" * 4_000_000, id="a continued face of 4 million"
        ),
        pytest.param(ply_with_face_of(8_000_000), id="PLY: a face of 8 million corners"),
        pytest.param(
            ply("ascii").replace(b"face 6", b"face 2000000"), id="PLY: two million faces stated"
        ),
        pytest.param(
            ply("ascii").replace(b"edge 1", b"edge 9999999999"), id="PLY: edges beyond the file"
        ),
        pytest.param(bytes(80) + struct.pack("<I", 300_000) + bytes(15_000_000), id="binary STL"),
    ],
)
def test_a_mesh_beyond_the_limits_is_refused_at_once(data: bytes) -> None:
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(UnfitFileError):
        read_file(BODY, data)
    seconds = time.process_time() - began
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < 2.0
    assert peak < 100e6


# ---- Flat patterns and starts -----------------------------------------------------------------

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
PATTERN = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def test_a_pattern_may_repeat_its_coordinates() -> None:
    repeated = SQUARE + PATTERN + PATTERN + "f 1/1 2/2 3/3\nf 1/5 3/7 4/4\n"
    pattern = read_file(MESH, repeated.encode())
    assert pattern["rest"].tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    assert pattern["triangles"].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_polygons_of_a_pattern_are_cut_in_the_pattern() -> None:
    # The start is folded flat upon itself, so only the pattern tells the triangles.
    folded = "v 0 0 0\nv 0 0 0.01\nv 0 1 0.01\nv 0 1 0\n"
    pattern = read_file(MESH, (folded + PATTERN + "f 1/1 2/2 3/3 4/4\n").encode())
    assert pattern["triangles"].tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        (
            SQUARE + PATTERN + "f 1/1 2/2 3/3\nf 1/2 3/3 4/4\n",
            "line 10: a vertex must have one texture coordinate, and 1 has two: unwrap",
        ),
        (SQUARE + PATTERN + "f 1/1 2/2 3/3\nf 1/1 3/3 4\n", "vertex 4 has none"),
        (SQUARE + "f 1 2 3 4\n", "must have texture coordinates .* vertex 1 has none"),
        (
            SQUARE + "v 0 0 0\nv 1 1 0\n" + PATTERN + "f 1/1 2/2 3/3\nf 5/1 6/3 4/4\n",
            "2 of 6 vertices are at the position of another one, such as 1 and 5: merge",
        ),
        (
            SQUARE + PATTERN.replace("1", "80") + "f 1/1 2/2 3/3 4/4\n",
            r"0.001 to 10 m across, and is 80 m; did you mean mm\?",
        ),
        (SQUARE + PATTERN + "f 1/1 4/4 3/3 2/2\n", "must have areas above 0"),
        (ply("ascii").decode(), "must be an OBJ file, whose texture coordinates"),
        (text_stl(), "must be an OBJ file, whose texture coordinates"),
    ],
)
def test_a_wrong_pattern_is_refused(data: str, rule: str) -> None:
    with pytest.raises(UnfitFileError, match=rule):
        read_file(MESH, data.encode())


def test_starts_ignore_texture_coordinates_and_keep_all_vertices() -> None:
    assert np.array_equal(read_file(START, textured().encode())["positions"], CORNERS)
    twice = SQUARE + SQUARE + "f 1 2 3\nf 5 6 7\n"
    assert read_file(START, twice.encode())["positions"].shape == (8, 3)
    with pytest.raises(UnfitFileError, match="STL file has no such order"):
        read_file(START, binary_stl())


# ---- Frames -----------------------------------------------------------------------------------


def write_frames(folder: Path, names: list[str]) -> list[Path]:
    """Write the cube, a millimetre higher in each frame, and return the files by their names."""
    files = []
    for number, name in enumerate(names):
        raised = CORNERS + np.array([0, 0, 0.001 * number])
        vertices = "\n".join(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in raised)
        faces = "\n".join("f " + " ".join(str(corner + 1) for corner in face) for face in FACES)
        file = folder / name
        file.write_text(f"{vertices}\n{faces}\n")
        files.append(file)
    return sorted(files)


@pytest.mark.parametrize(
    "name", ["frame_{}.obj", "frame_{:04d}.obj", "cube {} final.OBJ", "a1_b{}.obj", "{}.obj"]
)
def test_frames_are_ordered_by_number(name: str, tmp_path: Path) -> None:
    files = write_frames(tmp_path, [name.format(number) for number in range(1, 13)])
    (tmp_path / "frame_1.mtl").write_text("newmtl red\n")
    data = frames_of(sorted(tmp_path.iterdir()), scene_with("frames", frame_rate=20.0), "frames")
    body = read_file(BODY, data)
    assert len(files) == 12
    assert body["positions"][:, 0, 2].tolist() == pytest.approx([0.001 * n for n in range(12)])
    assert body["times"].tolist() == pytest.approx([n / 20 for n in range(12)])


@pytest.mark.parametrize(
    ("names", "rule"),
    [
        (["f_1.obj", "f_2.obj", "f_4.obj"], "frame 3 is missing between 1 and 4"),
        (["f_1.obj", "f_01.obj"], "f_01.obj and f_1.obj have 1"),
        (["f_1.obj", "g_2.obj"], "must hold the frames of one body, and holds f_N.obj, g_N.obj"),
        (["f_1.obj", "last.obj"], "must have numbers in their names, .* last.obj has none"),
        (["notes.txt"], "must hold OBJ, PLY or STL files"),
    ],
)
def test_frames_in_doubt_are_refused(names: list[str], rule: str, tmp_path: Path) -> None:
    files = write_frames(tmp_path, names)
    with pytest.raises(UnfitFileError, match=rule):
        frames_of(files, scene_with("frames", frame_rate=20.0), "frames")


def test_frames_must_have_the_same_faces(tmp_path: Path) -> None:
    files = write_frames(tmp_path, ["f_1.obj", "f_2.obj"])
    files[1].write_text(files[1].read_text().replace("f 1 2 4 3", "f 2 4 3 1"))
    with pytest.raises(
        UnfitFileError, match=r"f_2\.obj must have the vertices and faces of f_1\.obj"
    ):
        frames_of(files, scene_with("frames", frame_rate=20.0), "frames")


def test_a_vertex_that_parts_from_its_twin_is_not_welded(tmp_path: Path) -> None:
    still = SQUARE + "v 0 0 0\nv 1 1 0\nf 1 2 3\nf 5 6 4\n"
    files = []
    for number, text in enumerate((still, still.replace("v 1 1 0\nf", "v 1 1 0.1\nf"))):
        file = tmp_path / f"f_{number}.obj"
        file.write_text(text)
        files.append(file)
    data = frames_of(files, scene_with("frames", frame_rate=1.0), "frames")
    # Vertices 1 and 5 stay together; 3 and 6 part in the second frame.
    assert read_file(BODY, data)["positions"].shape == (2, 5, 3)


def test_only_a_pattern_is_asked_for_texture_coordinates() -> None:
    assert read_polygons(textured().encode()).pattern is None


def random_obj(rng: np.random.Generator, corner: str, *, extra: str = "") -> str:
    """Return an OBJ file of random polygons; `corner` writes a corner with its vertex."""
    count = int(rng.integers(4, 30))
    lines = ["# a comment", "o thing"]
    lines += [f"v {x:.9g}  {y:.3e}\t{z:.6f}{extra}" for x, y, z in rng.uniform(-1, 1, (count, 3))]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in rng.uniform(0, 1, (count, 2))]
    lines += ["vn 0 0 1"]
    for _ in range(int(rng.integers(1, 9))):
        corners = rng.permutation(count)[: int(rng.integers(3, min(count, 7) + 1))]
        lines.append("f " + " ".join(corner.format(v=vertex + 1) for vertex in corners))
    return "\n".join(lines)


@pytest.mark.parametrize("corner", ["{v}", "{v}/{v}", "{v}//1", "{v}/{v}/1"])
@pytest.mark.parametrize("extra", ["", " 0.5 0.5 0.5"])
def test_tables_are_what_lines_are(corner: str, extra: str) -> None:
    """A plain file gives the same numbers as one that is read line by line."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        text = random_obj(rng, corner, extra=extra).encode()
        assert read_tables(text, with_pattern=True, farthest=FARTHEST) is not None
        # A comment behind a line is unusual, and changes nothing.
        unusual = text.replace(b"vn 0 0 1", b"vn 0 0 1 # up")
        assert read_tables(unusual, with_pattern=True, farthest=FARTHEST) is None
        plain, by_lines = read_polygons(text), read_polygons(unusual)
        for table, other in zip(plain, by_lines, strict=True):
            np.testing.assert_array_equal(table, other)


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -1\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2 3\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/2/3 2 3/4/5/6/7\n",
        "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 inf\nv 0 1 0\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 1e3\nv 0 1 0\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 x\nv 0 1 0\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf \n",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3.0\n",
        "v 0 0 0\nv 1 0 0\nf 1 2 3\nv 0 1 0\n",
        "f 1 2 3\n",
        "v 0 0 0\n",
        "",
    ],
)
def test_what_is_not_plain_is_read_by_lines(text: str) -> None:
    assert read_tables(text.encode(), with_pattern=False, farthest=FARTHEST) is None
