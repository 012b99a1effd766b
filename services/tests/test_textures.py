"""Textures of users: uploaded, named by specs, kept while a job names them."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from stickslip_schemas.base import artifact_digest
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.documents.tasks import RenderTask
from stickslip_services.cli import app
from stickslip_services.client import Client
from stickslip_services.client.errors import ProblemError
from stickslip_services.errors import UnknownFileError
from stickslip_services.queue.context import Context
from stickslip_services.queue.maintenance import unused
from stickslip_services.queue.submit import submit_job
from stickslip_testing.jobs import parsed
from stickslip_testing.servers import RunningServer
from stickslip_testing.worker import DirectApi, PretendWorker

KINDS = ("rod_hang", "cloth_drag")
AXES = {
    "material": "gray-interlock",
    "mu": 0.3,
    "texture": ["dots", "logo"],
    "viewpoint": "calibrated",
}


def _png(side: int = 64, *, seed: int = 0, height: int | None = None) -> bytes:
    random = np.random.Generator(np.random.PCG64(seed))
    file = io.BytesIO()
    Image.fromarray(random.integers(0, 256, (height or side, side, 3), dtype=np.uint8)).save(
        file, format="PNG"
    )
    return file.getvalue()


def _spec(texture: str, **more: Any) -> dict[str, Any]:
    return {
        "kind": "cloth_drag",
        "allow_uncertified": True,
        "mesh": 5,
        "frames": 2,
        "axes": AXES,
        "textures": {"logo": texture},
        **more,
    }


@pytest.fixture
def client(shared_server: RunningServer) -> Iterator[Client]:
    shared_server.worker(kinds=KINDS)
    with Client(shared_server.url) as client_:
        yield client_


def test_a_texture_is_uploaded_once_and_named_by_a_spec(
    client: Client, shared_server: RunningServer
) -> None:
    entry = client.upload_texture(_png())
    assert (entry.side, entry.bytes) == (64, len(_png()))
    assert client.upload_texture(_png()) == entry
    digest = artifact_digest(entry.texture)
    assert digest is not None
    assert shared_server.store.read(digest) == _png()
    assert client.validate(_spec(entry.texture)).sample_count == 2
    job = client.submit(_spec(entry.texture))
    assert job.sample_count == 2


@pytest.mark.parametrize("verb", ["validate", "submit"])
def test_a_spec_with_an_unknown_texture_is_refused(
    client: Client, shared_server: RunningServer, verb: str
) -> None:
    digest = shared_server.store.publish(b"a trajectory, say")
    for texture, rule in (
        (f"sha256:{'0' * 64}", "stickslip upload"),
        (f"sha256:{digest}", "whole PNG or JPEG"),
    ):
        with pytest.raises(ProblemError) as caught:
            getattr(client, verb)(_spec(texture))
        (error,) = caught.value.problem.errors
        assert (caught.value.problem.status, error.pointer, error.value) == (
            422,
            "/textures/logo",
            f'"{texture}"',
        )
        assert rule in error.rule


@pytest.mark.parametrize(
    ("body", "media_type", "status", "rule"),
    [
        (
            _png(height=70),
            "image/png",
            422,
            "square, of 64 to 4096 pixels a side, and it has 64 x 70",
        ),
        (b"not a picture", "image/jpeg", 422, "whole PNG or JPEG"),
        (b"\xff\xd8\xff and no more", "image/jpeg", 422, "whole PNG or JPEG"),
        (_png(), "image/jpeg", 422, "of its Content-Type, image/jpeg"),
        (_png(), "application/json", 415, "Content-Type must be image/png or image/jpeg"),
        (bytes(17 * 2**20), "image/png", 413, "at most"),
    ],
)
def test_what_is_no_texture_is_refused(
    shared_server: RunningServer, body: bytes, media_type: str, status: int, rule: str
) -> None:
    answer = httpx.post(
        f"{shared_server.url}/v1/textures", content=body, headers={"Content-Type": media_type}
    )
    assert answer.status_code == status, answer.text
    assert rule in answer.json()["detail"]


def test_the_command_line_uploads_and_says_what_to_write(
    client: Client, shared_server: RunningServer, tmp_path: Path
) -> None:
    (tmp_path / "My Logo.png").write_bytes(_png(seed=2))
    (tmp_path / "text.png").write_text("no picture")

    def run(*words: object) -> Any:
        return CliRunner().invoke(
            app, [str(word) for word in words], env={"STICKSLIP_URL": shared_server.url}
        )

    done = run("upload", tmp_path / "My Logo.png")
    assert done.stdout == f"textures:\n  my-logo: {client.upload_texture(_png(seed=2)).texture}\n"
    for name, rule in (
        ("text.png", "text.png was refused: a texture must be"),
        ("none.png", "cannot be read"),
    ):
        failed = run("upload", tmp_path / name)
        assert (failed.exit_code, rule in failed.stderr) == (1, True), failed.output


def test_renders_of_one_trace_name_their_pictures(context: Context) -> None:
    worker = PretendWorker(DirectApi(context), context.store, kinds=KINDS).register()
    digest = context.store.publish(_png())
    variants: list[str] = []

    def look(task: Any) -> None:
        if isinstance(task, RenderTask):
            variants.append(task.render.variant)

    worker.judge = look
    job = submit_job(context, parsed(_spec(f"sha256:{digest}")), None)
    assert isinstance(job, JobDetail)
    worker.work()
    assert sorted(variants) == ["dots", f"sha256:{digest}"]


def test_a_texture_that_a_job_names_is_kept(context: Context) -> None:
    """Also of a job that waits for the first worker, and so has no tasks yet."""
    needed, other = (context.store.publish(_png(seed=seed)) for seed in (3, 4))
    submit_job(context, parsed(_spec(f"sha256:{needed}")), None)
    with pytest.raises(
        UnknownFileError, match="/textures/logo: must name a file that was uploaded"
    ):
        submit_job(context, parsed(_spec(f"sha256:{'1' * 64}")), None)
    names = [file.name for file in unused(context.database, context.store, older_than=-1)]
    assert names == [other]
