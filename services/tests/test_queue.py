"""The life of jobs and tasks: leases, fencing, retries, sharing, cancelling."""

from typing import Any

import pytest
from sqlalchemy import select
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import Dataset
from stickslip_schemas.documents.tasks import (
    AnyTask,
    PackTask,
    PublishSection,
    PublishTask,
    RenderTask,
    TaskResult,
)
from stickslip_schemas.documents.worker_api import LeaseRequest
from stickslip_schemas.plan.builds import Builds
from stickslip_services.catalog.versions import find_dataset
from stickslip_services.database.database import PageRequest
from stickslip_services.database.tables import tasks
from stickslip_services.errors import (
    ConflictError,
    KindNotAvailableError,
    NotFoundError,
    UnknownWorkerError,
)
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, resume_job
from stickslip_services.queue.documents import find_task
from stickslip_services.queue.job_states import has_exclusive_lease
from stickslip_services.queue.jobs import find_job, list_samples
from stickslip_services.queue.lease import lease_tasks
from stickslip_services.queue.rows import NEEDING_TASKS
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, list_datasets, list_jobs, parsed, rods, show_job
from stickslip_testing.worker import BUILDS, DirectApi, PretendWorker, failure, rejection

pytestmark = pytest.mark.databases


def submit(context: Context, **spec: Any) -> str:
    job = submit_job(context, parsed(rods(**spec)), None)
    assert not isinstance(job, tuple)
    return job.id  # type: ignore[union-attr]


def show_dataset(context: Context, dataset: str) -> Dataset:
    with context.database.read() as connection:
        return find_dataset(connection, dataset)


def show_task(context: Context, name: str) -> AnyTask:
    with context.database.read() as connection:
        return find_task(connection, name, context.store.publish)


def check(context: Context) -> None:
    with context.database.read() as connection:
        assert violations(connection) == []


def counts(context: Context, job: str, stage: Stage) -> dict[TaskState, int]:
    return show_job(context, job).progress.stages[stage].counts


def test_a_job_runs_from_grid_to_dataset(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context, name="first")
    assert show_job(context, job_id).state is JobState.queued
    first = worker.lease(simulate=1)
    assert show_job(context, job_id).state is JobState.running
    worker.finish(*first)
    assert worker.work() == 4 + 4 + 2 + 1 - 1
    job = show_job(context, job_id)
    assert (job.state, job.rejected_count, job.progress.done, job.progress.total) == (
        JobState.succeeded,
        0,
        11,
        11,
    )
    assert job.progress.stages[Stage.render].cpu_seconds == 8.0
    assert job.dataset is not None
    dataset = show_dataset(context, job.dataset.dataset)
    assert (dataset.name, [version.version for version in dataset.versions]) == ("first", [1])
    assert dataset.versions[0].manifest == job.dataset.manifest
    check(context)


def test_tasks_are_composed_of_what_they_build_on(context: Context, worker: PretendWorker) -> None:
    submit(context)
    (simulate, *further) = worker.lease(simulate=100)
    worker.report(
        (simulate, rejection("no equilibrium")),
        *((task, worker.result(task.task)) for task in further),
    )
    renders = worker.lease(render=100)
    assert len(renders) == 3
    assert all(isinstance(lease.task, RenderTask) and lease.task.preview for lease in renders)
    worker.finish(*renders)
    (first, second) = worker.lease(pack=100)
    assert isinstance(first.task, PackTask)
    rejected, good = first.task.slots
    assert rejected.rejection is not None
    assert (rejected.slot, rejected.valid, rejected.rejection.message) == (
        0,
        False,
        "no equilibrium",
    )
    assert rejected.rejection.labels == {"gamma": 1.0, "phi0": 0.0, "phi1": 1.0}
    assert good.labels == {
        "gamma": 1.0,
        "phi0": 0.0,
        "phi1": 3.0,
        "energy": 0.5,
        "color": [1.0, 0.5, 0.0],
    }
    assert good.record is not None
    assert set(good.chunks) == {"views"}
    worker.finish(first, second)
    (publish,) = worker.lease(publish=1)
    assert isinstance(publish.task, PublishTask)
    (digest,) = publish.task.sections
    section = PublishSection.model_validate_json(context.store.read(digest))
    assert [file.path for file in section.files] == ["views/c/0/0", "views/c/1/0"]
    assert len(section.labels) == 2
    assert [entry.slot for entry in section.rejections] == [0]
    assert (section.first, len(section.sample_keys)) == (0, 4)
    assert section.sample_keys[1] == good.sample_key
    worker.finish(publish)
    assert not context.store.exists(digest)
    check(context)


