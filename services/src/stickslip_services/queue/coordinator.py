"""The coordinator's verbs: everything that changes something by a rule, each as one or two transactions.

What only reads is not here: routes ask `jobs`, `workers` and the catalog.
"""

import logging
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import InitVar, dataclass, field

from sqlalchemy import Connection
from stickslip_schemas import tracing
from stickslip_schemas.base.keys import Sha256
from stickslip_schemas.base.states import JobState, Reason
from stickslip_schemas.documents.certificate import CertificateUpload
from stickslip_schemas.documents.responses import CertificateEntry, JobDetail
from stickslip_schemas.documents.tasks import PublishOutput, PublishTask
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    LeaseBatch,
    LeaseRequest,
    Report,
    ReportAnswer,
    ReportBatch,
    WorkerRegistration,
    WorkerSession,
)
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store, is_unavailable, open_store

from stickslip_services.access.audit_log import note
from stickslip_services.access.keys import admit_local_worker
from stickslip_services.access.projects import check_quota, this_project
from stickslip_services.catalog.certificates import insert_certificate, store_certificate
from stickslip_services.catalog.textures import check_textures
from stickslip_services.catalog.versions import ManifestSummary, check_output, damaged_files, read_version
from stickslip_services.clock import Clock
from stickslip_services.database import migrate
from stickslip_services.database.database import Database
from stickslip_services.database.opening import connect
from stickslip_services.errors import ConflictError, KindNotAvailableError, PresetNotCertifiedError
from stickslip_services.queue.bell import Bell
from stickslip_services.queue.closing import ledger
from stickslip_services.queue.eta_watch import EtaWatch
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.jobs import (
    Replay,
    cancel_job,
    check_unchanged,
    find_job,
    find_replay,
    fingerprint,
    has_runnable_job,
    held_jobs,
    hold_jobs,
    keep_replay,
    pause_job,
    prioritise_job,
    release_jobs,
    resume_job,
    runnable_jobs,
    show_job,
    traceparent_of,
    unplanned_jobs,
)
from stickslip_services.queue.leasing import (
    compose_leases,
    grant_leases,
    has_ready_task,
    renew_all_leases,
    renew_leases,
)
from stickslip_services.queue.ledger import RUNNABLE, Ending, Ledger
from stickslip_services.queue.plan import Plan, Terms
from stickslip_services.queue.planner import Planner, release_claims
from stickslip_services.queue.planning import collector_at_rest, expand
from stickslip_services.queue.reopening import end_made, made_jobs, make_again
from stickslip_services.queue.reports import take_reports
from stickslip_services.queue.retrying import fail_tries, find_held, give_back, is_sweep_due, lose, sweep
from stickslip_services.queue.store_watch import StoreWatch
from stickslip_services.queue.stranded import find_stranded, note_stranded
from stickslip_services.queue.submitting import begin_planning, insert_job, plan_piece
from stickslip_services.queue.terms import terms_for
from stickslip_services.queue.workers import (
    NO_WORKER,
    RegisteredWorker,
    find_worker,
    insert_worker,
    note_seen,
    other_sessions,
    present_workers,
)
from stickslip_services.settings import Settings

CHECKED_AT_ONCE = 64 * 2**20
"""The largest dataset that is checked while the request that asks for it again waits [bytes]."""

logger = logging.getLogger(__name__)

BUSY_POLL_SECONDS = 0.2
IDLE_POLL_SECONDS = 1.0


