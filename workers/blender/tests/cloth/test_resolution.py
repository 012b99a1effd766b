"""Clips of any size: labels point at what the pictures show, to a twentieth of a pixel."""

import io
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from stickslip_blender.actor import RenderActor
from stickslip_blender.cloth import render_task
from stickslip_blender.cloth.geometry import CLOTH
from stickslip_blender.cloth.ground_truth import NOTHING, on_canvas
from stickslip_blender.raster import Window, decoded
from stickslip_schemas.documents.tasks import RenderOutput
from stickslip_schemas.format.codecs import decode_chunk, decode_clip
from stickslip_schemas.spec.cameras import Camera, rig_cameras
from stickslip_schemas.spec.names import Calibration
from stickslip_schemas.store import DirectoryStore
from stickslip_testing.render_tasks import cloth_task, output_of

SIZES = [(640, 480), (128, 128), (1280, 720), (360, 640), (223, 131)]
SIDE = 0.14
"""Of the cloth [m]."""
TOP = 0.15
"""Height of the held edge [m]."""
TEXELS = 512
RADIUS = 0.09
"""Of a mark, over the side of the cloth."""
MARKS = [(0.5, 0.5), (0.2, 0.25), (0.8, 0.2), (0.2, 0.8), (0.8, 0.75)]
"""Middles of the marks over the side of the cloth, from its lower left corner."""
PLAIN = 0.1
"""Share of a mark in a pixel, or of the cloth beside it, that counts as none."""
LABEL_TOLERANCE = 0.05
"""Largest distance of a mark in a picture from its label [px]."""


def _png(picture: npt.NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="PNG")
    return file.getvalue()


def _printed() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return black cloth with white marks, and white cloth."""
    middle = (np.arange(TEXELS) + 0.5) / TEXELS
    u, v = np.meshgrid(middle, middle[::-1])
    is_mark = np.zeros(u.shape, dtype=bool)
    for mark_u, mark_v in MARKS:
        is_mark |= np.hypot(u - mark_u, v - mark_v) < RADIUS
    marks = np.repeat(np.where(is_mark, 255, 0)[..., None], 3, axis=2).astype(np.uint8)
    return marks, np.full_like(marks, 255)


@pytest.fixture
def store(tmp_path: Any) -> DirectoryStore:
    return DirectoryStore(tmp_path / "store")


@pytest.fixture
def actor(store: DirectoryStore) -> RenderActor:
    return RenderActor(str(store.root))


@pytest.fixture
def record(store: DirectoryStore) -> str:
    """Digest of a flat cloth that hangs across the drag, at two instants."""
    line = np.linspace(-0.5 * SIDE, 0.5 * SIDE, 9)
    rest = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(81).reshape(9, 9)
    a, b, c, d = (number[i : 8 + i, j : 8 + j].ravel() for i in (0, 1) for j in (0, 1))
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    track = np.repeat(_placed(rest)[None], 2, axis=0)
    file = io.BytesIO()
    np.savez(
        file,
        positions=track[None].astype(np.float32),
        rest=rest[None].astype(np.float32),
        triangles=triangles[None].astype(np.int32),
    )
    return store.publish(file.getvalue())


def _placed(rest: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return places in the world (n, 3) of places on the flat cloth (n, 2) [m]."""
    height = TOP - 0.5 * SIDE + rest[:, 1]
    return np.column_stack([np.zeros(len(rest)), rest[:, 0], height])


def _frame(store: DirectoryStore, output: RenderOutput, size: tuple[int, int]) -> Any:
    chunk = output.chunks["video"]
    video = np.empty((1, size[1], size[0], 3), dtype=np.uint8)
    decode_clip(store.read(chunk.digest, offset=chunk.offset, length=chunk.length), video)
    return video[0]


def _values(store: DirectoryStore, output: RenderOutput, name: str, shape: Any, dtype: str) -> Any:
    chunk = output.chunks[name]
    values = np.empty(shape, dtype=dtype)
    decode_chunk(store.read(chunk.digest, offset=chunk.offset, length=chunk.length), values)
    return values