def test_nothing_is_rendered_where_no_views_are_wanted(
    context: Context, worker: PretendWorker
) -> None:
    job_id = submit(context, views=None)
    assert worker.work() == 4 + 2 + 1
    assert show_job(context, job_id).state is JobState.succeeded
    check(context)


def test_a_rejected_simulation_rejects_its_renders(context: Context, worker: PretendWorker) -> None:
    worker.judge = lambda task: (
        rejection() if task.stage == "simulate" and task.simulation.gamma == 1.0 else None
    )
    job_id = submit(context)
    worker.work()
    job = show_job(context, job_id)
    assert (job.state, job.rejected_count) == (JobState.succeeded_with_rejects, 2)
    assert "2 of 4 samples were rejected" in job.message
    with context.database.read() as connection:
        page = list_samples(
            connection, find_job(connection, job_id).seq, PageRequest(10, None), TaskState.rejected
        )
    assert [(item.slot, item.reason, item.message) for item in page.items] == [
        (0, Reason.solver_diverged, "it diverged"),
        (1, Reason.solver_diverged, "it diverged"),
    ]
    assert len([name for name in worker.finished_ids if name.startswith("render")]) == 2
    check(context)


def test_a_job_without_a_valid_sample_fails_and_publishes_nothing(
    context: Context, worker: PretendWorker
) -> None:
    def judge(task: Any) -> TaskResult | None:
        if task.stage != "simulate":
            return None
        if task.simulation.gamma == 2.0 and task.simulation.phi1 == 3.0:
            return rejection(reason=Reason.unconverged)
        return rejection()

    worker.judge = judge
    for _ in range(2):  # a second submission does not succeed either
        job_id = submit(context)
        worker.work()
        job = show_job(context, job_id)
        assert (job.state, job.reason) == (JobState.failed, Reason.no_valid_samples)
        assert job.message.startswith("0 of 4 samples are valid, so no dataset is published")
        assert "most often as solver_diverged (3 of 4)" in job.message
        assert (job.rejected_count, job.dataset) == (4, None)
        check(context)
    assert list_datasets(context) == ()
    assert list(context.store.versions("manifest.json")) == []


def test_the_same_grid_again_runs_nothing(context: Context, worker: PretendWorker) -> None:
    submit(context)
    worker.work()
    job_id = submit(context, name="again")
    assert show_job(context, job_id).state is JobState.queued  # its files are checked first
    sweep(context)
    again = show_job(context, job_id)
    assert again.state is JobState.succeeded
    assert again.dataset is not None
    assert again.dataset.version == 1
    assert [stage.cached for stage in again.progress.stages.values()] == [4, 4, 2, 1]
    assert worker.lease() == ()
    check(context)


def test_a_bigger_grid_runs_what_is_new(context: Context, worker: PretendWorker) -> None:
    submit(context)
    worker.work()
    count = len(worker.finished_ids)
    bigger = submit(context, gamma=(1.0, 2.0, 5.0))
    worker.work()
    job = show_job(context, bigger)
    assert job.state is JobState.succeeded
    assert (
        len(worker.finished_ids) - count == 2 + 2 + 1 + 1
    )  # two shards are those of the smaller grid
    assert job.progress.stages[Stage.simulate].cached == 4
    assert job.progress.stages[Stage.simulate].cpu_seconds == 4.0
    check(context)


