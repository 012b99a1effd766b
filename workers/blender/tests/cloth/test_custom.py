"""What users bring along: textures, cameras, lamps and floors of their own."""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from stickslip_blender.actor import RenderActor
from stickslip_blender.cloth.looks import drawn_light, drawn_substrate
from stickslip_blender.cloth.scene import ClothScene
from stickslip_blender.cloth.textures import SIZE, custom_texture, texture_image
from stickslip_schemas.documents.tasks import RenderOutput, input_digests, task_adapter
from stickslip_schemas.format.codecs import decode_clip
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.cameras import distorted, load_rig, rig_digest
from stickslip_schemas.spec.names import Calibration, FloorNumbers, LampNumbers, Texture
from stickslip_schemas.store import DirectoryStore
from stickslip_testing.render_tasks import cloth_task, output_of

Clip = npt.NDArray[np.uint8]

RED, BLUE = (200, 30, 30), (30, 40, 190)


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path / "store")


@pytest.fixture
def actor(store: DirectoryStore) -> Iterator[RenderActor]:
    return RenderActor(str(store.root))


@pytest.fixture
def record(store: DirectoryStore, make_sheet: Callable[..., Any]) -> str:
    """Digest of the trajectory of a sheet of 5 x 5 vertices."""
    sheet, file = make_sheet(5), io.BytesIO()
    track = np.repeat(sheet.track, 75, axis=0)
    np.savez(file, positions=track[None], rest=sheet.rest[None], triangles=sheet.triangles[None])
    return store.publish(file.getvalue())


def _png(picture: Clip) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="PNG")
    return file.getvalue()


def _flag() -> Clip:
    """A picture that is red above and blue below."""
    picture = np.empty((128, 128, 3), dtype=np.uint8)
    picture[:64], picture[64:] = RED, BLUE
    return picture


def _frame(store: DirectoryStore, output: RenderOutput, texture: str | None = None) -> Clip:
    chunk = (output if texture is None else output.clips[texture].output).chunks["video"]
    video = np.empty((1, 224, 224, 3), dtype=np.uint8)
    decode_clip(store.read(chunk.digest, offset=chunk.offset, length=chunk.length), video)
    return video[0]


def _colored(frame: Clip) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which pixels are red, and which are blue."""
    red, _, blue = (frame[..., k].astype(int) for k in range(3))
    return red > 2 * blue + 20, blue > 2 * red + 20


def test_a_texture_of_the_users_own_is_printed_on_the_cloth(
    actor: RenderActor, store: DirectoryStore, record: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its upper edge is the held one. It shares its shading with textures that are built in."""
    image = f"sha256:{store.publish(_png(_flag()))}"
    alone = output_of(actor, cloth_task(record, texture="my-flag", image=image))
    frame = _frame(store, alone)
    red, blue = _colored(frame)
    assert red.sum() > 300
    assert blue.sum() > 300
    assert (
        np.nonzero(red)[0].mean() < np.nonzero(blue)[0].mean() - 10
    )  # the cloth hangs from its upper edge
    monkeypatch.setattr(ClothScene, "shading", None)  # from here on nothing can be traced
    both = output_of(actor, cloth_task(record, textures=["dots", image]))
    assert both.clips[image].output == alone
    assert not np.array_equal(_frame(store, both, "dots"), frame)


def test_a_task_says_which_pictures_it_reads(store: DirectoryStore, record: str) -> None:
    digest = store.publish(_png(_flag()))
    custom = cloth_task(record, texture="my-flag", image=f"sha256:{digest}")
    together = cloth_task(record, textures=["dots", f"sha256:{digest}"])
    for task, expected in (
        (custom, (record, digest)),
        (together, (record, digest)),
        (cloth_task(record), (record,)),
    ):
        assert input_digests(task_adapter.validate_python(task), store.read) == expected


def test_a_picture_that_is_gone_is_an_error(actor: RenderActor, record: str) -> None:
    with pytest.raises(FileNotFoundError):
        actor.render(cloth_task(record, texture="my-flag", image=f"sha256:{'0' * 64}"))


def test_a_built_in_texture_as_a_file_is_the_texture() -> None:
    drawn = texture_image(Texture.floral)
    assert np.array_equal(custom_texture(_png(np.flipud(drawn))), drawn)
    assert custom_texture(_png(_flag())).shape == (SIZE, SIZE, 3)


