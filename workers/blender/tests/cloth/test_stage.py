"""The stage of a scene: bodies as they are simulated, sheets with pictures, cameras that frame what
moves.
"""

import io
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from stickslip_blender.actor import RenderActor
from stickslip_blender.cloth.geometry import FLOOR, Geometry, gores, rounded
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_blender.cloth.shading import Composer
from stickslip_blender.cloth.stage import SUNK, Stage
from stickslip_blender.cloth.textures import texture_image
from stickslip_schemas.documents.tasks import RenderOutput, TaskResult
from stickslip_schemas.format.codecs import decode_chunk
from stickslip_schemas.kinds.cloth.arrays import scene_segments
from stickslip_schemas.scene.document import Staged
from stickslip_schemas.spec.cameras import FRAMING, framed
from stickslip_schemas.spec.names import Texture
from stickslip_schemas.store import DirectoryStore

INSTANTS = 3


def flat(width: float, height: float, cells: int) -> tuple[Any, Any]:
    """Return the vertices (V, 2) and triangles of a rectangle."""
    x, y = (np.linspace(-side / 2, side / 2, cells + 1) for side in (width, height))
    rest = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (number[i : cells + i, j : cells + j].ravel() for i in (0, 1) for j in (0, 1))
    return rest, np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)]).astype(
        np.int32
    )


