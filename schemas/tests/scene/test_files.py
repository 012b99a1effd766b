"""Files of scenes: what is read, and what is refused with the rule and what was found."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.base import sha256
from stickslip_schemas.scene import gate, surface_rules
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.files import (
    UnfitFileError,
    check_scene_file,
    counts_of,
    inlined,
    read_file,
    with_arrays,
)
from stickslip_schemas.scene.library import built_in_files, load_scene, scene_names

BODY, PATH = ("bodies", "block", "file"), ("bodies", "block", "motion", "path")
MESH, START = ("sheets", "towel", "mesh", "file"), ("sheets", "towel", "start", "file")
FLAT = b"v 0 0 1\nv 1 0 1\nv 0 1 1\nvt 0 0\nvt 0.1 0\nvt 0 0.1\nf 1/1 2/2 3/3\n"


def npz(**arrays: Any) -> bytes:
    """Return an NPZ file."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def frames(**arrays: Any) -> bytes:
    """Return a body of one triangle in two frames, but for some arrays."""
    usual = {
        "positions": np.zeros((2, 3, 3)),
        "triangles": np.array([[0, 1, 2]]),
        "times": np.arange(2.0),
    }
    return npz(**{**usual, **arrays})


PATH_FILE = b"time,x,y,z,rx,ry,rz\n0,0,0,0,0,0,0\n1.5,1,2,3,0,0,0.5\n"


def test_flat_patterns_have_counts() -> None:
    assert counts_of(FLAT) == (3, 1)
    assert counts_of(PATH_FILE) is None


def test_files_become_arrays() -> None:
    pattern = read_file(MESH, FLAT)
    assert pattern["rest"].tolist() == [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]
    assert pattern["positions"].tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]
    square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 -1//1\n"
    body = read_file(BODY, square)
    assert body["triangles"].tolist() == [[0, 1, 2], [0, 2, 3]]
    assert body["positions"].shape == (1, 4, 3)
    path = read_file(PATH, PATH_FILE)
    assert [path[name][-1].tolist() for name in ("time", "move", "turn")] == [
        1.5,
        [1.0, 2.0, 3.0],
        [0.0, 0.0, 0.5],
    ]
    again = read_file(PATH, npz(**path))
    assert all(np.array_equal(again[name], path[name]) for name in path)
    assert (
        read_file(START, npz(positions=pattern["positions"]))["positions"].tolist()
        == pattern["positions"].tolist()
    )


