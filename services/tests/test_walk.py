"""The walk of a POST through the code: few files, and each is entered from one other file.

Then a reader can follow a submission from the top down, and comes back to no file.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from stickslip_services.api.routes.jobs import post_job
from stickslip_services.queue.context import Context
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.worker import PretendWorker

SOURCE = Path(sys.modules["stickslip_services.queue.context"].__file__ or "").parents[1]

INFRASTRUCTURE = {
    "access/principals.py",
    "addresses.py",
    "database/database.py",
    "database/statements.py",
    "queue/context.py",
    "queue/ids.py",
    "queue/integrity.py",
}
"""Files that every verb uses: addresses, database, principal, context, names, digests of rows."""

MAX_FILES = 12


def callers(frame: FrameType) -> Iterator[str]:
    """Yield the files of the services that called a function, the nearest first."""
    caller = frame.f_back
    while caller is not None:
        path = Path(caller.f_code.co_filename)
        if path.is_relative_to(SOURCE):
            yield path.relative_to(SOURCE).as_posix()
        caller = caller.f_back


def test_a_submission_enters_few_files_and_none_twice(
    context: Context, worker: PretendWorker
) -> None:
    entered_from: dict[str, set[str]] = {"api/routes/jobs.py": set()}

    def record(frame: FrameType, event: str, _argument: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event != "call" or not path.is_relative_to(SOURCE):
            return
        name = path.relative_to(SOURCE).as_posix()
        caller = next(callers(frame), name)
        if caller != name:
            entered_from.setdefault(name, set()).add(caller)

    spec = parsed(rods())
    before = sys.getprofile()
    sys.setprofile(record)
    try:
        answer = post_job(spec, context, "key of a walk", 0)
    finally:
        sys.setprofile(before)

    assert answer.status_code == 202
    walk = {name: files for name, files in entered_from.items() if name not in INFRASTRUCTURE}
    assert len(walk) <= MAX_FILES, sorted(walk)
    assert {name: files for name, files in walk.items() if len(files) > 1} == {}
    assert worker.finished_ids == []