@dataclass(slots=True)
class Coordinator:
    """The queue, the store's index and the clock."""

    settings: Settings
    given_clock: InitVar[Clock | None] = None
    """Another clock than the database's, for tests."""
    bell: Bell = field(default_factory=Bell)
    database: Database = field(init=False)
    clock: Clock = field(init=False)
    store: Store = field(init=False)
    store_watch: StoreWatch = field(init=False)
    eta_watch: EtaWatch = field(init=False, default_factory=EtaWatch)
    planner: Planner = field(init=False)
    _is_closing: bool = field(init=False, default=False)
    _frames: dict[str, dict[str, tuple[int, int]]] = field(init=False, default_factory=dict)
    """What the last heartbeat of each worker told of its simulations, by task. Not kept over a restart."""
    _lists: dict[str, tuple[Sha256, ...]] = field(init=False, default_factory=dict)
    """The lists that tasks were given to publish by. Those that a restart forgets, `gc` finds."""

    def __post_init__(self, given_clock: Clock | None) -> None:
        self.database = connect(self.settings)
        self.clock = given_clock or self.database.clock
        self.store = open_store(self.settings.store_place)
        self.store_watch = StoreWatch(
            self.store,
            self.settings.data,
            min_free_bytes=self.settings.min_free_bytes,
            clock=lambda: self.clock(),
        )
        self.planner = self.new_planner()

    def start(self) -> None:
        """Bring the database up to date and take up the work where it was left."""
        with self.database.write() as connection:
            migrate.upgrade(connection)
            admit_local_worker(connection, self.settings.worker_key_path, self.clock())
            if self.database.is_alone(connection):  # nobody could take a heartbeat
                renew_all_leases(connection, self.clock(), self.settings)
                release_claims(connection)
        self.plan_waiting_jobs()

    def close(self) -> None:
        """Let go of the database."""
        self._is_closing = True
        self.database.close()

    @contextmanager
    def _book(self) -> Iterator[Ledger]:
        with self.database.write() as connection, ledger(connection, self.clock()) as book:
            yield book
        self.bell.ring()

    # --- users ----------------------------------------------------------------------------------------------------

    def submit(
        self, spec: JobSpec, idempotency_key: str | None, *, priority: int = 0, traceparent: str | None = None
    ) -> JobDetail | Replay:
        """Make a job of a spec; with a key that has been here before, return the first answer.

        Where spans are exported, all of the job hangs below one, and this one below `traceparent` of who asks.

        Raises QuotaExceededError where the project that asks has as much in flight as it may have.
        """
        check_textures(self.store, spec)
        with (
            collector_at_rest(),
            tracing.span("submit", parent=traceparent, kind=spec.kind, samples=spec.sample_count),
        ):
            answer = self._submit(spec, idempotency_key, priority, tracing.traceparent())
            tracing.note(job=answer.job_id if isinstance(answer, Replay) else answer.id)
            return answer

    def _submit(
        self, spec: JobSpec, idempotency_key: str | None, priority: int, traceparent: str | None
    ) -> JobDetail | Replay:
        print_ = fingerprint(spec)
        plan: Plan | None = None
        planned_for: Terms | None = None
        while True:
            with self.database.read() as connection:
                if idempotency_key and (replay := find_replay(connection, idempotency_key, print_)):
                    return replay
                check_quota(connection, this_project(), spec.sample_count)
                terms = terms_for(connection, spec)
            at_once = terms is not None and spec.sample_count <= self.settings.plan_samples
            if terms is not None and at_once and planned_for != terms:
                plan, planned_for = self._expand(spec, terms), terms
            with self.database.write() as connection:
                if idempotency_key and (replay := find_replay(connection, idempotency_key, print_)):
                    return replay
                if terms_for(connection, spec) != terms:
                    continue  # a worker with other builds has registered in between, or a certificate
                check_quota(connection, this_project(), spec.sample_count)
                now = self.clock()
                with ledger(connection, now) as book:
                    job = insert_job(book, spec, priority=priority, project=this_project(), traceparent=traceparent)
                    self._enqueue(book, job, terms, plan if at_once else None)
                shown = self.show(connection, job)
                note(
                    connection,
                    "job.submit",
                    shown.id,
                    now,
                    name=spec.name,
                    samples=spec.sample_count,
                    priority=priority,
                )
                if idempotency_key:
                    keep_replay(connection, idempotency_key, print_, job, shown.model_dump_json(), now)
            self.bell.ring()
            self.check_made_datasets(at_most=CHECKED_AT_ONCE)
            return shown

    def _enqueue(self, book: Ledger, job: int, terms: Terms | None, plan: Plan | None) -> None:
        """Let a new job be queued with its whole plan, or be planned piece by piece, or wait for the first worker."""
        if terms is None:
            reason = Reason.waiting_for_worker
            set_job_state(book.connection, job, JobState.queued, book.now, reason=reason, message=NO_WORKER)
            return
        begin_planning(book, job, terms)
        set_job_state(book.connection, job, JobState.planning if plan is None else JobState.queued, book.now)
        if plan is not None:
            plan_piece(book, job, plan)

    def cancel(self, job_id: str, *, if_match: Collection[str] | None = None) -> JobDetail:
        """Cancel a job. With `if_match`, only if its entity tag is one of these."""
        with self._book() as book:
            self._check_unchanged(book.connection, job_id, if_match)
            job = cancel_job(book, job_id)
            note(book.connection, "job.cancel", job_id, book.now)
        return self._shown(job)

    def prioritise(self, job_id: str, priority: int, *, if_match: Collection[str] | None = None) -> JobDetail:
        """Give a job another priority; with `if_match` as in `cancel`."""
        with self._book() as book:
            self._check_unchanged(book.connection, job_id, if_match)
            job = prioritise_job(book, job_id, priority)
            note(book.connection, "job.prioritise", job_id, book.now, priority=priority)
        return self._shown(job)

    def pause(self, job_id: str, *, if_match: Collection[str] | None = None) -> JobDetail:
        """Pause a job; with `if_match` as in `cancel`."""
        with self._book() as book:
            self._check_unchanged(book.connection, job_id, if_match)
            job = pause_job(book, job_id)
            note(book.connection, "job.pause", job_id, book.now)
        return self._shown(job)

    def resume(self, job_id: str, *, if_match: Collection[str] | None = None) -> JobDetail:
        """Let a paused job go on, with the builds it was planned for; with `if_match` as in `cancel`.

        Raises ConflictError while the store takes no results.
        """
        if trouble := self.store_watch.trouble:
            raise ConflictError(f"{trouble}; once that is mended the job goes on by itself")
        with self._book() as book:
            self._check_unchanged(book.connection, job_id, if_match)
            job = resume_job(book, job_id)
            note(book.connection, "job.resume", job_id, book.now)
        self.plan_waiting_jobs()
        self._note_stranded()
        return self._shown(job)

    def _check_unchanged(self, connection: Connection, job_id: str, if_match: Collection[str] | None) -> None:
        if if_match is not None:
            check_unchanged(self.show(connection, int(find_job(connection, job_id).seq)), if_match)

    def _shown(self, job: int) -> JobDetail:
        with self.database.read() as connection:
            return self.show(connection, job)

    def show(self, connection: Connection, job: int) -> JobDetail:
        """Return a job as a transaction sees it."""
        shown = show_job(connection, job, self.alive_workers(connection), self.frames)
        if self.store_watch.trouble and shown.state in RUNNABLE:  # perhaps not even the database could be told
            update = {"reason": Reason.store_unavailable, "message": self.store_watch.trouble}
            return shown.model_copy(update=update)
        return shown

    def add_certificate(self, upload: CertificateUpload) -> CertificateEntry:
        """Register a certificate."""
        stored = store_certificate(self.store, upload)
        with self.database.write() as connection:
            entry = insert_certificate(connection, upload, stored, self.clock())
            note(
                connection, "certificate.register", entry.digest, self.clock(), preset=entry.preset, passed=entry.passed
            )
            return entry

    # --- workers --------------------------------------------------------------------------------------------------

    def register(self, registration: WorkerRegistration) -> WorkerSession:
        """Let a worker in; it takes the leases of an earlier session of its name away."""
        with self._book() as book:
            old = other_sessions(book.connection, registration.name)
            worker = insert_worker(book.connection, registration, book.now)
            message = f"worker {registration.name} was started anew"
            lose(book, find_held(book, owners=old), self.settings, message=message)
        self.plan_waiting_jobs()
        self._note_stranded()
        return WorkerSession(worker_id=worker.id, lease_seconds=self.settings.lease_seconds)

    def lease(self, request: LeaseRequest) -> LeaseBatch:
        """Lease tasks to a worker."""
        wanted = {stage: count for stage, count in request.wanted.items() if count > 0}
        with self.database.read() as connection:
            worker = _unsuperseded(connection, request.worker_id)
            due = is_sweep_due(connection, self.clock())
            ready = has_ready_task(connection, worker, wanted.keys(), at_most=request.at_most_seconds)
            waiting = ready or has_runnable_job(connection)
        self._note_seen(worker)
        if due:
            self._take_back()
        if self.store_watch.trouble:
            return LeaseBatch(leases=(), retry_after_seconds=IDLE_POLL_SECONDS)
        if not (ready or due):
            return LeaseBatch(leases=(), retry_after_seconds=BUSY_POLL_SECONDS if waiting else IDLE_POLL_SECONDS)
        with self._book() as book:
            worker = _unsuperseded(book.connection, worker.id)
            grants = grant_leases(book, worker, wanted, self.settings, at_most=request.at_most_seconds)
        # What a task builds on has ended: nobody needs to be kept from writing while the tasks are composed.
        with self.database.read() as connection:
            leases = compose_leases(connection, grants, self.store.publish)
        self._lists |= {lease.task_id: lease.task.sections for lease in leases if isinstance(lease.task, PublishTask)}
        return LeaseBatch(leases=leases, retry_after_seconds=0 if leases else BUSY_POLL_SECONDS)

    def heartbeat(self, heartbeat: Heartbeat) -> HeartbeatAnswer:
        """Renew a worker's leases and tell it what to drop."""
        with self.database.read() as connection:
            worker = find_worker(connection, heartbeat.worker_id)
        self._note_seen(worker)
        self._frames[worker.id] = {
            lease.task_id: lease.frames for lease in heartbeat.leases if lease.frames is not None
        }
        if not heartbeat.leases:
            return HeartbeatAnswer(drop=())
        with self._book() as book:
            drop = renew_leases(book, find_worker(book.connection, worker.id), heartbeat.leases, self.settings)
        return HeartbeatAnswer(drop=drop)

    def report(self, batch: ReportBatch) -> ReportAnswer:
        """Take results in."""
        versions: dict[str, ManifestSummary] = {}
        began = time.monotonic()
        reports = [self._checked(report, versions) for report in batch.reports]
        with self._book() as book:
            worker = find_worker(book.connection, batch.worker_id)
            if self._is_silent(worker):
                note_seen(book.connection, worker.id, book.now)
            taken = take_reports(book, worker.id, reports, versions)
            give_back(book, taken.released)
            for _, reason, message in taken.failures:
                if reason is Reason.store_unavailable:
                    self.store_watch.note(f"worker {worker.name} cannot use the store: {message}")
            give_back(book, [task for task, reason, _ in taken.failures if reason is Reason.store_unavailable])
            for task, reason, message in taken.failures:
                if reason is Reason.worker_lost:
                    lose(book, [task], self.settings, message=message)
            innocent = (Reason.store_unavailable, Reason.worker_lost)
            charged = [failure for failure in taken.failures if failure[1] not in innocent]
            fail_tries(book, charged, self.settings)
            for consumer, digests in taken.damaged:
                make_again(book, consumer, digests)
        for verdict in taken.verdicts:
            if verdict.verdict == "accepted" and verdict.task_id in versions:
                self._delete_lists(verdict.task_id)
                self._trace_commit(verdict.task_id, time.monotonic() - began)
        return ReportAnswer(verdicts=taken.verdicts)

    def _trace_commit(self, task_id: str, seconds: float) -> None:
        if tracing.is_on():
            with self.database.read() as connection:
                traceparent = traceparent_of(connection, task_id)
            tracing.record("commit", parent=traceparent, seconds=seconds, task=task_id)

    def _delete_lists(self, task_id: str) -> None:
        with suppress(OSError):
            for digest in self._lists.pop(task_id, ()):
                self.store.delete(digest)

    def _checked(self, report: Report, versions: dict[str, ManifestSummary]) -> Report:
        """Return the report, or a failure where the store does not have what it says; read manifests on the way."""
        if report.result is None or report.result.output is None:
            return report
        output = report.result.output
        try:
            if isinstance(output, PublishOutput):
                versions[report.task_id] = read_version(self.store, output)
            else:
                check_output(self.store, output)
        except (OSError, ValueError) as error:
            message = f"the result does not hold: {error}"[:2000]
            unavailable = isinstance(error, OSError) and is_unavailable(error)
            reason = Reason.store_unavailable if unavailable else Reason.storage_error
            update = {"outcome": "failed", "reason": reason, "message": message, "output": None}
            return report.model_copy(update={"result": report.result.model_copy(update=update)})
        return report

    def _note_seen(self, worker: RegisteredWorker) -> None:
        """Write down that a worker was heard of, unless that has just been done: a poll is not worth a write."""
        if self._is_silent(worker):
            with self.database.write() as connection:
                note_seen(connection, worker.id, self.clock())

    def _is_silent(self, worker: RegisteredWorker) -> bool:
        return self.clock() - worker.last_seen_at > self.settings.lease_seconds / 4

    # --- the coordinator itself ------------------------------------------------------------------------------------

    def sweep(self) -> None:
        """Take back expired leases, let due retries go on, and let jobs that nobody serves say so."""
        self._watch_store()
        self._take_back()
        self._note_stranded()
        self._watch_etas()
        self.check_made_datasets(at_most=CHECKED_AT_ONCE)

    def _watch_etas(self) -> None:
        if not self.eta_watch.is_due(self.clock()):
            return
        with self.database.read() as connection:
            ids = self.eta_watch.watched | set(runnable_jobs(connection))
            jobs = {job_id: self.show(connection, find_job(connection, job_id).seq) for job_id in ids}
        self.eta_watch.look(jobs, self.clock())

    def _watch_store(self) -> None:
        """Pause jobs while the store takes no results, and let them go on afterwards."""
        trouble = self.store_watch.look()
        with self.database.read() as connection:
            due = has_runnable_job(connection) if trouble else bool(held_jobs(connection))
        if not due:
            return
        with self._book() as book:
            if trouble:
                hold_jobs(book, trouble)
            else:
                release_jobs(book)
        logger.warning("jobs are paused: %s", trouble) if trouble else logger.info("the store takes results again")

    def check_made_datasets(self, *, at_most: int | None = None) -> None:
        """Check the datasets that jobs found made before; where a file is damaged or lost, it is made again.

        Datasets of more than `at_most` bytes are left for a call without it: it reads all of them.
        """
        with self.database.read() as connection:
            found = made_jobs(connection)
        for made in found:
            if at_most is None or made.bytes <= at_most:
                try:
                    damaged = damaged_files(self.store, made.manifest, made.group)
                except OSError as error:  # out of reach: `sweep` looks again
                    logger.warning("a dataset that was made before cannot be checked now: %s", error)
                    continue
                with self._book() as book:
                    end_made(book, made, damaged)

    def _take_back(self) -> None:
        with self.database.read() as connection:
            due = is_sweep_due(connection, self.clock())
        if due:
            with self._book() as book:
                sweep(book, self.settings)

    def plan_waiting_jobs(self) -> None:
        """Plan the jobs that came before the first worker."""
        with self.database.read() as connection:
            waiting = unplanned_jobs(connection)
        for row in waiting:
            spec = job_spec_adapter.validate_json(row.spec)
            with self.database.read() as connection:
                terms: Terms | None = None
                refusal, reason = "", Reason.waiting_for_worker
                try:
                    terms = terms_for(connection, spec)
                except KindNotAvailableError as error:
                    refusal = str(error)
                except PresetNotCertifiedError as error:
                    refusal, reason = str(error), Reason.preset_not_certified
                else:
                    if terms is None:
                        return
            at_once = spec.sample_count <= self.settings.plan_samples
            plan = self._expand(spec, terms) if terms is not None and at_once else None
            with self.database.write() as connection:
                if row.seq not in {other.seq for other in unplanned_jobs(connection)}:
                    continue  # cancelled, or planned by somebody else
                if terms is None:
                    set_job_state(
                        connection,
                        row.seq,
                        JobState.failed,
                        self.clock(),
                        reason=reason,
                        message=refusal,
                    )
                else:
                    with ledger(connection, self.clock()) as book:
                        begin_planning(book, row.seq, terms)
                        if plan is not None:
                            plan_piece(book, row.seq, plan)
                        else:
                            set_job_state(connection, row.seq, JobState.planning, book.now)
            self.bell.ring()

    def plan_large_jobs(self) -> None:
        """Plan the jobs that are `planning`, until there are none left."""
        while not self._is_closing and self.planner.step():
            pass

    def new_planner(self) -> Planner:
        """Return a planner that has claimed no job yet."""
        return Planner(
            self.database,
            lambda: self.clock(),
            self.settings,
            self.bell.ring,
            write=self._write_piece,
            fail=self._fail_to_plan,
        )

    def _write_piece(self, connection: Connection, job: int, piece: Plan) -> None:
        with ledger(connection, self.clock()) as book:
            plan_piece(book, job, piece)

    def _fail_to_plan(self, connection: Connection, job: int, message: str) -> None:
        with ledger(connection, self.clock()) as book:
            book.end_job(job, Ending(JobState.failed, Reason.internal_error, message))

    def alive_workers(self, connection: Connection) -> list[RegisteredWorker]:
        """Return the workers that were heard of within the time that a lease lasts."""
        return present_workers(connection, seen_since=self.alive_since)

    @property
    def frames(self) -> dict[str, tuple[int, int]]:
        """Of the simulations that run and tell, by task: frames done, and frames."""
        return {task: frames for told in list(self._frames.values()) for task, frames in told.items()}

    @property
    def alive_since(self) -> float:
        """Since when a worker must have been heard of to be taken for alive."""
        return self.clock() - self.settings.lease_seconds

    def _expand(self, spec: JobSpec, terms: Terms) -> Plan:
        return expand(spec, terms, previews=self.settings.previews_per_job)

    def _note_stranded(self) -> None:
        with self.database.read() as connection:
            stranded = find_stranded(connection, self.clock(), self.settings)
        if stranded:
            with self.database.write() as connection:
                note_stranded(connection, self.clock(), self.settings)
            self.bell.ring()


def _unsuperseded(connection: Connection, worker_id: str) -> RegisteredWorker:
    """Return a worker; raise UnknownWorkerError, or ConflictError where it has been started anew."""
    worker = find_worker(connection, worker_id)
    if worker.superseded:
        raise ConflictError(f"another session of worker {worker.name} has registered; this one gets no tasks")
    return worker
