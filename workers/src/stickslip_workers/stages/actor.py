"""The stages as an object that a process holds, with JSON on both sides, as the renderer has it."""

from typing import Any

from pydantic import TypeAdapter
from stickslip_schemas.documents.tasks import Task, TaskResult
from stickslip_schemas.store import open_store

from stickslip_workers import builds, progress
from stickslip_workers.kinds import kind_names
from stickslip_workers.stages.run import AnyTask, run_tasks

_tasks: TypeAdapter[list[AnyTask]] = TypeAdapter(list[Task])
_results = TypeAdapter(list[TaskResult])


class StageActor:
    """Runs simulate, pack and publish."""

    def __init__(self, store: str) -> None:
        self._store = open_store(store)

    def describe(self) -> dict[str, Any]:
        """Return the builds of what runs here, and versions for people."""
        return {
            "builds": {name: builds.kind_builds(name) for name in kind_names()},
            "versions": builds.versions(),
        }

    def run(self, tasks: str) -> str:
        """Run tasks, see `run_tasks`."""
        progress.forget()
        try:
            return _results.dump_json(run_tasks(_tasks.validate_json(tasks), self._store)).decode()
        finally:
            progress.forget()

    def frames(self) -> tuple[int, int] | None:
        """Return how far the simulation is that runs, from another thread: frames done, and frames."""
        return progress.told()
