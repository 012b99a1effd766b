"""Replays one task on this machine, without Ray and coordinator: the reproducer of a failed task."""

import subprocess
import tempfile
from pathlib import Path

from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import AnyTask, RenderTask, TaskResult
from stickslip_schemas.store import open_store

from stickslip_workers.results import failed
from stickslip_workers.settings import RENDER_ACTOR
from stickslip_workers.stages.run import run_tasks

# Runs in Blender's interpreter. The answer goes to a file: Blender writes to standard output what it likes.
_RENDER = """
import importlib, json, sys
factory, store, task, answer = sys.argv[1:]
module, name = factory.split(":")
actor = getattr(importlib.import_module(module), name)(store)
with open(task) as file:
    result = actor.render(json.load(file))
with open(answer, "w") as file:
    json.dump(result, file)
"""


def replay(task: AnyTask, *, store: str, blender_python: Path, render_actor: str = RENDER_ACTOR) -> TaskResult:
    """Run a task and return its result; a render runs in Blender's interpreter."""
    if not isinstance(task, RenderTask):
        return run_tasks([task], open_store(store))[0]
    with tempfile.TemporaryDirectory() as scratch:
        given, answer = Path(scratch, "task.json"), Path(scratch, "result.json")
        given.write_text(task.model_dump_json())
        command = [blender_python, "-c", _RENDER, render_actor, store, given, answer]
        status = subprocess.run([str(word) for word in command], check=False).returncode
        if status != 0:
            return failed(Reason.renderer_crash, f"the renderer ended with status {status}")
        return TaskResult.model_validate_json(answer.read_bytes())