def scene_and_record(screen: float | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a scene and its record: a sheet that rises over a cloth on the floor, bodies of all
    kinds, a holder.

    `screen` is the y of a wall before the sheet [m].
    """
    bodies: dict[str, Any] = {
        "ball": {"type": "sphere", "radius": 0.04, "origin": [0.3, 0.0, 0.04]},
        "block": {
            "type": "box",
            "size": [0.1, 0.08, 0.06],
            "rounding": 0.01,
            "origin": [-0.3, 0.0, 0.03],
        },
        "floor": {"type": "plane"},
        "peg": {"type": "capsule", "radius": 0.02, "length": 0.1, "origin": [0.0, 0.3, 0.07]},
        "tetrahedron": {"type": "mesh", "file": "tetrahedron.obj"},
    }
    if screen is not None:
        bodies["wall"] = {"type": "box", "size": [1.0, 0.02, 1.0], "origin": [0.0, screen, 0.5]}
    scene = Staged.model_validate(
        {
            "format": "stickslip-scene/1",
            "duration": 1.0,
            "frame_rate": INSTANTS - 1,
            "default_friction": 0.4,
            "sheets": {
                "rug": {
                    "material": "11oz-black-denim",
                    "mesh": {"type": "grid", "size": [0.6, 0.4], "cells": [6, 6]},
                },
                "towel": {
                    "material": "gray-interlock",
                    "mesh": {"type": "grid", "size": [0.2, 0.1], "cells": [6, 6]},
                },
            },
            "bodies": bodies,
            "looks": {
                "sheets": {"rug": {"texture": "stripes"}},
                "bodies": {"block": {"color": [0.6, 0.1, 0.05], "roughness": 0.3}},
            },
        }
    ).model_dump(mode="json")
    record: dict[str, Any] = {}
    for name, (rest, triangles), rise in (
        ("rug", flat(0.6, 0.4, 6), 0.0),
        ("towel", flat(0.2, 0.1, 6), 0.1),
    ):
        heights = 0.05 * (rise > 0.0) + rise * np.arange(INSTANTS)
        track = np.stack(
            [np.column_stack([rest, np.full(len(rest), height)]) for height in heights]
        )
        record |= {f"{name}.positions": track, f"{name}.rest": rest, f"{name}.triangles": triangles}
    poses = np.zeros((INSTANTS, len(bodies), 3, 4))
    poses[..., :3] = np.eye(3)
    for number, body in enumerate(scene["bodies"].values()):
        poses[:, number, :, 3] = body.get("origin", [0.0, 0.0, 0.0])
    poses[-1, 0, :, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the ball turns
    corners = np.array([(0, -0.3, 0), (0.1, -0.3, 0), (0, -0.2, 0), (0, -0.3, 0.1)])
    faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)], dtype=np.int32)
    hand = np.zeros((INSTANTS, 1, 3, 4))
    hand[..., :3], hand[:, 0, 2, 3] = np.eye(3), 0.05 + 0.1 * np.arange(INSTANTS)
    more = {"tetrahedron.rest": corners, "tetrahedron.triangles": faces, "body_pose": poses}
    return scene, record | more | {"holder_pose": hand, "holder_box": np.array([[0.0, 0.1, 0.0]])}


def staged(**options: Any) -> tuple[Stage, Geometry, Any]:
    scene, record = scene_and_record(**options)
    return *set_up(scene, record), record["towel.positions"]


def set_up(scene: dict[str, Any], record: dict[str, Any]) -> tuple[Stage, Geometry]:
    names = scene_segments(scene["sheets"], scene["bodies"])
    stage = Stage(scene, "towel", names, record, lambda name: texture_image(Texture(name)))
    return stage, Geometry(record["towel.triangles"], record["towel.rest"], stage)


@pytest.fixture(scope="module")
def usual() -> tuple[Stage, Geometry, Any]:
    return staged()


@pytest.mark.parametrize(
    ("core", "radius"), [((0, 0, 0), 0.05), ((0, 0, 0.1), 0.02), ((0.04, 0.03, 0.02), 0.01)]
)
def test_round_bodies_are_their_cores_grown_by_the_radius(
    core: tuple[float, float, float], radius: float
) -> None:
    vertices, faces = rounded(core, radius)
    inside = np.clip(vertices, np.negative(core), core)
    np.testing.assert_allclose(np.linalg.norm(vertices - inside, axis=1), radius)
    np.testing.assert_allclose(vertices.max(axis=0), np.add(core, radius))
    volume = sum(
        np.linalg.det(vertices[[face[0], b, c]]) / 6.0
        for face in faces
        for b, c in pairwise(face[1:])
    )
    a, b, c = 2.0 * np.array(core)
    exact = (
        a * b * c
        + 2 * radius * (a * b + b * c + c * a)
        + np.pi * radius**2 * (a + b + c)
        + 4 / 3 * np.pi * radius**3
    )
    assert volume == pytest.approx(exact, rel=0.03)  # outward, closed, and a polyhedron
    colors = gores(np.ones((1, 3)), len(faces))
    assert 0.4 < (colors[:, 0] < 0.5).mean() < 0.6


def test_bodies_are_where_the_record_has_them_and_a_little_inside(usual: Any) -> None:
    stage, _, track = usual
    assert stage.floor == FLOOR
    last = {
        prop.name: at
        for prop, at in zip(stage.props, stage.placed(INSTANTS - 1, track[-1]), strict=True)
    }
    assert [*last] == ["rug", "ball", "block", "peg", "tetrahedron", "holder-0"]
    np.testing.assert_allclose(np.linalg.norm(last["ball"] - [0.3, 0.0, 0.04], axis=1), 0.04 - SUNK)
    turned = stage.placed(0, track[0])[1] - [0.3, 0.0, 0.04]
    now = last["ball"] - [0.3, 0.0, 0.04]
    np.testing.assert_allclose(
        now, np.column_stack([-turned[:, 1], turned[:, 0], turned[:, 2]]), atol=1e-12
    )
    np.testing.assert_allclose(
        np.ptp(last["block"], axis=0), np.subtract([0.1, 0.08, 0.06], 2 * SUNK)
    )
    assert last["peg"][:, 2].max() == pytest.approx(0.07 + 0.05 + 0.02 - SUNK)
    assert last["holder-0"][:, 2].mean() == pytest.approx(0.25)
    assert (np.abs(last["rug"][:, 2]) < 0.002).all()


def test_everything_has_a_code_and_its_colour(usual: Any) -> None:
    stage, geometry, track = usual
    names = scene_segments(*(scene_and_record()[0][key] for key in ("sheets", "bodies")))
    camera = framed(
        "high", np.concatenate([track[-1], *stage.placed(2, track[-1])]), size=(224, 224)
    )
    points = geometry.points(track[-1], 2)
    truth = ground_truth(geometry, points, points, camera)
    visible = {names[code] for code in np.unique(truth["segmentation"])}
    assert visible == {*names} - {"background"}
    cloth = np.isin(truth["segmentation"], [names.index("rug"), names.index("towel")])
    assert np.isfinite(truth["uv"][cloth]).all()
    assert np.isnan(truth["uv"][~cloth]).all()
    assert np.nanmax(truth["uv"][..., 1]) < 0.68  # a picture covers the longer side
    floor = np.full((224, 224, 3), 3.0, dtype=np.float32)
    factor = Composer(geometry).floor_factor(points, camera, floor)
    red = factor[truth["segmentation"] == names.index("block")]
    np.testing.assert_allclose(np.median(red, axis=0), np.array([0.6, 0.1, 0.05]) / 0.25, rtol=1e-3)
    rug = factor[truth["segmentation"] == names.index("rug")]
    assert rug.mean() == pytest.approx(1.0, abs=0.15)
    assert rug[:, 1].std() > 0.5  # red and white stripes
    np.testing.assert_allclose(
        factor[truth["segmentation"] == names.index("towel")][:, 0].mean(), 1.0, atol=0.2
    )


@pytest.mark.parametrize("name", FRAMING)
def test_cameras_frame_what_moves_and_nothing_else(usual: Any, name: str) -> None:
    stage, geometry, track = usual
    camera = stage.camera(name, geometry, (224, 224))
    assert camera.position[1] < -0.2  # front: nothing hides the cloth there
    assert camera.overflow(track) == pytest.approx(camera.overflow(stage.moving()))
    assert -14.0 < camera.overflow(stage.moving()) < -6.0
    assert camera.position[2] > 0.1
    assert camera.overflow(stage.placed(0, track[0])[0]) > 0.0  # the rug lies still


def test_a_camera_goes_around_what_hides_the_cloth() -> None:
    stage, geometry, _ = staged(screen=-0.15)
    assert stage.camera("front", geometry, (224, 224)).position[1] > -0.05


def test_a_scene_without_a_plane_has_no_floor() -> None:
    scene, record = scene_and_record()
    record["body_pose"] = np.delete(record["body_pose"], [*scene["bodies"]].index("floor"), axis=1)
    del scene["bodies"]["floor"]
    stage, geometry = set_up(scene, record)
    points = geometry.points(record["towel.positions"][0], 0)
    truth = ground_truth(
        geometry, points, points, framed("front", record["towel.positions"], size=(224, 224))
    )
    assert stage.floor is None
    assert np.isinf(truth["depth"][truth["segmentation"] == 0]).all()
    assert (truth["segmentation"] == 0).any()


def test_an_actor_renders_a_scene(tmp_path: Any) -> None:
    """The clip, the ground truth and the label of the camera that framed it."""
    scene, record = scene_and_record()
    store = DirectoryStore(tmp_path / "store")
    file = io.BytesIO()
    np.savez(file, **{name: values[None] for name, values in record.items()})
    look = {
        "kind": "cloth_scene",
        "scene": scene,
        "quality": "preview",
        "texture": "plaid",
        "viewpoint": "high",
        "instants": (0, 2),
        "ground_truth": ["segmentation"],
        "light_seed": 1,
        "crease_seed": 2,
    }
    actor = RenderActor(str(store.root))
    task = {
        "stage": "render",
        "render": look,
        "record": {"digest": store.publish(file.getvalue()), "row": 0},
    }
    result = TaskResult.model_validate(actor.render(task))
    assert isinstance(result.output, RenderOutput), result.message
    assert set(result.output.chunks) == {"video", "segmentation"}
    camera = staged()[0].camera("high", staged()[1], (224, 224))
    np.testing.assert_allclose(result.output.labels["camera"], camera.numbers)

    chunk = result.output.chunks["segmentation"]
    codes = np.frombuffer(
        decode_chunk(store.read(chunk.digest, offset=0, length=chunk.length)), dtype=np.uint8
    )
    names = scene_segments(scene["sheets"], scene["bodies"])
    assert {names[code] for code in np.unique(codes)} >= {"towel", "rug", "floor", "holders"}


def corners_about(middle: Any, half: float) -> Any:
    """Return the corners (8, 3) of a cube."""
    return np.asarray(middle) + half * np.array(
        [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    )


def rays(camera: Any) -> Any:
    """Return the rays of depth 1 of all pixels, in camera axes, shape (height, width, 3)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
    )


