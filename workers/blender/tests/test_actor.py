"""The actor end to end, on a store of its own."""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from pydantic import ValidationError
from stickslip_blender.actor import RenderActor
from stickslip_blender.color import silicone_color, to_linear
from stickslip_blender.rods import RodRenderer
from stickslip_schemas.cameras import Camera, rig_digest
from stickslip_schemas.chunks import decode_chunk
from stickslip_schemas.jobs import Quality
from stickslip_schemas.keys import is_sha256
from stickslip_schemas.states import Reason
from stickslip_schemas.store import CorruptArtifactError, Store
from stickslip_schemas.tasks import RenderOutput, TaskResult

LONG_WAY_DOWN = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -1.1), 150)  # a tenth too long for the rig


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


@pytest.fixture
def record(store: Store, curl: npt.NDArray[np.float64]) -> str:
    """Digest of three rods: the curl, one that leaves the frame, one that is not a rod."""
    file = io.BytesIO()
    np.savez(file, centerline=np.stack([curl, LONG_WAY_DOWN, curl * np.nan]).astype(np.float32))
    return store.publish(file.getvalue())


@pytest.fixture
def actor(store: Store) -> Iterator[RenderActor]:
    actor = RenderActor(str(store.root))
    yield actor
    actor.close()


def _task(record: str, *, row: int = 0, preview: bool = False, **look: Any) -> dict[str, Any]:
    render = {
        "kind": "rod_hang",
        "rig": "rod-4",
        "rig_digest": rig_digest("rod-4"),
        "quality": "draft",
        "color_seed": 5,
    }
    return {
        "stage": "render",
        "render": render | look,
        "record": {"digest": record, "row": row},
        "preview": preview,
    }


def _files(store: Store) -> set[str]:
    return {path.name for path in store.root.rglob("*") if path.is_file()}


def test_a_rod_becomes_a_chunk_and_a_preview(
    actor: RenderActor, store: Store, record: str, curl: npt.NDArray[np.float64], rig: tuple[Camera, ...]
) -> None:
    result = TaskResult.model_validate(actor.render(_task(record, preview=True)))
    assert result.outcome == "succeeded"
    assert isinstance(result.output, RenderOutput)
    assert result.output.labels == {"color": list(to_linear(silicone_color(5)))}
    assert result.cpu_seconds > 0.0
    assert result.wall_seconds > 0.0

    chunk = result.output.chunks["views"]
    data = decode_chunk(store.read(chunk.digest, offset=chunk.offset, length=chunk.length))
    views = np.frombuffer(data, dtype=np.uint8).reshape(1, 4, 224, 224, 3)[0]
    with RodRenderer(quality=Quality.draft) as renderer:
        assert np.array_equal(views, renderer.render(curl.astype(np.float32), rig, color=silicone_color(5)))

    assert result.output.preview is not None
    with Image.open(io.BytesIO(store.read(result.output.preview))) as preview:
        assert np.array_equal(np.asarray(preview), np.concatenate(list(views), axis=1))


def test_two_actors_give_the_same_digests(actor: RenderActor, store: Store, record: str) -> None:
    first = actor.render(_task(record))
    before = _files(store)
    other = RenderActor(str(store.root))
    second = other.render(_task(record))
    other.close()
    assert second["output"] == first["output"]
    assert _files(store) == before


def test_radius_and_seed_matter(actor: RenderActor, record: str) -> None:
    looks: list[dict[str, Any]] = [{}, {"radius": 0.01}, {"color_seed": 6}, {"quality": "standard"}]
    chunks = [actor.render(_task(record, **look))["output"]["chunks"]["views"]["digest"] for look in looks]
    assert len(set(chunks)) == 4


def test_a_rod_that_leaves_the_frame_is_rejected_with_the_view(actor: RenderActor, store: Store, record: str) -> None:
    before = _files(store)
    result = TaskResult.model_validate(actor.render(_task(record, row=1)))
    assert result.outcome == "rejected"
    assert result.reason is Reason.out_of_frame
    assert "the rod leaves view front by 14.7 px; " in result.message
    assert _files(store) == before


def test_a_centreline_of_nan_is_rejected(actor: RenderActor, record: str) -> None:
    result = TaskResult.model_validate(actor.render(_task(record, row=2)))
    assert result.outcome == "rejected"
    assert result.reason is Reason.invalid_sample


def test_what_is_not_the_samples_fault_is_raised(actor: RenderActor, store: Store, record: str) -> None:
    with pytest.raises(FileNotFoundError):
        actor.render(_task("0" * 64))
    with pytest.raises(ValueError, match=r"record\.row must be below 3"):
        actor.render(_task(record, row=3))
    with pytest.raises(ValueError, match=r"render\.rig_digest must be that of rod-4"):
        actor.render(_task(record, rig_digest="0" * 64))
    with pytest.raises(ValueError, match="rig must be one of"):
        actor.render(_task(record, rig="rod-5"))
    with pytest.raises(ValidationError):
        actor.render(_task(record, radius=-1.0))
    store.path(record).write_bytes(b"not what its name says")
    with pytest.raises(CorruptArtifactError):
        RenderActor(str(store.root)).render(_task(record))


_CRASH = """
import json, os, signal, sys
from stickslip_blender.actor import RenderActor
from stickslip_blender.pixels import FrameReader
FrameReader.read = lambda self, window=None: os.kill(os.getpid(), signal.SIGKILL)
RenderActor(sys.argv[1]).render(json.loads(sys.argv[2]))
"""


def test_a_crash_of_blender_leaves_everything_as_it_was(
    actor: RenderActor, store: Store, record: str, tmp_path: Path
) -> None:
    before = _files(store)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", _CRASH, str(store.root), json.dumps(_task(record))],
        capture_output=True,
        check=False,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    assert done.returncode == -signal.SIGKILL
    assert _files(store) == before
    assert list(temporary.iterdir()) == []
    assert actor.render(_task(record))["outcome"] == "succeeded"


def test_an_actor_says_which_build_it_is(actor: RenderActor, tmp_path: Path) -> None:
    description = actor.describe()
    assert is_sha256(description["build"])
    assert description["kinds"] == ["rod_hang"]
    assert set(description["versions"]) == {"bpy", "blender_build"}
    assert RenderActor(str(tmp_path / "elsewhere")).describe() == description
