"""A renderer for tests of the dispatcher: quick, and what it does to a task is the number of its
colour seed.
"""

import errno
import os
import sys
import time
from pathlib import Path
from typing import Any

from stickslip_schemas.documents.tasks import ChunkRef, RenderOutput, RenderTask, TaskResult
from stickslip_schemas.format.codecs import encode_chunk
from stickslip_schemas.store import open_store

BUILD = "2" * 64
FINE, DISK_FULL, BUG, UNTIL_RELEASED = range(4)


class RenderActor:
    """Has the face of stickslip_blender's. Tests and it talk through files beside the store."""

    def __init__(self, store: str) -> None:
        self._store = open_store(store)
        self._beside = Path(store)

    def describe(self) -> dict[str, Any]:
        return {"builds": {"rod_hang": BUILD}, "versions": {"fake": "1"}}

    def render(self, task: dict[str, Any]) -> dict[str, Any]:
        job = RenderTask.model_validate(task)
        behaviour = job.render.color_seed
        if behaviour == DISK_FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "artifacts")
        if behaviour == BUG:
            raise RuntimeError("a bug")
        if behaviour >= UNTIL_RELEASED:
            print(f"waits for release-{behaviour}", file=sys.stderr, flush=True)
            (self._beside / f"pid-{behaviour}").write_text(str(os.getpid()))
            while not (self._beside / f"release-{behaviour}").exists():
                time.sleep(0.01)
        chunk = encode_chunk(bytes(4 * 224 * 224 * 3))
        output = RenderOutput(
            chunks={
                "views": ChunkRef(digest=self._store.publish(chunk), offset=0, length=len(chunk))
            },
            labels={"color": [0.1, 0.2, 0.3]},
        )
        return TaskResult(outcome="succeeded", output=output, cpu_seconds=0.1).model_dump(
            mode="json"
        )
