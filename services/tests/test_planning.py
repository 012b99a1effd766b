"""Jobs of many samples: planned piece by piece, by any coordinator, while others work."""

from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from sqlalchemy import select
from stickslip_schemas.base import JobState, Reason, Stage
from stickslip_schemas.documents.responses import JobStateEvent, Progress
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.cli.progress import planned_so_far
from stickslip_services.client import Client
from stickslip_services.database.tables import job_tasks, jobs, samples, task_dependencies, tasks
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, resume_job
from stickslip_services.queue.existing_datasets import check_existing_datasets
from stickslip_services.queue.plan import expand
from stickslip_services.queue.planner import Planner, release_claims
from stickslip_services.queue.rows import PlanInputs
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import serving, start_server, wait_until
from stickslip_testing.worker import BUILDS, DirectApi, PretendWorker, failure, rejection

pytestmark = pytest.mark.databases

PIECE = 4
GRID = rods(gamma=(1.0, 2.0, 3.0, 4.0, 5.0), phi1=(1.0, 2.0, 3.0))
"""15 samples in shards of 2: pieces of 4, 4, 4 and 3."""


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"plan_samples": PIECE})


def submit(context: Context, document: dict[str, Any] = GRID, **options: Any) -> str:
    job = submit_job(context, parsed(document), None, **options)
    return job.id  # type: ignore[union-attr]


def check(context: Context) -> None:
    with context.database.read() as connection:
        assert violations(connection) == []


def written(context: Context, job_id: str) -> tuple[Any, ...]:
    """Return the plan of a job as it is in the database, by keys: tasks, what they build on, and
    samples.
    """
    needed = tasks.alias()
    with context.database.read() as connection:
        job = connection.scalar(select(jobs.c.seq).where(jobs.c.id == job_id))
        names = dict(connection.execute(select(tasks.c.seq, tasks.c.key)).all())
        of_job = job_tasks.c.task == tasks.c.seq, job_tasks.c.job == job
        columns = [
            tasks.c[name]
            for name in ("key", "stage", "build", "preview", "cost_group", "waiting_on")
        ]
        tasks_of_job = connection.execute(
            select(*columns).join(job_tasks, of_job[0]).where(of_job[1])
        ).all()
        edges = connection.execute(
            select(tasks.c.key, needed.c.key)
            .join(task_dependencies, task_dependencies.c.task == tasks.c.seq)
            .join(needed, needed.c.seq == task_dependencies.c.depends_on)
            .join(job_tasks, of_job[0])
            .where(of_job[1])
        ).all()
        slots = connection.execute(
            select(samples).where(samples.c.job == job).order_by(samples.c.slot)
        ).all()
    return (
        sorted(map(tuple, tasks_of_job)),
        sorted(map(tuple, edges)),
        [
            (row.slot, row.key, names[row.simulate_task], names.get(row.render_task), row.split)
            for row in slots
        ],
    )


def planned(document: dict[str, Any]) -> tuple[Any, ...]:
    """Return what `written` gives of a job of which nothing was done before."""
    plan = expand(parsed(document), PlanInputs(BUILDS, None), previews=24)
    tasks_of_job = [
        (key, task.stage, task.build, task.preview, task.cost_group, len(task.depends_on))
        for key, task in plan.tasks.items()
    ]
    edges = [(key, needed) for key, task in plan.tasks.items() for needed in task.depends_on]
    return sorted(tasks_of_job), sorted(edges), [sample[:-1] for sample in plan.samples]


def test_previews_are_spread_evenly_from_the_first_slot_on() -> None:
    spec = parsed(rods(gamma=[float(gamma) for gamma in range(1, 11)], phi1=(1.0,)))
    plan = expand(spec, PlanInputs(BUILDS, None), previews=3)
    tasks_of_slots = {sample.slot: plan.tasks[sample.render_task] for sample in plan.samples}  # type: ignore[index]
    assert [slot for slot, task in tasks_of_slots.items() if task.preview] == [0, 3, 6]


RANGE = {"type": "linspace", "start": 1.0, "stop": 2.0, "num": 9}
GRIDS = {
    "product": GRID,
    "zip": rods() | {"combine": "zip", "axes": dict.fromkeys(("gamma", "phi0", "phi1"), RANGE)},
    "without pictures": GRID | {"views": None},
    "cloth": {
        "kind": "cloth_drag",
        "axes": {
            "material": "gray-interlock",
            "mu": [0.1, 0.2, 0.3],
            "texture": ["dots", "stripes"],
            "viewpoint": ["left", "right"],
        },
        "samples_per_shard": 3,
        "allow_uncertified": True,
    },
}


@pytest.fixture
def worker(context: Context) -> PretendWorker:
    return PretendWorker(
        DirectApi(context), context.store, kinds=("rod_hang", "cloth_drag")
    ).register()