def test_other_builds_make_another_version(context: Context, worker: PretendWorker) -> None:
    submit(context)
    worker.work()
    other = PretendWorker(
        DirectApi(context),
        context.store,
        name="new",
        builds=BUILDS.model_copy(update={"render": "e" * 64}),
    ).register()
    job_id = submit(context)
    other.work()
    job = show_job(context, job_id)
    assert job.dataset is not None
    assert job.dataset.version == 2
    assert job.progress.stages[Stage.simulate].cached == 4  # the simulator is the same
    assert len(show_dataset(context, job.dataset.dataset).versions) == 2
    check(context)


def test_a_stale_token_is_refused(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    (late,) = worker.lease(simulate=1)
    clock.advance(31)
    (again,) = worker.lease(simulate=1)
    assert (again.task_id, again.token, again.attempt) == (late.task_id, late.token + 1, 1)
    assert worker.finish(late) == ["stale"]
    assert worker.beat(late) == (late.task_id,)
    assert worker.finish(again) == ["accepted"]
    assert worker.finish(again) == ["duplicate"]
    assert worker.finish(late) == ["stale"]
    check(context)


def test_another_worker_cannot_report(context: Context, worker: PretendWorker) -> None:
    submit(context)
    (lease,) = worker.lease(simulate=1)
    thief = PretendWorker(DirectApi(context), context.store, name="thief").register()
    assert thief.finish(lease) == ["stale"]
    assert thief.beat(lease) == (lease.task_id,)
    assert worker.finish(lease, lease) == ["accepted", "duplicate"]
    check(context)


def test_a_heartbeat_keeps_a_lease(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    (lease,) = worker.lease(simulate=1)
    for _ in range(5):
        clock.advance(20)
        assert worker.start(lease) == ()
        sweep(context)
    assert worker.finish(lease) == ["accepted"]


def test_an_expired_lease_is_no_failed_try(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context)
    started, idle = worker.lease(simulate=2)
    worker.start(started)
    clock.advance(31)
    sweep(context)
    assert counts(context, job_id, Stage.simulate) == {
        TaskState.pending: 4
    }  # at once, without a wait
    leases = {lease.task_id: lease for lease in worker.lease(simulate=10)}
    assert (leases[started.task_id].attempt, leases[idle.task_id].attempt) == (2, 1)
    with context.database.read() as connection:
        assert connection.execute(
            select(tasks.c.tries, tasks.c.losses).order_by(tasks.c.seq)
        ).first() == (0, 1)
    check(context)


def test_three_failed_tries_fail_the_job(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context)
    poison, running, other, _ = worker.lease(simulate=4)
    worker.start(running)
    for tries in range(3):
        worker.report((poison, failure(Reason.internal_error, f"crash {tries}")))
        assert worker.lease(simulate=1) == ()  # it waits a little first
        clock.advance(10)
        worker.beat(running, other)
        leases = worker.lease(simulate=1)
        assert len(leases) == (1 if tries < 2 else 0)
        poison = leases[0] if leases else poison
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.failed, Reason.failed_tasks)
    assert "failed 3 times" in job.message
    assert "crash 2" in job.message
    assert f"/v1/tasks/{poison.task_id}" in job.message
    assert "stickslip_workers replay" in job.message
    assert worker.lease() == ()  # nothing further is started
    assert worker.beat(running, other) == (
        other.task_id,
    )  # what runs may finish, and the rest is dropped
    assert worker.finish(running) == ["accepted"]
    check(context)


def test_submitting_a_failed_job_again_tries_again(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    worker.judge = lambda task: failure() if task.stage == "render" else None
    first = submit(context)
    for _ in range(4):
        worker.work()
        clock.advance(10)
        sweep(context)
    assert show_job(context, first).state is JobState.failed
    worker.judge = lambda _task: None
    second = submit(context)
    check(context)
    worker.work()
    job = show_job(context, second)
    assert job.state is JobState.succeeded
    assert job.progress.stages[Stage.simulate].cached == 4
    assert show_job(context, first).state is JobState.failed
    check(context)


def test_a_failure_with_a_deterministic_reason_is_a_failure(
    context: Context, worker: PretendWorker
) -> None:
    job_id = submit(context)
    (task,) = worker.lease(simulate=1)
    worker.report((task, failure(Reason.solver_diverged)))
    assert counts(context, job_id, Stage.simulate)[TaskState.soft_failed] == 1


def test_a_released_task_waits_again_without_a_count(
    context: Context, worker: PretendWorker
) -> None:
    submit(context)
    (task,) = worker.lease(simulate=1)
    assert worker.report((task, None)) == ["accepted"]
    (again,) = worker.lease(simulate=1)
    assert (again.task_id, again.attempt, again.token) == (task.task_id, 1, task.token + 1)
    assert worker.report((task, None)) == ["duplicate"]
    assert worker.finish(again) == ["accepted"]
    check(context)


def test_a_new_session_takes_the_leases_of_the_old_one(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    started, idle = worker.lease(simulate=2)
    worker.start(started)
    successor = PretendWorker(DirectApi(context), context.store).register()
    assert worker.finish(started) == ["stale"]
    assert worker.beat(idle) == (idle.task_id,)
    with pytest.raises(ConflictError, match="another session"):
        worker.lease()
    clock.advance(1)
    attempts = {lease.task_id: lease.attempt for lease in successor.lease(simulate=10)}
    assert (attempts[started.task_id], attempts[idle.task_id], len(attempts)) == (2, 1, 4)
    check(context)


def test_an_unknown_worker_is_told_to_register(context: Context) -> None:
    with pytest.raises(UnknownWorkerError, match="register again"):
        lease_tasks(context, LeaseRequest(worker_id="worker-0", wanted={Stage.simulate: 1}))


def test_jobs_share_tasks_and_one_can_be_cancelled(context: Context, worker: PretendWorker) -> None:
    small = submit(context, gamma=(1.0,))
    big = submit(context)
    first = worker.lease(simulate=1)
    assert show_job(context, small).state is show_job(context, big).state is JobState.running
    check(context)
    assert (
        cancel_job(context, small).state is JobState.cancelled
    )  # what is leased, the other job needs
    check(context)
    assert worker.beat(*first, started=True) == ()
    worker.finish(*first)
    worker.work()
    assert show_job(context, big).state is JobState.succeeded
    assert show_job(context, small).state is JobState.cancelled
    check(context)
    assert (
        show_job(context, submit(context, gamma=(1.0,))).state is JobState.queued
    )  # its own last task only


def test_cancelling_drops_what_runs(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context)
    started, idle = worker.lease(simulate=2)
    worker.start(started)
    assert cancel_job(context, job_id).state is JobState.cancelling
    assert cancel_job(context, job_id).state is JobState.cancelling
    check(context)
    assert worker.lease() == ()
    assert set(worker.beat(started, idle)) == {started.task_id, idle.task_id}
    sweep(context)
    assert show_job(context, job_id).state is JobState.cancelled
    assert worker.finish(started) == ["stale"]
    assert cancel_job(context, job_id).state is JobState.cancelled
    check(context)


def test_a_result_that_comes_before_the_drop_is_kept(
    context: Context, worker: PretendWorker
) -> None:
    job_id = submit(context)
    (task,) = worker.lease(simulate=1)
    cancel_job(context, job_id)
    assert worker.finish(task) == ["accepted"]
    sweep(context)
    assert show_job(context, job_id).state is JobState.cancelled
    again = show_job(context, submit(context))
    assert again.progress.stages[Stage.simulate].cached == 1
    check(context)


def test_cancelling_ends_although_the_worker_is_gone(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context)
    worker.start(*worker.lease(simulate=2))
    cancel_job(context, job_id)
    clock.advance(31)
    sweep(context)
    assert show_job(context, job_id).state is JobState.cancelled
    check(context)


def test_a_job_that_has_ended_cannot_be_cancelled(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context)
    worker.work()
    with pytest.raises(ConflictError, match="has ended"):
        cancel_job(context, job_id)
    with pytest.raises(NotFoundError):
        cancel_job(context, "job-0")


def test_a_job_waits_for_the_first_worker(context: Context) -> None:
    job_id = submit(context)
    job = show_job(context, job_id)
    assert (job.state, job.reason, job.progress.total) == (
        JobState.queued,
        Reason.waiting_for_worker,
        0,
    )
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = show_job(context, job_id)
    assert (job.state, job.reason, job.message, job.progress.total) == (
        JobState.queued,
        None,
        "",
        11,
    )
    worker.work()
    assert show_job(context, job_id).state is JobState.succeeded
    check(context)


def test_a_waiting_job_can_be_cancelled(context: Context) -> None:
    job_id = submit(context)
    assert cancel_job(context, job_id).state is JobState.cancelled
    PretendWorker(DirectApi(context), context.store).register()
    assert show_job(context, job_id).progress.total == 0
    check(context)


CLOTH: dict[str, Any] = {
    "kind": "cloth_drag",
    "allow_uncertified": True,
    "axes": {
        "material": "gray-interlock",
        "mu": 0.3,
        "texture": ["dots", "plaid"],
        "viewpoint": "left",
    },
}


def test_a_kind_that_no_worker_makes_is_refused(context: Context, worker: PretendWorker) -> None:
    with pytest.raises(KindNotAvailableError, match="rod_hang"):
        submit_job(context, parsed(CLOTH), None)
    assert list_jobs(context) == ()
    assert worker.lease() == ()


def test_a_waiting_job_of_such_a_kind_fails(context: Context) -> None:
    job = submit_job(context, parsed(CLOTH), None)
    PretendWorker(DirectApi(context), context.store).register()
    detail = show_job(context, job.id)  # type: ignore[union-attr]
    assert detail.state is JobState.failed
    assert "no worker makes 'cloth_drag'" in detail.message


def test_one_simulation_serves_all_looks_and_those_that_come_later(context: Context) -> None:
    worker = PretendWorker(
        DirectApi(context), context.store, kinds=("rod_hang", "cloth_drag")
    ).register()

    def work(**axes: Any) -> dict[str, dict[str, int]]:
        job = submit_job(context, parsed(CLOTH | {"axes": CLOTH["axes"] | axes}), None)
        worker.work()
        stages = show_job(context, job.id).progress.stages  # type: ignore[union-attr]
        return {
            stage: {"all": sum(stages[stage].counts.values()), "cached": stages[stage].cached}
            for stage in (Stage.simulate, Stage.render)
        }

    first = work(texture=["dots", "plaid"], viewpoint=["left", "right"])
    assert first == {Stage.simulate: {"all": 1, "cached": 0}, Stage.render: {"all": 4, "cached": 0}}
    more = work(texture=["dots", "plaid", "floral"], viewpoint=["left", "right"])
    assert more == {Stage.simulate: {"all": 1, "cached": 1}, Stage.render: {"all": 6, "cached": 4}}
    assert sum(name.startswith("simulate") for name in worker.finished_ids) == 1
    check(context)


def test_many_renders_share_one_simulation(context: Context) -> None:
    worker = PretendWorker(
        DirectApi(context), context.store, kinds=("rod_hang", "cloth_drag")
    ).register()
    job = submit_job(context, parsed(CLOTH), None)
    (simulation,) = worker.lease(simulate=10)
    worker.report((simulation, rejection()))
    assert worker.lease(render=10) == ()
    worker.work()
    detail = show_job(context, job.id)  # type: ignore[union-attr]
    assert (detail.state, detail.rejected_count) == (JobState.failed, 2)
    check(context)


def test_a_stranded_job_says_so(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context)
    clock.advance(31)
    sweep(context)
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.queued, Reason.waiting_for_worker)
    assert "no worker is connected" in job.message
    other = BUILDS.model_copy(update={"sim_core": "f" * 64})
    PretendWorker(DirectApi(context), context.store, builds=other).register()
    assert "no connected worker has the builds" in show_job(context, job_id).message
    PretendWorker(DirectApi(context), context.store, name="old").register()
    job = show_job(context, job_id)
    assert (job.reason, job.message) == (None, "")
    check(context)


def test_tasks_go_only_to_their_builds(context: Context, worker: PretendWorker) -> None:
    submit(context)
    other = BUILDS.model_copy(update={"render": "f" * 64})
    foreign = PretendWorker(
        DirectApi(context), context.store, name="foreign", builds=other
    ).register()
    leases = foreign.lease()
    assert {lease.task.stage for lease in leases} == {"simulate"}  # the simulator is the same
    foreign.finish(*leases)
    assert foreign.lease() == ()
    assert {lease.task.stage for lease in worker.lease()} == {"render"}


def test_a_small_job_does_not_wait_behind_a_big_one(
    context: Context, worker: PretendWorker
) -> None:
    submit(context, gamma={"type": "linspace", "start": 0, "stop": 50, "num": 50})
    small = submit(context, gamma=(77.0,))
    held = worker.lease(simulate=4)
    gammas = sorted(lease.task.simulation.gamma for lease in held)  # type: ignore[union-attr]
    assert gammas[-2:] == [77.0, 77.0]
    assert show_job(context, small).state is JobState.running
    check(context)


def test_work_survives_a_restart(settings: Settings, clock: ManualClock) -> None:
    before = Context.open(settings, clock)
    start(before)
    worker = PretendWorker(DirectApi(before), before.store).register()
    job_id = submit(before)
    held = worker.lease(simulate=2)
    worker.start(*held)
    before.close()
    clock.advance(3600)  # the leases have expired, but nobody could have renewed them
    after = Context.open(settings, clock)
    start(after)
    worker.api = DirectApi(after)
    sweep(after)
    assert worker.start(*held) == ()
    assert worker.finish(*held) == ["accepted", "accepted"]
    worker.work()
    assert show_job(after, job_id).state is JobState.succeeded
    check(after)
    after.close()


def test_a_worker_that_publishes_what_is_not_there_is_not_believed(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context)
    while not (publish := worker.lease(publish=1)):
        worker.finish(*worker.lease())
    good = worker.result(publish[0].task)
    assert good.output is not None
    lie = good.model_copy(update={"output": good.output.model_copy(update={"manifest": "0" * 64})})
    assert worker.report((publish[0], lie)) == ["accepted"]
    assert counts(context, job_id, Stage.publish) == {TaskState.soft_failed: 1}
    clock.advance(5)
    (again,) = worker.lease(publish=1)
    assert again.task == publish[0].task  # the same version number
    assert worker.finish(again) == ["accepted"]
    assert show_job(context, job_id).state is JobState.succeeded
    check(context)


def test_an_output_of_another_stage_is_no_answer(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context)
    (simulate, other) = worker.lease(simulate=2)
    worker.finish(other)
    (render,) = worker.lease(render=1)
    worker.report((simulate, worker.result(render.task)))
    assert counts(context, job_id, Stage.simulate)[TaskState.soft_failed] == 1
    check(context)


def test_a_task_can_be_read_for_a_replay(context: Context, worker: PretendWorker) -> None:
    submit(context)
    leases = worker.lease(simulate=4)
    assert show_task(context, leases[0].task_id) == leases[0].task
    worker.finish(*leases)
    (render,) = worker.lease(render=1)
    assert show_task(context, render.task_id) == render.task
    with pytest.raises(NotFoundError):
        show_task(context, "render-" + "0" * 64)
    with pytest.raises(NotFoundError):
        show_task(context, render.task_id.replace("render", "simulate"))


def test_versions_of_two_builds_at_once_do_not_share_a_number(
    context: Context, worker: PretendWorker
) -> None:
    submit(context)
    builds = Builds(**{stage: str(n) * 64 for n, stage in enumerate(Builds.model_fields)})
    other = PretendWorker(DirectApi(context), context.store, name="other", builds=builds).register()
    submit(context)
    publishes = []
    for publisher in (worker, other):
        while not (publish := publisher.lease(publish=1)):
            publisher.finish(*publisher.lease())
        publishes.append((publisher, publish[0]))
    assert [lease.task.version for _, lease in publishes] == [1, 2]  # type: ignore[union-attr]
    for publisher, lease in reversed(publishes):
        assert publisher.finish(lease) == ["accepted"]
    check(context)


def test_the_time_left_is_measured(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context, gamma=(1.0, 2.0, 3.0))
    assert show_job(context, job_id).progress.eta is None
    worker.finish(*worker.lease(simulate=6))
    assert show_job(context, job_id).progress.eta is None  # no render has been measured
    worker.finish(*worker.lease(render=3))
    eta = show_job(context, job_id).progress.eta
    assert eta is not None
    # 3 renders of 1 s, 3 packs and 1 publish taken as 1 s each, two at a time
    assert eta.seconds == pytest.approx((3 + 3 + 1) / 2)
    assert 0 <= eta.low < eta.seconds < eta.high
    worker.work()
    assert show_job(context, job_id).progress.eta is None
    earlier = show_job(context, submit(context, gamma=(8.0,))).progress.eta
    assert earlier is not None  # from the job before
    assert earlier.seconds == pytest.approx(
        4.0
    )  # 6 tasks on 2 slots, but each stage waits for the one before


class TestPausing:
    """Pausing: nothing more is leased, what runs finishes, and resuming goes on."""

    def test_running_tasks_finish_and_nothing_more_is_leased(
        self, context: Context, worker: PretendWorker
    ) -> None:
        job = submit(context)
        running, waiting = worker.lease(simulate=2)
        worker.start(running)
        assert pause_job(context, job).state is JobState.pausing
        assert pause_job(context, job).state is JobState.pausing  # asked twice, it is one pause
        assert worker.lease() == ()
        assert worker.start(running) == ()
        assert worker.beat(waiting) == (waiting.task_id,)  # it had not been started: given back
        assert counts(context, job, Stage.simulate) == {TaskState.pending: 3, TaskState.running: 1}
        assert worker.finish(running) == ["accepted"]
        sweep(context)
        detail = show_job(context, job)
        assert (detail.state, detail.progress.eta) == (JobState.paused, None)
        assert worker.lease() == ()
        check(context)
        assert resume_job(context, job).state is JobState.running
        assert resume_job(context, job).state is JobState.running
        worker.work()
        assert show_job(context, job).state is JobState.succeeded
        assert len(worker.finished_ids) == len(set(worker.finished_ids)) == 11
        check(context)

    def test_it_survives_a_restart(self, settings: Settings, clock: ManualClock) -> None:
        before = Context.open(settings, clock)
        start(before)
        worker = PretendWorker(DirectApi(before), before.store).register()
        job = submit(before)
        assert pause_job(before, job).state is JobState.paused
        before.close()
        after = Context.open(settings, clock)
        start(after)
        worker = PretendWorker(DirectApi(after), after.store).register()
        sweep(after)
        assert worker.lease() == ()
        assert show_job(after, job).state is JobState.paused
        assert resume_job(after, job).state is JobState.queued
        worker.work()
        assert show_job(after, job).state is JobState.succeeded
        after.close()

    def test_others_run_what_a_paused_job_shares(
        self, context: Context, worker: PretendWorker
    ) -> None:
        first = submit(context)
        pause_job(context, first)
        second = submit(context, gamma=(1.0, 2.0), name="second")  # the same tasks
        third = submit(context, gamma=(1.0,))
        pause_job(context, second)
        check(context)
        assert [len(worker.lease(simulate=10))] == [2]  # those of the third
        resume_job(context, second)
        check(context)
        for lease in worker.lease(simulate=10):
            worker.finish(lease)
        cancel_job(context, third)
        worker.register()
        worker.work()
        assert show_job(context, second).state is JobState.succeeded
        assert (
            show_job(context, first).state is JobState.succeeded
        )  # its dataset was made for another
        check(context)

    def test_a_job_that_waits_for_the_first_worker(self, context: Context) -> None:
        job = submit(context)
        assert pause_job(context, job).state is JobState.paused
        worker = PretendWorker(DirectApi(context), context.store).register()
        assert show_job(context, job).progress.total == 0
        assert resume_job(context, job).state is JobState.queued
        worker.work()
        assert show_job(context, job).state is JobState.succeeded

    def test_ended_jobs_refuse(self, context: Context, worker: PretendWorker) -> None:
        done, dropped = submit(context), submit(context, gamma=(5.0,))
        pause_job(context, dropped)
        assert cancel_job(context, dropped).state is JobState.cancelled
        worker.work()
        for job in (done, dropped):
            with pytest.raises(ConflictError, match="can be paused"):
                pause_job(context, job)
            with pytest.raises(ConflictError, match="can be resumed"):
                resume_job(context, job)

    def test_a_lost_worker_does_not_undo_it(
        self, context: Context, worker: PretendWorker, clock: ManualClock
    ) -> None:
        job = submit(context)
        worker.start(*worker.lease(simulate=1))
        pause_job(context, job)
        clock.advance(31)
        sweep(context)
        clock.advance(5)
        sweep(context)
        assert show_job(context, job).state is JobState.paused
        assert counts(context, job, Stage.simulate) == {TaskState.pending: 4}
        assert worker.lease() == ()
        check(context)


def test_cancelling_a_job_writes_none_of_its_tasks(context: Context, worker: PretendWorker) -> None:
    job = submit(context, gamma=(1.0, 2.0, 3.0))
    other = submit(context, gamma=(3.0, 4.0))
    leases = worker.lease(simulate=1)
    with context.database.read() as connection:
        before = connection.execute(select(tasks).order_by(tasks.c.seq)).all()
    assert cancel_job(context, job).state is JobState.cancelling
    with context.database.read() as connection:
        assert connection.execute(select(tasks).order_by(tasks.c.seq)).all() == before
    assert worker.beat(*leases) == (leases[0].task_id,)
    sweep(context)
    detail = show_job(context, job)
    assert detail.state is JobState.cancelled
    assert detail.progress.stages[Stage.simulate].counts == {TaskState.cancelled: 6}
    check(context)
    worker.work()
    assert show_job(context, other).state is JobState.succeeded


def test_a_job_of_millions_is_not_read_for_its_tasks_on_lease(settings: Settings) -> None:
    """Each report would read it while the job is being paused or cancelled."""
    context = Context.open(settings)
    start(context)
    statements: list[str] = []
    with context.database.read() as connection:
        if connection.dialect.name == "sqlite":
            driver: Any = connection.connection.dbapi_connection
            driver.set_trace_callback(statements.append)
            assert not has_exclusive_lease(connection, 1, NEEDING_TASKS)
            driver.set_trace_callback(None)
            plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statements[0]}").all()
            assert "tasks USING COVERING INDEX ix_tasks_owner" in str(plan)
            assert "SEARCH job_tasks USING PRIMARY KEY (job=? AND task=?)" in str(plan)
    context.close()