def degrees_between(first: Any, other: Any) -> Any:
    return np.degrees(np.arccos(np.clip((first.astype(float) * other).sum(axis=-1), -1.0, 1.0)))


def test_a_ball_that_turns_has_the_normals_and_the_flow_of_its_formula() -> None:
    scene, record = scene_and_record()
    turn = np.radians(6.0)
    record["body_pose"][1, 0, :, :3] = [
        [np.cos(turn), -np.sin(turn), 0],
        [np.sin(turn), np.cos(turn), 0],
        [0, 0, 1],
    ]
    _, geometry = set_up(scene, record)
    now, then = (geometry.points(record["towel.positions"][0], k) for k in (0, 1))
    middle, radius = np.array([0.3, 0.0, 0.04]), 0.04 - SUNK
    camera = framed("high", corners_about(middle, 0.06), size=(224, 224))
    truth = ground_truth(geometry, now, then, camera)
    rows, columns = np.nonzero(
        truth["segmentation"] == scene_segments(scene["sheets"], scene["bodies"]).index("ball")
    )
    rotation, ray = np.asarray(camera.rotation), rays(camera)[rows, columns]
    center = rotation @ middle + camera.translation
    along, square = ray @ center, (ray**2).sum(axis=1)
    met = along**2 - square * (
        center @ center - radius**2
    )  # a ray meets the ball where this is positive
    is_inside = met > 0.1 * square * radius**2  # away from the silhouette
    assert is_inside.sum() > 4000
    normal = ((along - np.sqrt(np.maximum(met, 0.0))) / square)[:, None] * ray - center
    angle = degrees_between(truth["normals"][rows, columns], normal / radius)[is_inside]
    moved, _ = camera.project(normal @ rotation @ record["body_pose"][1, 0, :, :3].T + middle)
    error = np.linalg.norm(
        truth["flow"][rows, columns] - moved + np.column_stack([columns, rows]), axis=1
    )[is_inside]
    print(is_inside.sum(), np.percentile(angle, [50, 99]), np.percentile(error, [50, 99]))
    assert np.median(angle) < 1.0
    assert np.percentile(angle, 99) < 4.0
    assert np.percentile(error, 99) < 0.05


