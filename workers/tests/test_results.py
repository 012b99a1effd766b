"""Results: each failure has its reason.

Renders of one shading are merged, and their result is split.
"""

import errno
from pathlib import Path

import pytest
from ray import exceptions as ray_errors
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import (
    ChunkRef,
    RecordRef,
    RenderOutput,
    RenderTask,
    TaskResult,
)
from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.kinds.rod_hang import RodHangRender
from stickslip_schemas.store import CorruptArtifactError
from stickslip_workers.batching import merge_renders, shading_key, split_render_result
from stickslip_workers.dispatcher import process_failure
from stickslip_workers.process_log import TAIL_LETTERS, TAIL_LINES, ProcessLog
from stickslip_workers.stages.run import MESSAGE_LENGTH, failure

RECORD = RecordRef(digest="d" * 64, row=0)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), Reason.store_unavailable),
        (PermissionError(errno.EACCES, "Permission denied"), Reason.store_unavailable),
        (OSError(errno.EROFS, "Read-only file system"), Reason.store_unavailable),
        (OSError(errno.EIO, "Input/output error"), Reason.storage_error),
        (FileNotFoundError("artifact"), Reason.storage_error),
        (CorruptArtifactError("artifact"), Reason.storage_error),
        (CorruptChunkError("chunk"), Reason.storage_error),
        (MemoryError(), Reason.oom_killed),
        (ValueError("x" * 9999), Reason.internal_error),
    ],
)
def test_what_a_stage_raises(error: Exception, reason: Reason) -> None:
    result = failure(error)
    assert (result.outcome, result.reason) == ("failed", reason)
    assert len(result.message) <= MESSAGE_LENGTH


@pytest.mark.parametrize(
    ("error", "renders", "reason"),
    [
        (ray_errors.WorkerCrashedError(), True, Reason.renderer_crash),
        (ray_errors.WorkerCrashedError(), False, Reason.process_crash),
        (ray_errors.NodeDiedError("the node is gone"), True, Reason.worker_lost),
        (RuntimeError("node a is gone"), True, Reason.worker_lost),
        (ray_errors.OutOfMemoryError("low on memory"), True, Reason.oom_killed),
        (
            ray_errors.RayTaskError("render", "traceback", OSError(errno.ENOSPC, "full")),
            True,
            Reason.store_unavailable,
        ),
        (
            ray_errors.RayTaskError("render", "traceback", "not an exception"),
            True,
            Reason.internal_error,
        ),
    ],
)
def test_what_ray_raises(error: Exception, renders: bool, reason: Reason) -> None:
    assert process_failure(error, renders=renders).reason is reason


def test_a_message_has_what_a_dead_process_wrote_for_this_call(tmp_path: Path) -> None:
    path = tmp_path / "worker.err"
    path.write_text("of the call before\n")
    log = ProcessLog(str(path), path.stat().st_size)
    died = ray_errors.WorkerCrashedError()
    assert process_failure(died, renders=False, log=log).message == str(died)
    with path.open("a") as file:
        file.writelines(f"line {number}\n" for number in range(500))
        file.write("\n\nFatal Python error\n")
    message = process_failure(died, renders=False, log=log).message
    assert message.startswith(str(died)[:100])
    lines = message.partition("The end of its log:\n")[2].splitlines()
    assert lines[-2:] == ["line 499", "Fatal Python error"]
    assert len(lines) == TAIL_LINES
    assert "of the call before" not in message
    with path.open("a") as file:
        file.write("x" * 10**6)
    assert len(process_failure(died, renders=False, log=log).message) < MESSAGE_LENGTH
    # The process of another machine has no file here.
    elsewhere = ProcessLog(str(tmp_path / "elsewhere.err"), 0)
    assert process_failure(died, renders=False, log=elsewhere).message == str(died)


def test_a_message_names_the_signal_of_a_long_traceback(tmp_path: Path) -> None:
    path = tmp_path / "worker.err"
    frame = f'  File "/{"deep/" * 40}call.py", line 62 in work\n'
    signal = "Fatal Python error: Segmentation fault"
    modules = "Extension modules: " + "numpy, " * 500
    path.write_text(f"{signal}\n\nCurrent thread (most recent call first):\n{frame * 12}{modules}")
    message = process_failure(
        ray_errors.WorkerCrashedError(), renders=True, log=ProcessLog(str(path), 0)
    ).message
    lines = message.partition("The end of its log:\n")[2].splitlines()
    assert lines[0] == signal
    assert lines[-1] == frame.rstrip()
    assert len("\n".join(lines)) <= TAIL_LETTERS


def done(number: int) -> TaskResult:
    return TaskResult(
        outcome="succeeded", output=RenderOutput(chunks={"video": chunk(number)}, labels={})
    )


