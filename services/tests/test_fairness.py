"""Fair share: projects get equal numbers of leases, also where their jobs share tasks."""

from collections import Counter

import pytest
from sqlalchemy import select, update
from stickslip_schemas.base import JobState
from stickslip_services.database.tables import jobs, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, resume_job
from stickslip_services.queue.submit import submit_job
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import parsed, rods, show_job
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases(slow=True)

PROJECTS = 20
SAMPLES = 40


def submit_shared(context: Context) -> list[str]:
    """Submit a job in each of the projects; half of the tasks of each are the same for all."""
    submitted: list[str] = []
    for number in range(PROJECTS):
        of_project = [1000.0 * (1 + number) + index for index in range(SAMPLES // 2)]
        gamma = [*(1.0 + index for index in range(SAMPLES // 2)), *of_project]
        job = submit_job(context, parsed(rods(gamma=gamma, phi1=[1.0])), None)
        submitted.append(job.id)  # type: ignore[union-attr]
        with context.database.write() as connection:
            in_project = update(jobs).where(jobs.c.id == submitted[-1])
            connection.execute(in_project.values(project=f"project-{number:02}"))
    return submitted


def leased_by_project(context: Context) -> Counter[str]:
    with context.database.read() as connection:
        rows = connection.execute(
            select(jobs.c.project).join(tasks, tasks.c.leased_for == jobs.c.seq)
        )
        return Counter(project for (project,) in rows)


def test_projects_that_share_tasks_are_leased_the_same_number(
    context: Context, worker: PretendWorker
) -> None:
    submit_shared(context)
    for _ in range(5):
        assert len(worker.lease(simulate=64)) == 64
    counts = leased_by_project(context)
    assert set(counts.values()) == {5 * 64 // PROJECTS}
    with context.database.read() as connection:
        assert violations(connection) == []


def test_what_does_not_divide_evenly_goes_round(context: Context, worker: PretendWorker) -> None:
    """With 3 tasks a request, and each reported at once, no project is served twice before all."""
    submitted = submit_shared(context)
    served = Counter[str]()
    for _ in range(PROJECTS):
        leases = worker.lease(simulate=3)
        served.update(leased_by_project(context))
        worker.finish(*leases)
    assert set(served.values()) == {3}
    assert len(served) == len(submitted)


def test_pause_and_cancel_of_one_leave_the_others_alone(
    context: Context, worker: PretendWorker
) -> None:
    paused, cancelled, *running = submit_shared(context)
    assert pause_job(context, paused).state is JobState.paused
    assert cancel_job(context, cancelled).state is JobState.cancelled
    leases = worker.lease(simulate=10 * len(running))
    assert set(leased_by_project(context).values()) == {10}
    assert len(leased_by_project(context)) == len(running)
    worker.finish(*leases)
    assert resume_job(context, paused).state is JobState.queued
    worker.work()
    for job in (paused, *running):
        assert show_job(context, job).state is JobState.succeeded
    with context.database.read() as connection:
        assert violations(connection) == []