@pytest.mark.parametrize("name", GRIDS)
def test_a_plan_in_pieces_is_the_plan_made_at_once(
    context: Context, worker: PretendWorker, name: str, planner: Planner
) -> None:
    job_id = submit(context, GRIDS[name])
    detail = show_job(context, job_id)
    assert (detail.state, detail.progress.planned, detail.progress.total) == (
        JobState.planning,
        0,
        0,
    )
    counts = []
    while planner.step():
        check(context)
        counts.append(show_job(context, job_id).progress.planned)
    assert counts[-1] == detail.sample_count
    assert len(counts) > 1
    assert counts == sorted(set(counts))
    assert show_job(context, job_id).state is JobState.queued
    assert written(context, job_id) == planned(GRIDS[name])


def test_a_small_job_is_planned_while_the_request_waits(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    detail = show_job(context, submit(context, rods()))
    assert (detail.state, detail.progress.planned, detail.progress.total) == (
        JobState.queued,
        4,
        11,
    )
    assert not planner.step()


def test_what_is_planned_runs_meanwhile_and_so_do_other_jobs(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    job_id = submit(context)
    other = submit(context, rods(gamma=(9.0,)))
    planner.step()
    assert worker.work() == (4 + 4 + 2) + (2 + 2 + 1 + 1)
    assert show_job(context, other).state is JobState.succeeded
    detail = show_job(context, job_id)
    assert (detail.state, detail.progress.done, detail.progress.total, detail.progress.planned) == (
        JobState.planning,
        10,
        10,
        4,
    )
    assert detail.started_at is not None
    assert detail.progress.eta is None
    planner.run()
    check(context)
    worker.work()
    detail = show_job(context, job_id)
    assert (detail.state, detail.progress.done, detail.progress.total) == (
        JobState.succeeded,
        39,
        39,
    )
    assert detail.progress.stages[Stage.simulate].cached == 0
    check(context)


def test_a_large_job_that_was_made_before_runs_nothing(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    first = submit(context)
    planner.run()
    worker.work()
    again = submit(context)
    planner.run()
    assert worker.lease() == ()
    check_existing_datasets(context)
    detail = show_job(context, again)
    assert detail.state is JobState.succeeded
    assert detail.dataset == show_job(context, first).dataset
    assert {
        stage: (counted.cached, sum(counted.counts.values()))
        for stage, counted in detail.progress.stages.items()
    } == {
        Stage.simulate: (15, 15),
        Stage.render: (15, 15),
        Stage.pack: (8, 8),
        Stage.publish: (1, 1),
    }
    check(context)


def test_rejections_of_earlier_pieces_reach_later_ones(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    """A simulation that has slots in two pieces is rejected before the second one is planned."""
    worker.judge = lambda task: rejection() if task.stage == "simulate" else None
    job_id = submit(context, GRIDS["cloth"])
    planner.step()  # slots 0 to 5; slots 4 to 7 share a simulation
    worker.work()
    planner.run()
    check(context)
    worker.work()
    detail = show_job(context, job_id)
    assert (detail.state, detail.rejected_count) == (JobState.failed, 12)
    assert detail.reason is Reason.no_valid_samples


def test_it_is_cancelled_half_planned_and_finished_by_another_job(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()
    cancel_job(context, job_id)
    check(context)
    assert not planner.step()
    detail = show_job(context, job_id)
    assert (detail.state, detail.progress.planned) == (JobState.cancelled, 4)
    assert worker.lease() == ()
    again = submit(context)
    planner.run()
    check(context)
    worker.work()
    assert show_job(context, again).state is JobState.succeeded
    check(context)


def test_a_pause_stops_the_planning_too(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()
    pause_job(context, job_id)
    assert not planner.step()
    assert worker.lease() == ()
    assert resume_job(context, job_id).state is JobState.planning
    planner.run()
    assert written(context, job_id) == planned(GRID)
    check(context)


def test_a_task_that_fails_ends_the_planning(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()
    for _ in range(context.settings.max_tries):
        worker.report((worker.lease(simulate=1)[0], failure(Reason.internal_error)))
        context.clock.advance(10)  # type: ignore[attr-defined]
        sweep(context)
    assert show_job(context, job_id).state is JobState.failed
    assert not planner.step()
    check(context)


def test_quarantined_tasks_do_not_end_a_job_that_is_being_planned(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()
    for _ in range(context.settings.max_tries):
        (bad, *further) = worker.lease(simulate=1)
        assert not further
        worker.report((bad, failure(Reason.renderer_crash)))
        context.clock.advance(10)  # type: ignore[attr-defined]
        sweep(context)
    worker.work()
    assert show_job(context, job_id).state is JobState.planning
    planner.run()
    worker.work()
    sweep(context)
    detail = show_job(context, job_id)
    assert (detail.state, detail.reason) == (JobState.failed, Reason.quarantined)
    check(context)


def test_a_plan_that_cannot_be_made_fails_the_job_and_says_why(
    context: Context, worker: PretendWorker, monkeypatch: pytest.MonkeyPatch, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()

    def broken(*_: Any, **__: Any) -> Any:
        raise ValueError("the axis bends")

    monkeypatch.setattr("stickslip_services.queue.planner.pieces", broken)
    planner = Planner(context)
    with context.database.write() as connection:
        release_claims(connection)
    assert planner.step()
    detail = show_job(context, job_id)
    assert (detail.state, detail.reason) == (JobState.failed, Reason.internal_error)
    assert detail.message == "planning it failed after 4 of 15 samples: the axis bends"
    assert worker.lease() == ()
    check(context)


def test_another_coordinator_goes_on_when_the_first_one_has_died(
    context: Context, worker: PretendWorker, clock: ManualClock, planner: Planner
) -> None:
    job_id = submit(context)
    planner.step()
    other = Planner(context)
    assert not other.step()  # the job is claimed
    clock.advance(context.settings.lease_seconds)
    assert other.step()
    planner.step()  # back from the dead: it does not plan what is planned
    while other.step():
        check(context)
    assert written(context, job_id) == planned(GRID)


def test_jobs_wait_for_the_first_worker_and_are_planned_then(
    context: Context, planner: Planner
) -> None:
    job_id = submit(context)
    detail = show_job(context, job_id)
    assert (detail.state, detail.reason) == (JobState.queued, Reason.waiting_for_worker)
    assert not planner.step()
    PretendWorker(DirectApi(context), context.store).register()
    detail = show_job(context, job_id)
    assert (detail.state, detail.reason, detail.message) == (JobState.planning, None, "")
    planner.run()
    assert written(context, job_id) == planned(GRID)
    check(context)


def test_urgent_jobs_are_planned_first(
    context: Context, worker: PretendWorker, planner: Planner
) -> None:
    first = submit(context)
    urgent = submit(context, GRID | {"seed": 1}, priority=5)
    planner.step()
    assert [show_job(context, job).progress.planned for job in (first, urgent)] == [0, 4]


@pytest.mark.slow
@pytest.mark.real
def test_a_coordinator_that_is_killed_while_it_plans_goes_on_after_its_start(
    tmp_path: Path, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STICKSLIP_PLAN_SAMPLES", "200")
    axes = {
        "gamma": {"type": "linspace", "start": 1.0, "stop": 9.0, "num": 20},
        "phi0": {"type": "linspace", "start": 1.0, "stop": 9.0, "num": 40},
        "phi1": {"type": "linspace", "start": 1.0, "stop": 9.0, "num": 40},
    }
    document = {"kind": "rod_hang", "axes": axes}
    data = tmp_path / "data"
    counts, job_id = [0], ""
    for _ in range(4):
        server = start_server(data)
        with httpx.Client(base_url=server.url, trust_env=False) as client:
            if not job_id:
                server.worker()
                job_id = client.post("/v1/jobs", json=document).raise_for_status().json()["id"]
            wait_until(lambda: _planned(client, job_id) > counts[-1])  # noqa: B023  # it is over when the block is
            counts.append(_planned(client, job_id))
        server.process.kill()
        server.stop()
        assert counts[-1] < 32_000, "it was planned before it could be killed"
    context = Context.open(Settings.chosen(data=data))
    start(context)
    Planner(context).run()
    check(context)
    assert written(context, job_id) == planned(document)
    context.close()


def _planned(client: httpx.Client, job_id: str) -> int:
    count: int = client.get(f"/v1/jobs/{job_id}").json()["progress"]["planned"]
    return count


def test_people_see_how_far_the_plan_is(
    settings: Settings, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "stickslip_services.queue.background.PLAN_SECONDS", 1e6
    )  # it plans when the test calls it
    application = make_app(settings, clock=clock)
    context: Context = application.state.context
    planner = Planner(context)
    with serving(application) as url, httpx.Client(base_url=url, trust_env=False) as client:
        worker = PretendWorker(DirectApi(context), context.store).register()
        answer = client.post("/v1/jobs", json=GRID)
        job = answer.raise_for_status().json()
        assert (answer.status_code, job["state"], job["progress"]["planned"]) == (
            202,
            "planning",
            0,
        )
        assert "0 of 15 samples are planned" in client.get(f"/jobs/{job['id']}").text
        planner.step()
        assert "4 of 15 samples are planned" in client.get(f"/jobs/{job['id']}").text
        assert (
            "4 of 15 samples are planned"
            in CliRunner().invoke(app, ["show", job["id"], "--url", url]).stdout
        )
        planner.run()
        assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "queued"
        assert "samples are planned" not in client.get(f"/jobs/{job['id']}").text
        worker.work()
        watched = CliRunner().invoke(app, ["watch", job["id"], "--url", url])
        assert watched.exit_code == 0
        assert watched.stdout.endswith(": succeeded\n")  # of an ended job only the end is shown
        with Client(url) as events_client:
            events = list(events_client.events(job["id"]))
        states = [str(event.state) for event in events if isinstance(event, JobStateEvent)]
        places = [states.index(state) for state in ("planning", "queued", "succeeded")]
        assert places == sorted(places)


def test_progress_in_words() -> None:
    progress = Progress(done=2, total=9, planned=10_000, stages={}, eta=None)
    assert planned_so_far(progress, 1_000_000) == "10,000 of 1,000,000 samples are planned"
    assert planned_so_far(progress, 10_000) == ""