@pytest.mark.parametrize(
    ("place", "data", "rule"),
    [
        (BODY, b"", "must have faces, and has none, nor vertices: is it a mesh"),
        (BODY, b"v 0 0 0\nv 1 0\n", "line 2 must be a vertex within 100 m .*, and is 'v 1 0'"),
        (BODY, b"v 0 0 nan\n", "line 1 must be a vertex .*, and is 'v 0 0 nan'"),
        (BODY, b"v 0 0 1e9\n", "line 1 must be a vertex within 100 m .*, and is 'v 0 0 1e9'"),
        (
            BODY,
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
            "line 4 must be .* a face of its vertices, and is 'f 1 2 4'",
        ),
        (BODY, b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2\n", "triangle 0 names one twice"),
        (
            BODY,
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n",
            "must be a manifold: .* 1 edges are not so",
        ),
        (
            BODY,
            b"v 0 0 0\nv 0.1 0.1 0\nv 0.3 0.3 0\nf 1 2 3\n",
            r"areas above 0 m\^2, and triangle 0 has none",
        ),
        (BODY, frames(), "triangle 0 has none"),
        (BODY, b"\xff\xfe\x00", "must be text, or an NPZ file, and byte 2 is not of its encoding"),
        (BODY, b"PK\x03\x04 no archive", "must be an NPZ file, and its directory is missing"),
        (
            BODY,
            npz(positions=np.zeros((1, 3, 3))),
            "must have positions, triangles, times, and triangles, times is missing",
        ),
        (
            BODY,
            frames(times=[0.0, 0.0]),
            r"times must be instants that ascend from 0 s or later, and are 0, 0 \[s\]",
        ),
        (BODY, frames(times=[[0.0], [1.0]]), r"times must be \(2\), and is \(2, 1\)"),
        (BODY, frames(triangles=[[0, 1, 3]]), "triangles must be vertices, 0 to 2, and has 3"),
        (BODY, frames(triangles=[[0, 1.5, 2]]), "triangles must be vertices, 0 to 2, and has 1.5"),
        (
            BODY,
            frames(triangles=np.zeros((0, 3))),
            r"triangles must be \(triangle, 3\), and is \(0, 3\)",
        ),
        (
            BODY,
            frames(positions=np.zeros((0, 3, 3))),
            r"positions must be \(frame, vertex, 3\), and is \(0, 3, 3\)",
        ),
        (
            BODY,
            frames(positions=np.full((2, 3, 3), np.inf)),
            "positions must be finite numbers, and has inf",
        ),
        (
            BODY,
            frames(positions=np.full((2, 3, 3), 200.0)),
            "positions must be within 100 m, and reaches 200 m",
        ),
        (BODY, frames(positions=[None]), r"positions must be numbers, and its type is \|O"),
        (
            BODY,
            frames(rest=np.zeros((3, 3)), weights=np.zeros((3, 2)), bones=[1.0]),
            r"bones must be \(frame, 2, 3, 4\), and",
        ),
        (MESH, b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", r"must have texture coordinates .*\[m\]"),
        (
            MESH,
            FLAT.replace(b"1/1 2/2 3/3", b"1/1 3/3 2/2"),
            r"must have areas above 0 m\^2; 0 has -0.005",
        ),
        (
            MESH,
            FLAT + b"f 1/1 3/2 2/3\n",
            "line 8: a vertex must have one texture coordinate, and 3 has two",
        ),
        (
            START,
            npz(positions=np.zeros((3, 2))),
            r"positions must be \(vertex, 3\), and is \(3, 2\)",
        ),
        (
            PATH,
            b"t,x,y,z\n",
            "must begin with the line time,x,y,z,rx,ry,rz, and begins with 't,x,y,z'",
        ),
        (
            PATH,
            b"time,x,y,z,rx,ry,rz\n0,0,0,0,0,0\n",
            r"line 2 must be .*\[s, m, rad\], and is '0,0,0,0,0,0'",
        ),
        (
            PATH,
            b"time,x,y,z,rx,ry,rz\n1,0,0,0,0,0,0\n1,0,0,0,0,0,0\n",
            r"ascend from 0 s or later, and are 1, 1 \[s\]",
        ),
        (PATH, b"time,x,y,z,rx,ry,rz\n", r"ascend from 0 s or later, and are none \[s\]"),
        (
            PATH,
            npz(time=np.arange(2.0), move=np.zeros((2, 3)), turn=np.zeros((2, 2))),
            r"turn must be \(2, 3\), and is \(2, 2",
        ),
        (
            PATH,
            npz(time=0.0, move=np.zeros((1, 3)), turn=np.zeros((1, 3))),
            r"time must be \(time\), and is \(\)",
        ),
    ],
)
def test_a_file_that_does_not_fit_is_refused(
    place: tuple[str, ...], data: bytes, rule: str
) -> None:
    with pytest.raises(UnfitFileError, match=rule):
        read_file(place, data)


def test_a_small_file_cannot_ask_for_much_memory() -> None:
    data = npz(
        positions=np.zeros((1000, 1000, 3)),
        triangles=np.array([[0, 1, 2]]),
        times=np.arange(1000.0),
    )
    assert len(data) < 2**20
    with pytest.raises(UnfitFileError, match="bytes when unpacked"):
        read_file(BODY, data)


def test_meshes_have_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_rules, "MAX_VERTICES", 2)
    with pytest.raises(UnfitFileError, match="at most 2 vertices"):
        read_file(BODY, FLAT)
    monkeypatch.setattr(gate, "MAX_FILE_BYTES", 10)
    with pytest.raises(UnfitFileError, match="at most 10 bytes, and has"):
        counts_of(FLAT)


def scene(file: str) -> Scene:
    """Return a scene with a sheet from a file."""
    return Scene.model_validate(
        {
            "format": "stickslip-scene/1",
            "duration": 1.0,
            "sheets": {
                "towel": {"material": "gray-interlock", "mesh": {"type": "file", "file": file}}
            },
            "default_friction": 0.3,
        }
    )


def test_files_become_references_with_their_counts(tmp_path: Path) -> None:
    (tmp_path / "towel.obj").write_bytes(FLAT)
    whole, files = inlined(scene("towel.obj"), lambda name: (tmp_path / name).read_bytes())
    assert files == {sha256(FLAT): FLAT}
    assert whole.sheets["towel"].mesh.shape == (3, 1)
    ((place, name),) = whole.files()
    assert name == f"sha256:{sha256(FLAT)}"
    check_scene_file(whole, place, FLAT)
    assert with_arrays(whole, files.__getitem__)["sheets"]["towel"]["mesh"]["file"][
        "rest"
    ].shape == (3, 2)
    more = FLAT.replace(b"f 1", b"v 1 1 1\nvt 0.1 0.1\nf 2/2 4/4 3/3\nf 1")
    with pytest.raises(UnfitFileError, match=r"counts must be .* \[4, 2\], and are \[3, 1\]"):
        check_scene_file(whole, place, more)
    with pytest.raises(
        UnfitFileError,
        match=r"sheets.towel.mesh.file: must have faces, and has none, nor .*, in towel.obj",
    ):
        inlined(scene("towel.obj"), lambda _name: b"")


@pytest.mark.parametrize("name", scene_names())
def test_built_in_scenes_are_whole(name: str) -> None:
    loaded = load_scene(name)
    assert loaded.name == name
    assert loaded.description
    assert loaded.parameters
    for place, file in loaded.files():
        check_scene_file(loaded, place, built_in_files()[file.removeprefix("sha256:")])


def test_the_files_of_a_scene_are_limited_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of many files may be small enough, and reading all of them takes a minute."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    moving = {"positions": np.stack([corners, corners]), "triangles": np.array([[0, 1, 2]])}
    data = {
        "towel.obj": FLAT,
        "near.npz": npz(**moving, times=np.arange(2.0)),
        "far.npz": npz(**moving, times=2.0 * np.arange(2.0)),
    }
    sizes = {}
    for name, location in (("towel.obj", MESH), ("near.npz", BODY), ("far.npz", BODY)):
        arrays = read_file(location, data[name])
        sizes[name] = max(len(data[name]), sum(array.nbytes for array in arrays.values()))

    document = scene("towel.obj").model_dump(mode="json")
    body = {"type": "mesh", "file": "near.npz"}
    document["bodies"] = {"block": body, "other": body}
    limit = sum(sizes.values()) - 1
    monkeypatch.setattr(gate, "MAX_SCENE_BYTES", limit)
    # A file that two bodies name counts once.
    inlined(Scene.model_validate(document), data.__getitem__)
    document["bodies"]["other"] = body | {"file": "far.npz"}
    rule = rf"bodies\.other\.file: must have at most {limit} bytes together .*, in far\.npz"
    with pytest.raises(UnfitFileError, match=rule):
        inlined(Scene.model_validate(document), data.__getitem__)
    # The bytes of a file count before it is read.
    monkeypatch.setattr(gate, "MAX_SCENE_BYTES", len(FLAT) - 1)
    with pytest.raises(UnfitFileError, match="together"):
        inlined(scene("towel.obj"), lambda _name: FLAT.replace(b"f", b"?"))