@pytest.mark.parametrize(
    ("name", "middle", "half"),
    [
        ("block", (-0.3, 0, 0.03), 0.06),
        ("holders", (0, 0, 0.05), 0.02),
        ("tetrahedron", (0.03, -0.27, 0.03), 0.06),
    ],
)
def test_normals_of_bodies_are_those_of_their_depth(
    usual: Any, name: str, middle: Any, half: float
) -> None:
    _, geometry, track = usual
    names = scene_segments(*(scene_and_record()[0][key] for key in ("sheets", "bodies")))
    camera = framed("high", corners_about(middle, half), size=(224, 224))
    points = geometry.points(track[0], 0)
    truth = ground_truth(geometry, points, points, camera)
    place = truth["depth"][..., None].astype(float) * rays(camera)
    normal = np.cross(np.gradient(place, axis=0), np.gradient(place, axis=1))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    near = np.lib.stride_tricks.sliding_window_view(normal, (7, 7), axis=(0, 1))
    is_smooth = np.pad(np.ptp(near, axis=(-2, -1)).max(axis=-1) < 0.02, 3) & (
        truth["segmentation"] == names.index(name)
    )
    angle = degrees_between(truth["normals"], normal)[is_smooth]
    print(name, is_smooth.sum(), (truth["segmentation"] == names.index(name)).sum())
    print(name, np.percentile(angle, [50, 99]) if len(angle) else "")
    assert is_smooth.sum() > 300
    assert np.median(angle) < 1.0
    assert np.percentile(angle, 99) < 4.0
