"""The actor end to end, on a store of its own."""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from pydantic import ValidationError
from stickslip_blender.actor import RenderActor
from stickslip_blender.cloth import quality
from stickslip_blender.cloth.looks import drawn_light, drawn_substrate
from stickslip_blender.cloth.scene import ClothScene
from stickslip_blender.cycles.engine import CLOTH_SAMPLING
from stickslip_blender.render_context import roots
from stickslip_blender.scenes.rod_hang import RodRenderer, silicone_color, to_linear
from stickslip_schemas.base import Reason, is_sha256
from stickslip_schemas.documents.tasks import ChunkRef, RenderOutput, TaskResult
from stickslip_schemas.format.codecs import decode_chunk, decode_clip
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.plan.builds import UNCOUNTED, sources
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_schemas.spec.cameras import Camera, rig_digest
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.spec.names import Texture
from stickslip_schemas.store import CorruptArtifactError, DirectoryStore
from stickslip_testing.render_tasks import rod_task

DOCUMENTS = tuple(
    f"stickslip_schemas/{name}.py" for name in ("kinds/cloth/spec", "spec/jobs", "spec/names")
)
"""Modules of documents, which are in the content key as a whole."""
LONG_WAY_DOWN = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -1.1), 150)  # a tenth too long for the rig


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path / "store")


@pytest.fixture
def record(store: DirectoryStore, curl: npt.NDArray[np.float64]) -> str:
    """Digest of three rods: the curl, one that leaves the frame, one that is not a rod."""
    file = io.BytesIO()
    np.savez(file, centerline=np.stack([curl, LONG_WAY_DOWN, curl * np.nan]).astype(np.float32))
    return store.publish(file.getvalue())


@pytest.fixture
def actor(store: DirectoryStore) -> Iterator[RenderActor]:
    return RenderActor(str(store.root))


def _files(store: DirectoryStore) -> set[str]:
    return {path.name for path in store.root.rglob("*") if path.is_file()}


def test_a_rod_becomes_a_chunk_and_a_preview(
    actor: RenderActor,
    store: DirectoryStore,
    record: str,
    curl: npt.NDArray[np.float64],
    rig: tuple[Camera, ...],
) -> None:
    result = TaskResult.model_validate(actor.render(rod_task(record, preview=True)))
    assert result.outcome == "succeeded"
    assert isinstance(result.output, RenderOutput)
    assert result.output.labels == {"color": list(to_linear(silicone_color(5)))}
    assert result.cpu_seconds > 0.0
    assert result.wall_seconds > 0.0

    chunk = result.output.chunks["views"]
    data = decode_chunk(store.read(chunk.digest, offset=chunk.offset, length=chunk.length))
    views = np.frombuffer(data, dtype=np.uint8).reshape(1, 4, 224, 224, 3)[0]
    renderer = RodRenderer(quality=Quality.draft)
    assert np.array_equal(
        views, renderer.render(curl.astype(np.float32), rig, color=silicone_color(5), seed=5)
    )

    assert result.output.preview is not None
    with Image.open(io.BytesIO(store.read(result.output.preview))) as preview:
        assert np.array_equal(np.asarray(preview), np.concatenate(list(views), axis=1))