def test_a_camera_of_the_users_own_sees_what_that_of_the_rig_sees(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    """The calibration of a camera of the rig, at twice the size, in a wide image."""
    (built_in,) = (camera for camera in load_rig("drag") if camera.name == "left")
    from math import acos

    R = np.asarray(built_in.rotation)
    angle = acos((np.trace(R) - 1.0) / 2.0)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (
        2.0 * np.sin(angle)
    )
    calibrated = Calibration(
        image_size=(648, 448),
        camera_matrix=(
            (2 * built_in.fx, 0.0, 2 * (built_in.cx + 0.5) - 0.5 + 100),
            (0.0, 2 * built_in.fy, 2 * (built_in.cy + 0.5) - 0.5),
            (0.0, 0.0, 1.0),
        ),
        distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
        rvec=tuple((angle * axis).tolist()),
        tvec=built_in.translation,
    ).camera("lab")
    for name in ("fx", "fy", "cx", "cy", "rotation", "translation"):
        np.testing.assert_allclose(getattr(calibrated, name), getattr(built_in, name), atol=1e-9)
    frame = _frame(
        store,
        output_of(
            actor, cloth_task(record, viewpoint="lab", camera=calibrated.model_dump(mode="json"))
        ),
    )
    expected = _frame(store, output_of(actor, cloth_task(record, viewpoint="left")))
    assert (np.abs(frame.astype(int) - expected) > 2).mean() < 0.002


def test_a_lens_shows_what_the_straight_camera_sees_elsewhere(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    built_in = load_rig("drag")[1]
    bent = built_in.model_copy(
        update={"distortion": (-2.0, 1.0, 0.01, -0.02, 0.0)}
    )  # of a lens that sees 25 degrees
    straight, curved = (
        _frame(
            store,
            output_of(
                actor, cloth_task(record, viewpoint="lab", camera=camera.model_dump(mode="json"))
            ),
        )
        for camera in (built_in, bent)
    )
    rows, columns = np.mgrid[:224, :224]
    x, y = distorted(
        (columns - built_in.cx) / built_in.fx, (rows - built_in.cy) / built_in.fy, bent.distortion
    )
    place = np.rint(
        np.stack([built_in.fy * y + built_in.cy, built_in.fx * x + built_in.cx])
    ).astype(int)
    assert np.abs(place - (rows, columns)).max() >= 8, "pixels by which the lens moves a corner"
    sampled = curved[place[0].clip(0, 223), place[1].clip(0, 223)]
    far, off = (np.abs(frame.astype(int) - straight).mean() for frame in (curved, sampled))
    assert off < 0.4 * far, "levels"


def test_lamps_and_floors_of_the_users_own(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    lamp = LampNumbers(azimuth=(-30.0, -20.0), elevation=(50.0, 50.0), power=(1.0, 1.2))
    floor = FloorNumbers(albedo=(0.5, 0.6), roughness=(0.8, 0.9), grain=0.0, tint=(0.2, 0.5, 1.0))
    light, ground = drawn_light("bench", 9, lamp), drawn_substrate("green-baize", 9, floor)
    assert (-30.0 <= light.azimuth <= -20.0, light.elevation, 1.0 <= light.power <= 1.2) == (
        True,
        50.0,
        True,
    )
    assert 0.5 <= ground.albedo <= 0.6
    assert np.mean(ground.tint) == pytest.approx(1.0)
    look = {
        "lighting": "bench",
        "lamp": lamp.model_dump(),
        "substrate": "green-baize",
        "finish": floor.model_dump(),
    }
    output = output_of(actor, cloth_task(record, **look))
    labels = output.labels
    assert (labels["lighting"], labels["substrate"]) == ("bench", "green-baize")
    assert (labels["light"], labels["floor"]) == (light.numbers, ground.numbers)

    corner = _frame(store, output)[:40, :40].reshape(-1, 3).mean(axis=0)
    assert corner[2] > 1.5 * corner[0] > 20, "a pale floor that is bluish"


def test_what_is_drawn_from_is_in_the_shading_and_pictures_are_not() -> None:
    plain = {
        "rig": "drag",
        "rig_digest": rig_digest("drag"),
        "quality": "preview",
        "material": "gray-interlock",
        "texture": "plaid",
        "viewpoint": "calibrated",
        "instants": (0,),
        "light_seed": 1,
        "crease_seed": 1,
    }
    lamp = {"azimuth": [0.0, 1.0], "elevation": [40.0, 41.0], "power": [1.0, 1.0]}
    finish = {"albedo": [0.1, 0.2], "roughness": [0.5, 0.6]}
    first = ClothDragRender.model_validate(plain)
    other = ClothDragRender.model_validate(
        plain | {"texture": "mine", "image": f"sha256:{'1' * 64}"}
    )
    assert first.shading == other.shading
    assert (first.variant, other.variant) == ("plaid", f"sha256:{'1' * 64}")
    for more in (
        {"lamp": lamp},
        {"finish": finish},
        {"camera": load_rig("drag")[1].model_dump(mode="json")},
    ):
        assert ClothDragRender.model_validate(plain | more).shading != first.shading