def clip(
    texture: str, *, preview: bool = False, record: RecordRef = RECORD, **look: object
) -> RenderTask:
    light_and_view = {
        "rig": "drag",
        "rig_digest": "0" * 64,
        "material": "gray-interlock",
        "texture": texture,
        "quality": "draft",
    }
    light_and_view |= {"viewpoint": "left", "instants": (0, 10), "light_seed": 1, "crease_seed": 2}
    render = ClothDragRender.model_validate(light_and_view | look)
    return RenderTask(render=render, record=record, preview=preview)


def chunk(number: int) -> ChunkRef:
    return ChunkRef(digest=f"{number:064x}", offset=0, length=1)


def test_only_the_texture_may_differ() -> None:
    same = shading_key(clip("dots"))
    assert shading_key(clip("plaid", preview=True)) == same
    further = [
        clip("dots", light_seed=2),
        clip("dots", viewpoint="right"),
        clip("dots", creases=0.5),
    ]
    further.append(clip("dots", ground_truth=("depth",)))
    further.append(clip("dots", record=RecordRef(digest="d" * 64, row=1)))
    assert same not in {shading_key(task) for task in further}
    with pytest.raises(ValueError, match="renders of one shading"):
        merge_renders([clip("dots"), further[0]])


def test_a_rod_shares_nothing() -> None:
    rod = RodHangRender(rig="rod-4", rig_digest="0" * 64, quality="draft", color_seed=1)
    task = RenderTask(render=rod, record=RECORD)
    assert shading_key(task) is None
    assert merge_renders([task]) is task
    with pytest.raises(ValueError, match="renders of one shading"):
        merge_renders([task, task])


def test_every_task_gets_its_own_clip_and_its_share_of_the_cost() -> None:
    tasks = [clip("dots"), clip("plaid", preview=True), clip("floral")]
    asked = merge_renders(tasks)
    assert (asked.textures, asked.preview) == (("dots", "plaid", "floral"), True)
    depth = {"depth": chunk(9)}
    outputs = [
        RenderOutput(
            chunks={"video": chunk(number), **depth},
            preview="e" * 64,
            labels={"psnr_cloth": 40.0 + number},
        )
        for number in range(2)
    ]
    poor = TaskResult(outcome="rejected", reason=Reason.poor_pictures, message="psnr_edge")
    all_three = [
        *(TaskResult(outcome="succeeded", output=output_of_task) for output_of_task in outputs),
        poor,
    ]
    output = RenderOutput(
        chunks={}, labels={}, clips=dict(zip(asked.textures, all_three, strict=True))
    )
    results = split_render_result(
        tasks, TaskResult(outcome="succeeded", output=output, cpu_seconds=6.0, wall_seconds=3.0)
    )
    assert [result.output.chunks for result in results[:2]] == [
        {"video": chunk(n), **depth} for n in range(2)
    ]
    assert [result.output.preview for result in results[:2]] == [None, "e" * 64]
    assert [result.output.labels for result in results[:2]] == [
        {"psnr_cloth": 40.0},
        {"psnr_cloth": 41.0},
    ]
    assert (results[2].outcome, results[2].reason) == ("rejected", Reason.poor_pictures)
    assert [(result.cpu_seconds, result.wall_seconds) for result in results] == [(2.0, 1.0)] * 3


def test_textures_of_the_users_own_go_by_their_pictures() -> None:
    """Two jobs may give one name to two pictures, and one picture may have two names."""
    first, other = (f"sha256:{digit * 64}" for digit in "12")
    tasks = [
        clip("dots"),
        clip("logo", image=first),
        clip("logo", image=other),
        clip("brand", image=first),
    ]
    asked = merge_renders(tasks)
    assert asked.textures == ("dots", first, other)
    output = RenderOutput(
        chunks={}, labels={}, clips={name: done(n) for n, name in enumerate(asked.textures)}
    )
    results = split_render_result(tasks, TaskResult(outcome="succeeded", output=output))
    assert [result.output.chunks["video"] for result in results] == [chunk(n) for n in (0, 1, 2, 1)]


def test_what_is_wrong_with_a_shading_is_wrong_with_all_its_clips() -> None:
    tasks = [clip("dots"), clip("plaid")]
    out = TaskResult(
        outcome="rejected", reason=Reason.out_of_frame, message="left", cpu_seconds=2.0
    )
    assert [(result.reason, result.cpu_seconds) for result in split_render_result(tasks, out)] == [
        (Reason.out_of_frame, 1.0)
    ] * 2
    lacking = RenderOutput(chunks={}, labels={}, clips={"dots": done(0)})
    results = split_render_result(tasks, TaskResult(outcome="succeeded", output=lacking))
    assert {result.outcome for result in results} == {"failed"}