def _camera(size: tuple[int, int]) -> Camera:
    return next(camera for camera in rig_cameras("drag", size) if camera.name == "calibrated")


def _middle_of_mark(camera: Camera, mark: tuple[float, float]) -> npt.NDArray[np.float64]:
    """Return the centroid of the image of a mark, from its projection alone [px]."""
    step = np.linspace(-RADIUS, RADIUS, 201)
    u, v = np.meshgrid(step, step)
    inside = np.hypot(u, v) < RADIUS
    places = SIDE * (np.column_stack([u[inside], v[inside]]) + mark - 0.5)
    pixels, depth = camera.project(_placed(places))
    # A piece of a plane covers pixels in proportion to 1 / depth^3.
    middle: npt.NDArray[np.float64] = np.average(pixels, axis=0, weights=depth**-3)
    return middle


@pytest.mark.parametrize("size", SIZES)
def test_marks_are_where_their_labels_say(
    actor: RenderActor, store: DirectoryStore, record: str, size: tuple[int, int]
) -> None:
    """White marks over white cloth under the same light: their share of each pixel."""
    _check_marks(actor, store, record, _camera(size), resolution=size)


@pytest.mark.slow
def test_marks_are_where_a_lens_with_its_resolution_shows_them(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    """A camera of OpenCV with a distorted lens, in its own pixels."""
    size = (640, 480)
    pose = _camera((224, 224))
    rotation = np.asarray(pose.rotation)
    angle = np.arccos((np.trace(rotation) - 1.0) / 2.0)
    axis = (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]] / (2.0 * np.sin(angle))
    focal_length = pose.fx * size[1] / 224
    lens = Calibration(
        image_size=size,
        camera_matrix=((focal_length, 0.0, 322.0), (0.0, focal_length, 236.0), (0.0, 0.0, 1.0)),
        distortion=(-0.4, 0.2, 0.001, -0.0005, 0.0),
        rvec=tuple((angle * axis).tolist()),
        tvec=pose.translation,
        resolution=size,
    )
    camera = lens.camera("desk", (224, 224))
    assert (camera.width, camera.height) == size
    _check_marks(
        actor,
        store,
        record,
        camera,
        viewpoint="desk",
        camera=camera.model_dump(mode="json"),
        resolution=size,
    )


def _check_marks(
    actor: RenderActor, store: DirectoryStore, record: str, seen_by: Camera, **settings: Any
) -> None:
    """Render white marks and white cloth, and compare the marks with their labels."""
    size = (seen_by.width, seen_by.height)
    marks, white = (f"sha256:{store.publish(_png(picture))}" for picture in _printed())
    task = cloth_task(record, texture="marks", image=marks, textures=[marks, white], **settings)
    clips = output_of(actor, task).clips
    frames = [_frame(store, clips[name].output, size) for name in (marks, white)]
    level, lit = (decoded(frame).astype(float).sum(axis=2) for frame in frames)

    rows, columns = np.indices(level.shape)
    for mark in MARKS:
        expected = _middle_of_mark(seen_by, mark)
        reach = 1.35 * RADIUS * SIDE * seen_by.fx / seen_by.project(np.zeros((1, 3)))[1][0]
        near = np.hypot(columns - expected[0], rows - expected[1]) < reach
        share = level[near] / lit[near]
        share = (share - share.min()) / (np.median(share[share > 0.5]) - share.min())
        # Within the mark and beside it, only noise and light from other cloth differ from 1 and 0.
        share = np.where(share > 1.0 - PLAIN, 1.0, np.where(share < PLAIN, 0.0, share))
        middle = [np.average(place[near], weights=share) for place in (columns, rows)]
        assert np.abs(middle - expected).max() < LABEL_TOLERANCE, (mark, middle - expected)