def test_two_actors_give_the_same_digests(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    first = actor.render(rod_task(record))
    before = _files(store)
    other = RenderActor(str(store.root))
    second = other.render(rod_task(record))
    assert second["output"] == first["output"]
    assert _files(store) == before


def test_radius_and_seed_matter(actor: RenderActor, record: str) -> None:
    looks: list[dict[str, Any]] = [{}, {"radius": 0.01}, {"color_seed": 6}, {"quality": "standard"}]
    chunks = [
        actor.render(rod_task(record, **look))["output"]["chunks"]["views"]["digest"]
        for look in looks
    ]
    assert len(set(chunks)) == 4


def test_a_rod_that_leaves_the_frame_is_rejected_with_the_view(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    before = _files(store)
    result = TaskResult.model_validate(actor.render(rod_task(record, row=1)))
    assert result.outcome == "rejected"
    assert result.reason is Reason.out_of_frame
    assert "the rod leaves view front by 14.7 px; " in result.message
    assert _files(store) == before


def test_a_centreline_of_nan_is_rejected(actor: RenderActor, record: str) -> None:
    result = TaskResult.model_validate(actor.render(rod_task(record, row=2)))
    assert result.outcome == "rejected"
    assert result.reason is Reason.invalid_sample


def test_what_is_not_the_samples_fault_is_raised(
    actor: RenderActor, store: DirectoryStore, record: str
) -> None:
    with pytest.raises(FileNotFoundError):
        actor.render(rod_task("0" * 64))
    with pytest.raises(ValueError, match=r"record\.row must be below 3"):
        actor.render(rod_task(record, row=3))
    with pytest.raises(ValueError, match=r"render\.rig_digest must be that of rod-4"):
        actor.render(rod_task(record, rig_digest="0" * 64))
    with pytest.raises(ValueError, match="rig must be one of"):
        actor.render(rod_task(record, rig="rod-5"))
    with pytest.raises(ValidationError):
        actor.render(rod_task(record, radius=-1.0))
    store.path(record).write_bytes(b"not what its name says")
    with pytest.raises(CorruptArtifactError):
        RenderActor(str(store.root)).render(rod_task(record))


_CRASH = """
import json, os, signal, sys
from stickslip_blender.actor import RenderActor
from stickslip_blender.cycles.pixels import FrameReader
FrameReader.read_matte = lambda self, window=None: os.kill(os.getpid(), signal.SIGKILL)
RenderActor(sys.argv[1]).render(json.loads(sys.argv[2]))
"""


def test_a_crash_of_blender_leaves_everything_as_it_was(
    actor: RenderActor, store: DirectoryStore, record: str, tmp_path: Path
) -> None:
    before = _files(store)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", _CRASH, str(store.root), json.dumps(rod_task(record))],
        capture_output=True,
        check=False,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    assert done.returncode == -signal.SIGKILL
    assert _files(store) == before
    assert list(temporary.iterdir()) == []
    assert actor.render(rod_task(record))["outcome"] == "succeeded"


def test_an_actor_says_which_build_it_is(actor: RenderActor, tmp_path: Path) -> None:
    description = actor.describe()
    assert set(description["builds"]) == set(KINDS)
    assert all(map(is_sha256, description["builds"].values()))
    assert set(description["versions"]) == {"bpy", "blender_build", "device"}
    assert RenderActor(str(tmp_path / "elsewhere")).describe() == description


# --- cloth ---


@pytest.fixture
def trajectory(store: DirectoryStore, make_sheet: Callable[..., Any]) -> Callable[..., str]:
    """Publish the trajectory of a sheet of 5 x 5 vertices; return its digest."""

    def publish(*, shift: float = 0.0, reach: float = 0.3) -> str:
        sheet = make_sheet(5, reach=reach)
        track = np.repeat(sheet.track + np.float32([shift, 0.0, 0.0]), 75, axis=0)
        file = io.BytesIO()
        np.savez(
            file, positions=track[None], rest=sheet.rest[None], triangles=sheet.triangles[None]
        )
        return store.publish(file.getvalue())

    return publish


def _clip(record: str, *, preview: bool = False, frames: int = 3, **look: Any) -> dict[str, Any]:
    more = {name: look.pop(name) for name in ("textures",) if name in look}
    render = {
        "kind": "cloth_drag",
        "rig": "drag",
        "rig_digest": rig_digest("drag"),
        "material": "gray-interlock",
        "texture": "plaid",
        "viewpoint": "left",
        "instants": list(shown_frames(frames, 300)),
        "quality": "preview",
        "light_seed": 9,
        "crease_seed": 4,
    }
    task = {
        "stage": "render",
        "render": render | look,
        "record": {"digest": record, "row": 0},
        "preview": preview,
    }
    return task | more


def _video(store: DirectoryStore, chunk: ChunkRef, frames: int) -> Any:
    video = np.empty((frames, 224, 224, 3), dtype=np.uint8)
    decode_clip(store.read(chunk.digest, offset=chunk.offset, length=chunk.length), video)
    return video


def _output(result: dict[str, Any]) -> RenderOutput:
    output = TaskResult.model_validate(result).output
    assert isinstance(output, RenderOutput)
    return output


def test_a_trajectory_becomes_a_clip_a_preview_and_labels(
    actor: RenderActor, store: DirectoryStore, trajectory: Callable[..., str]
) -> None:
    output = _output(
        actor.render(_clip(trajectory(), preview=True, creases=0.5, substrate="ceramic"))
    )
    video = _video(store, output.chunks["video"], 3)
    assert len({frame.tobytes() for frame in video}) == 3
    light, floor = drawn_light("drawn", 9), drawn_substrate("ceramic", 9)
    labels = dict(output.labels)
    assert 0.02 < labels.pop("frame_share") < 0.3
    assert 0.5 < labels.pop("visible_share") <= 1.0
    assert labels == {
        "light_seed": 9,
        "light": light.numbers,
        "floor": floor.numbers,
        "lighting": "drawn",
        "substrate": "ceramic",
        "creases": 0.5,
        "psnr_cloth": None,
        "psnr_landed": None,
        "psnr_edge": None,
        "psnr_deviation": [None, None, None],
    }
    assert output.preview is not None
    with Image.open(io.BytesIO(store.read(output.preview))) as preview:
        assert (preview.format, preview.n_frames, preview.size) == ("WEBP", 3, (160, 160))


def test_every_function_that_renders_is_in_the_build(
    actor: RenderActor, record: str, trajectory: Callable[..., str]
) -> None:
    """But for what decides on nothing: the list of kinds finds a module by its name, and a store by
    its digest.
    """
    cloth = trajectory()
    tasks = {
        "rod_hang": (rod_task(record), rod_task(record)),
        "cloth_drag": (_clip(cloth, frames=1), _clip(cloth, frames=1, light_seed=10)),
    }
    for kind, (first, task) in tasks.items():
        actor.render(first)  # to import, and to close the renderer of the other kind, is no work
        called: set[str] = set()
        sys.setprofile(
            lambda frame, event, _, called=called: (
                called.add(frame.f_code.co_filename) if event == "call" else None
            )
        )
        actor.render(task)
        sys.setprofile(None)
        source_files = {
            Path(name).resolve()
            for name in called
            if "/stickslip_" in name and name.endswith(".py")
        }
        built = {path.resolve() for path in sources(roots(kind), cut=UNCOUNTED).values()}
        documents = {path for path in source_files if path.as_posix().endswith(DOCUMENTS)}
        uncounted = {
            path
            for path in source_files
            if path.parts[-3:] == ("stickslip_schemas", "kinds", "__init__.py")
        }
        uncounted |= {
            path for path in source_files if path.parts[-3:-1] == ("stickslip_schemas", "store")
        }
        assert len(source_files) > 8
        assert source_files - uncounted - documents <= built, source_files - built


def test_a_clip_has_the_same_bytes_however_its_shading_was_made(
    actor: RenderActor,
    store: DirectoryStore,
    trajectory: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Alone.

    With others; from a shading in the store; by an actor that has rendered something else.
    """
    cloth = trajectory()
    alone = _output(actor.render(_clip(cloth, frames=1)))
    other = RenderActor(str(store.root))
    other.render(_clip(cloth, frames=1, viewpoint="right", substrate="polyester-mirror"))
    several = _output(
        other.render(_clip(cloth, frames=1, textures=["floral", "plaid"], preview=True))
    )
    assert several.clips[Texture.plaid].output.chunks == alone.chunks
    assert several.clips[Texture.floral].output.preview is not None
    third = RenderActor(str(store.root))
    monkeypatch.setattr(ClothScene, "shading", None)  # from here on nothing can be traced
    later = _output(third.render(_clip(cloth, frames=1, textures=["plaid", "dots"])))
    assert later.clips[Texture.plaid].output == alone


def test_nothing_is_shaded_again_for_another_texture(
    actor: RenderActor, trajectory: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    traced: list[int] = []
    shading = ClothScene.shading

    def count(self: ClothScene, *arguments: Any) -> Any:
        traced.append(1)
        return shading(self, *arguments)

    monkeypatch.setattr(ClothScene, "shading", count)
    cloth = trajectory()
    clips = [
        _output(actor.render(_clip(cloth, frames=2, texture=texture))).chunks
        for texture in ("dots", "checker")
    ]
    assert len(traced) == 2
    assert clips[0] != clips[1]
    actor.render(_clip(cloth, frames=2, light_seed=10))
    assert len(traced) == 4


def test_what_is_below_its_floor_is_composed_of_a_finer_shading_or_rejected(
    actor: RenderActor, trajectory: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Textures that are measured together get their own numbers and results, the same as alone."""
    cloth = trajectory()
    task = _clip(cloth, frames=1, measured=0.15, textures=["checker", "stripes"])
    good = _output(actor.render(task)).clips
    levels = [good[name].output.labels["psnr_cloth"] for name in ("checker", "stripes")]
    assert 30.0 < min(levels) < max(levels) < 50.0
    alone = _output(actor.render(_clip(cloth, frames=1, measured=0.15, texture="stripes")))
    assert alone == good["stripes"].output
    floors = (0.5 * sum(levels), 0.0, 0.0)
    coarse = CLOTH_SAMPLING[Quality.preview]
    monkeypatch.setitem(CLOTH_SAMPLING, Quality.preview, replace(coarse, floors=floors))
    monkeypatch.setattr(quality, "DEVIATIONS", 0.0)
    better = _output(actor.render(task)).clips
    worse = "checker" if levels[0] < levels[1] else "stripes"
    assert better[worse].output.labels["psnr_cloth"] >= floors[0]
    monkeypatch.setitem(CLOTH_SAMPLING, Quality.preview, replace(coarse, floors=(99.0, 0.0, 0.0)))
    refused = _output(actor.render(task)).clips["checker"]
    assert (refused.outcome, refused.reason) == ("rejected", Reason.poor_pictures)
    assert "psnr_cloth must be at least 99 dB; got " in refused.message


def test_rods_and_cloths_take_turns(
    actor: RenderActor, record: str, trajectory: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[str] = []
    for renderer in (RodRenderer, ClothScene):

        def count(
            self: Any, *arguments: Any, _init: Any = renderer.__init__, **options: Any
        ) -> None:
            built.append(type(self).__name__)
            _init(self, *arguments, **options)

        monkeypatch.setattr(renderer, "__init__", count)
    cloth = trajectory()
    first = actor.render(_clip(cloth, frames=1))
    actor.render(
        _clip(
            cloth,
            frames=1,
            viewpoint="right",
            material="11oz-black-denim",
            substrate="any",
            creases=1.0,
        )
    )
    assert built == ["ClothScene"]  # built once for all looks of a mesh
    rod = actor.render(rod_task(record))
    again = actor.render(_clip(cloth, frames=1))
    assert built == ["ClothScene", "RodRenderer", "ClothScene"]  # Blender is one scene per process
    another = actor.render(_clip(cloth, frames=1, light_seed=2))
    assert built == ["ClothScene", "RodRenderer", "ClothScene"]
    assert again["output"] == first["output"] != another["output"]
    assert rod["outcome"] == "succeeded"


def test_a_cloth_that_leaves_the_frame_at_any_time_is_rejected(
    actor: RenderActor, store: DirectoryStore, trajectory: Callable[..., str]
) -> None:
    away = trajectory(
        reach=0.9
    )  # its first frame, the only one that the clip shows, is in the frame
    before = _files(store)
    result = TaskResult.model_validate(actor.render(_clip(away, frames=1)))
    assert (result.outcome, result.reason) == ("rejected", Reason.out_of_frame)
    assert "the cloth leaves view left by " in result.message
    assert _files(store) == before


def test_a_trajectory_of_nan_is_rejected(
    actor: RenderActor, trajectory: Callable[..., str]
) -> None:
    result = TaskResult.model_validate(actor.render(_clip(trajectory(shift=np.nan))))
    assert (result.outcome, result.reason) == ("rejected", Reason.invalid_sample)