@pytest.mark.parametrize("size", SIZES)
def test_masks_and_depth_are_those_of_the_projected_cloth(
    actor: RenderActor, store: DirectoryStore, record: str, size: tuple[int, int]
) -> None:
    width, height = size
    output = output_of(
        actor, cloth_task(record, resolution=size, ground_truth=["depth", "segmentation"])
    )
    depth = _values(store, output, "depth", (height, width), "float32")
    cloth = _values(store, output, "segmentation", (height, width), "uint8") == CLOTH
    camera = _camera(size)
    half = 0.5 * SIDE
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    pixels, _ = camera.project(_placed(corners))

    # The mask has the middle of the projected square, and its box is that of whole pixels.
    # Holders cover its upper corners, so the lower edge and both sides are compared.
    rows, columns = np.nonzero(cloth)
    box = np.array([columns.min(), columns.max(), rows.max()])
    expected = [pixels[:, 0].min(), pixels[:, 0].max(), pixels[:, 1].max()]
    assert np.abs(box - expected).max() <= 1.0

    # Depth, where the ray through the middle of a pixel meets the plane x = 0.
    ray = camera.rays() @ np.asarray(camera.rotation)
    plane = -camera.position[0] / ray[..., 0]
    middle = np.hypot(columns - pixels[:, 0].mean(), rows - pixels[:, 1].mean())
    inner = middle < 0.3 * np.ptp(pixels[:, 0])
    # The cloth of one layer is at its middle surface.
    np.testing.assert_allclose(
        depth[rows[inner], columns[inner]], plane[rows[inner], columns[inner]], atol=2e-5
    )


def test_a_smaller_picture_is_in_the_upper_left_of_its_frame(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    size = (160, 96)
    names = ["depth", "segmentation", "uv", "flow", "normals"]
    alone = output_of(actor, cloth_task(record, resolution=size))
    task = cloth_task(record, resolution=size, canvas=(200, 131), ground_truth=names)
    output = output_of(actor, task)
    frame = _frame(store, output, (200, 131))
    assert np.array_equal(frame[:96, :160], _frame(store, alone, size))
    assert not frame[96:].any()
    assert not frame[:, 160:].any()
    assert output.labels["picture_size"] == [160, 96]
    assert "picture_size" not in alone.labels
    depth = _values(store, output, "depth", (131, 200), "float32")
    assert np.isinf(depth[96:]).all()
    uv = _values(store, output, "uv", (131, 200, 2), "float16")
    assert np.isnan(uv[:, 160:]).all()


@pytest.mark.parametrize("name", NOTHING)
def test_a_frame_without_a_canvas_stays_as_it_is(name: str) -> None:
    frames = np.zeros((2, 3, 4))
    assert on_canvas(frames, None, NOTHING[name]) is frames


def test_bands_of_a_window_are_all_of_it() -> None:
    window = Window(3, 5, 4003, 6005)
    bands = list(window.bands(12))
    assert len(bands) > 100
    assert bands[0].top == 5
    assert bands[-1].bottom == 6005
    for upper, lower in pairwise(bands):
        assert upper.bottom == lower.top
    assert {(band.left, band.right) for band in bands} == {(3, 4003)}
    assert list(Window(0, 0, 0, 0).bands(12)) == [Window(0, 0, 0, 0)]


def test_bands_and_batches_change_no_picture(
    actor: RenderActor, store: DirectoryStore, record: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    textures = ["plaid", "dots", "checker", "stripes"]
    task = cloth_task(
        record, resolution=(223, 131), textures=textures, measured=1.0, substrate="ceramic"
    )
    whole = output_of(actor, task)
    monkeypatch.setattr("stickslip_blender.raster._BAND_SAMPLES", 40_000)
    monkeypatch.setattr("stickslip_blender.cloth.looks._FACTOR_PIXELS", 3_000)
    monkeypatch.setattr(render_task, "_BATCH_BYTES", 1)
    parts = output_of(RenderActor(str(store.root)), task)
    for name in textures:
        first, second = whole.clips[name].output, parts.clips[name].output
        frames = [_frame(store, output, (223, 131)) for output in (first, second)]
        assert np.abs(frames[0].astype(int) - frames[1]).max() <= 1
        assert (frames[0] != frames[1]).mean() < 1e-3
        assert second.labels["psnr_cloth"] == pytest.approx(first.labels["psnr_cloth"], abs=0.01)
