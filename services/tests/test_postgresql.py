"""Several coordinators on one PostgreSQL database, and what they are refused."""

import asyncio
import itertools
import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from click.testing import CliRunner
from httpx_sse import connect_sse
from sqlalchemy import func, select, text
from sqlalchemy.exc import OperationalError
from stickslip_schemas.base import JobState
from stickslip_schemas.store import DirectoryStore
from stickslip_services.app import main
from stickslip_services.cli import app
from stickslip_services.database.database import Role
from stickslip_services.database.opening import check, connect, opened
from stickslip_services.database.statements import RowQuery
from stickslip_services.database.tables import dataset_versions, tasks
from stickslip_services.errors import DatabaseRefusedError, SettingsError
from stickslip_services.queue.background import start
from stickslip_services.queue.context import Context
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, list_datasets, list_jobs, parsed, rods, show_job
from stickslip_testing.servers import HttpApi, RunningServer, start_server, wait_until
from stickslip_testing.worker import DirectApi, PretendWorker, failure

if TYPE_CHECKING:
    from stickslip_testing.postgresql import PostgresqlServer


@pytest.fixture
def settings(
    tmp_path: Path, postgresql: "PostgresqlServer", monkeypatch: pytest.MonkeyPatch
) -> Settings:
    """Settings with a database on PostgreSQL, which processes find in their environment."""
    monkeypatch.setenv("STICKSLIP_DATABASE", postgresql.clean())
    return Settings(data=tmp_path / "data", durable=False)


def one_more(settings: Settings, name: str) -> Settings:
    """Return the settings of another coordinator with the same database and the same store."""
    return settings.model_copy(
        update={"data": settings.data.parent / name, "store": settings.store_place}
    )


@dataclass
class Pair:
    """Two coordinators as processes of their own, with one database and one store."""

    settings: Settings
    servers: tuple[RunningServer, RunningServer]
    client: httpx.Client

    def worker(self, index: int, name: str) -> PretendWorker:
        server = self.servers[index]
        api = HttpApi(
            server.url, (server.data / "worker-key").read_text().strip(), self.client.post
        )
        return PretendWorker(api, DirectoryStore(self.settings.store_place), name=name).register()

    def submit(self, index: int, **spec: object) -> str:
        response = self.client.post(f"{self.servers[index].url}/v1/jobs", json=rods(**spec))
        response.raise_for_status()
        return str(response.json()["id"])


@pytest.fixture(scope="module")
def pair(
    tmp_path_factory: pytest.TempPathFactory, postgresql: "PostgresqlServer"
) -> Iterator[Pair]:
    """Each test submits samples of its own: results of another would end its job at once."""
    place = tmp_path_factory.mktemp("pair")

    def start(name: str) -> RunningServer:
        server = start_server(place / name, options=("--store", settings.store_place))
        stack.callback(server.stop)
        return server

    with ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("STICKSLIP_DURABLE", "0")
        patch.setenv("STICKSLIP_DATABASE", postgresql.empty())
        settings = Settings(data=place / "data", durable=False)
        client = stack.enter_context(httpx.Client(trust_env=False, timeout=60))
        yield Pair(settings, (start("a"), start("b")), client)


def test_two_coordinators_share_the_work(pair: Pair) -> None:
    """The first of their tests: it counts all tasks of the database."""
    workers = [pair.worker(number % 2, f"w{number}") for number in range(4)]
    specs = [
        {"gamma": [1.0 + number, 2.0 + number, 3.0 + number]} for number in range(4)
    ]  # they share tasks
    jobs: list[str] = []
    is_over = threading.Event()
    lost = Counter[str]()  # leases that expired before the report, as where the disk takes so long

    def submit_all(index: int) -> None:
        jobs.extend(pair.submit(index, **spec) for spec in specs)

    def work(worker: PretendWorker) -> None:
        while not is_over.wait(0.1):
            asked = time.monotonic()
            if leases := worker.lease(simulate=3, render=3, pack=1, publish=1):
                verdicts = worker.finish(*leases)
                if time.monotonic() - asked > pair.settings.lease_seconds:
                    stale = [
                        lease.task_id
                        for lease, verdict in zip(leases, verdicts, strict=True)
                        if verdict == "stale"
                    ]
                    lost.update(stale)

    def states() -> set[str]:
        return {
            job["state"]
            for job in pair.client.get(f"{pair.servers[0].url}/v1/jobs").json()["items"]
        }

    threads = [threading.Thread(target=submit_all, args=(index,)) for index in range(2)]
    threads += [threading.Thread(target=work, args=(worker,)) for worker in workers]
    for thread in threads:
        thread.start()
    try:
        wait_until(lambda: len(jobs) == 2 * len(specs) and states() == {"succeeded"}, seconds=240)
    finally:
        is_over.set()
        for thread in threads:
            thread.join()
    database = connect(pair.settings, Role.visitor)
    with database.read() as connection:
        assert violations(connection) == []
        count = connection.scalar(select(func.count()).select_from(tasks))
        attempts = set(connection.scalars(select(tasks.c.attempts)))
    database.close()
    finished = Counter(name for worker in workers for name in worker.finished_ids) - lost
    assert (len(finished), set(finished.values()), attempts) == (count, {1}, {1})
    assert sum(bool(worker.finished_ids) for worker in workers) > 1
    for server in pair.servers:
        listed = pair.client.get(f"{server.url}/v1/jobs").json()["items"]
        assert {job["id"] for job in listed} == set(jobs)
        assert {job["state"] for job in listed} == {"succeeded"}


def test_requests_of_a_worker_may_go_to_any_coordinator(pair: Pair) -> None:
    """As behind a load balancer, or a Service of Kubernetes."""
    keys = {server.url: (server.data / "worker-key").read_text().strip() for server in pair.servers}
    turns = itertools.cycle(keys)

    def post(url: str, *, content: str, headers: dict[str, str]) -> httpx.Response:
        asked = next(turns)
        path = url.removeprefix(pair.servers[0].url)
        headers |= {"Authorization": f"Bearer {keys[asked]}"}
        return pair.client.post(asked + path, content=content, headers=headers)

    api = HttpApi(pair.servers[0].url, "", post)
    worker = PretendWorker(api, DirectoryStore(pair.settings.store_place), name="w").register()
    job = pair.submit(0, gamma=[11.0, 12.0])
    deadline = time.monotonic() + 300
    while pair.client.get(f"{pair.servers[1].url}/v1/jobs/{job}").json()["finished_at"] is None:
        assert time.monotonic() < deadline
        leases = worker.lease(simulate=3, render=3, pack=1, publish=1)
        assert worker.start(*leases) == ()  # nothing to drop
        assert set(worker.finish(*leases)) <= {"accepted"}


def test_a_stream_hears_what_another_coordinator_does(pair: Pair) -> None:
    first, other = (server.url for server in pair.servers)
    job = pair.submit(0, gamma=[21.0, 22.0])
    heard: list[tuple[str, float]] = []
    with (
        httpx.Client(base_url=other, timeout=60) as client,
        connect_sse(client, "GET", f"/v1/jobs/{job}/events") as source,
    ):
        for event in source.iter_sse():
            if event.event != "job.state":
                continue
            heard.append((json.loads(event.data)["state"], time.monotonic()))
            if len(heard) == 1:
                time.sleep(
                    2.5
                )  # now the stream waits for the notifier: by itself it looks again after 15 s
                asked = time.monotonic()
                pair.client.post(f"{first}/v1/jobs/{job}:cancel").raise_for_status()
    assert [state for state, _ in heard][-1] == "cancelled"
    assert heard[-1][1] - asked < 6.0


def test_leases_are_renewed_at_start_only_if_nobody_was_there(
    settings: Settings, clock: ManualClock
) -> None:
    first = Context.open(settings, clock)
    start(first)
    worker = PretendWorker(DirectApi(first), first.store).register()
    submit_job(first, parsed(rods()), None)
    (lease,) = worker.lease(simulate=1)

    def expires_at() -> float:
        with first.database.read() as connection:
            return float(
                connection.scalar(select(tasks.c.expires_at).where(tasks.c.owner.is_not(None)))
                or 0.0
            )

    leased_until = expires_at()
    clock.advance(10.0)
    second = Context.open(one_more(settings, "second"), clock)
    start(second)
    assert expires_at() == leased_until
    first.close()
    second.close()
    third = Context.open(settings, clock)
    start(third)
    assert expires_at() == leased_until + 10.0
    worker.api = DirectApi(third)
    assert worker.finish(lease) == ["accepted"]
    first.close()
    third.close()


def test_a_heartbeat_is_two_statements_and_waits_for_no_writer(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    submit_job(context, parsed(rods()), None)
    leases = worker.lease(simulate=2)
    assert worker.beat(*leases) == ()  # from now on the worker is known
    sent: list[str] = []
    run = RowQuery.rows

    def rows(self: RowQuery[Any], *rest: Any) -> Any:
        sent.append("one")
        return run(self, *rest)

    monkeypatch.setattr(RowQuery, "rows", rows)
    with context.database.write():  # it has the lock of the writer until its end
        thread = threading.Thread(target=lambda: sent.extend(worker.beat(*leases)))
        thread.start()
        thread.join(10)
        assert (thread.is_alive(), sent) == (False, ["one", "one"])
    context.close()


def test_upkeep_has_the_database_for_itself(settings: Settings) -> None:
    context = Context.open(settings)
    start(context)
    with (
        pytest.raises(DatabaseRefusedError, match="is in use by a coordinator"),
        opened(settings, Role.upkeep),
    ):
        pass
    with opened(settings, Role.visitor):
        pass
    context.close()
    with opened(settings, Role.upkeep):
        with pytest.raises(
            DatabaseRefusedError, match=r"is at work on the database postgresql.*wait until"
        ):
            check(settings, Role.coordinator)
        with pytest.raises(DatabaseRefusedError, match="is in use by"):
            check(settings, Role.upkeep)
    check(settings, Role.coordinator)


def test_the_server_knows_how_large_a_planned_job_makes_the_tables(settings: Settings) -> None:
    """Otherwise it keeps plans for empty tables, and a lease reads all tasks."""
    context = Context.open(settings.model_copy(update={"plan_samples": 2}))
    start(context)
    PretendWorker(DirectApi(context), context.store).register()
    submit_job(context, parsed(rods(gamma=[float(number) for number in range(1, 10)])), None)
    Planner(context).run()
    with context.database.read() as connection:
        known = text("SELECT CAST(reltuples AS bigint) FROM pg_class WHERE relname = 'tasks'")
        count = connection.scalar(select(func.count()).select_from(tasks))
        assert count is not None
        assert connection.scalar(known) == count > 18
    context.close()


def test_a_coordinator_goes_on_after_the_server_has_closed_its_connections(
    settings: Settings, postgresql: "PostgresqlServer"
) -> None:
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(rods()), None)
    postgresql.execute(
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
        "WHERE application_name = 'stickslip' AND backend_type = 'client backend'"
    )
    for _ in range(4):  # each broken connection costs one request at most
        try:
            worker.work()
            break
        except OperationalError:
            pass
    assert show_job(context, job.id).state is JobState.succeeded  # type: ignore[union-attr]
    with (
        pytest.raises(DatabaseRefusedError),
        opened(settings, Role.upkeep),
    ):  # it is known to be there again
        pass
    context.close()


def test_the_clock_is_that_of_the_database(settings: Settings) -> None:
    first, second = connect(settings), connect(settings)
    with first.write() as connection:
        now = float(connection.scalar(text("SELECT extract(epoch FROM clock_timestamp())")) or 0.0)
        assert first.clock() == pytest.approx(now, abs=0.2)
        times: list[float] = []

        def wait_for_the_lock() -> None:
            with second.write():
                times.append(second.clock())

        thread = threading.Thread(target=wait_for_the_lock)
        thread.start()
        time.sleep(1.0)
        assert not times  # writers exclude each other across coordinators
        left_at = first.clock()
    thread.join()
    assert times[0] > left_at - 0.01  # read after the wait, not before
    first.close()
    second.close()


def test_a_connection_that_is_in_use_is_closed_when_it_is_returned(settings: Settings) -> None:
    database = connect(settings)
    with database.read() as connection:
        raw = connection.connection.dbapi_connection
        database.close()
        assert connection.scalar(text("SELECT 1")) == 1
    assert raw is not None
    assert raw.closed


def test_reads_see_one_state(settings: Settings) -> None:
    context = Context.open(settings)
    start(context)
    with context.database.read() as connection:
        before = connection.scalar(text("SELECT count(*) FROM jobs"))
        submit_job(context, parsed(rods()), None)
        assert connection.scalar(text("SELECT count(*) FROM jobs")) == before
        with pytest.raises(Exception, match="read-only"):
            connection.execute(text("DELETE FROM jobs"))
    assert len(list_jobs(context)) == 1
    context.close()


def test_what_was_rolled_back_is_not_announced(settings: Settings) -> None:
    database = connect(settings)
    other = connect(settings)
    notified: list[float] = []

    async def listen() -> None:
        task = asyncio.create_task(other.listen(lambda: notified.append(time.monotonic())))
        await _until(lambda: len(notified) == 1)  # it listens
        for fails in (True, False):
            try:
                with database.write():
                    if fails:
                        raise RuntimeError
            except RuntimeError:
                await asyncio.sleep(0.5)
                assert len(notified) == 1
        await _until(lambda: len(notified) == 2)
        with other.write():
            pass
        await asyncio.sleep(0.5)
        assert len(notified) == 2  # one's own words are no news
        task.cancel()

    asyncio.run(listen())
    database.close()
    other.close()


async def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < deadline, "it did not come to pass"
        await asyncio.sleep(0.02)


def test_numbers_may_have_64_bits(settings: Settings) -> None:
    context = Context.open(settings)
    start(context)
    with context.database.write() as connection:
        for table in ("jobs", "workers", "datasets", "certificates", "api_keys"):
            connection.execute(text(f"SELECT setval('{table}_seq_seq', 3000000000)"))
        connection.execute(text("SELECT setval('events_id_seq', 3000000000)"))
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(rods()), None)
    worker.work()
    assert show_job(context, job.id).state is JobState.succeeded  # type: ignore[union-attr]
    with context.database.write() as connection:
        connection.execute(text(f"UPDATE dataset_versions SET bytes = {2**40}"))
    with context.database.read() as connection:
        assert connection.scalar(select(dataset_versions.c.bytes)) == 2**40
        assert violations(connection) == []
    context.close()


def test_texts_may_have_any_character(settings: Settings) -> None:
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    submit_job(context, parsed(rods()), None)
    (lease,) = worker.lease(simulate=1)
    assert worker.report((lease, failure(message="nul \0 and \N{SNOWMAN}"))) == ["accepted"]
    with context.database.read() as connection:
        assert (
            connection.scalar(select(tasks.c.message).where(tasks.c.tries == 1))
            == "nul \N{REPLACEMENT CHARACTER} and \N{SNOWMAN}"
        )
    context.close()


def test_a_lost_database_is_built_again(settings: Settings, postgresql: "PostgresqlServer") -> None:
    context = Context.open(settings)
    start(context)
    PretendWorker(DirectApi(context), context.store).register()
    submit_job(context, parsed(rods()), None)
    PretendWorker(DirectApi(context), context.store).register().work()
    known = list_datasets(context)
    context.close()
    empty = postgresql.empty()
    lost = Settings.chosen(data=settings.data, durable=False, database=empty)
    with pytest.raises(
        DatabaseRefusedError, match=r"is gone: run `stickslip reindex .*` with the same --database"
    ):
        check(lost, Role.coordinator, with_store=True)
    found_again = CliRunner().invoke(
        app, ["reindex", "--data", str(settings.data), "--database", empty]
    )
    assert found_again.exit_code == 0, found_again.output
    again = Context.open(lost)
    start(again)
    (dataset,) = list_datasets(again)
    assert (dataset.id, dataset.versions[0].manifest) == (
        known[0].id,
        known[0].versions[0].manifest,
    )
    again.close()


def test_nothing_is_deleted_by_an_empty_database(
    settings: Settings, postgresql: "PostgresqlServer", monkeypatch: pytest.MonkeyPatch
) -> None:
    artifact = DirectoryStore(settings.store_place).publish(b"of a job that runs")
    monkeypatch.setenv("STICKSLIP_DATABASE", postgresql.empty())
    arguments = ["gc", "--data", str(settings.data), "--older-than", "0", "--delete"]
    result = CliRunner().invoke(app, arguments)
    assert (
        result.exit_code,
        "does not exist or is empty: name the --database" in result.stderr,
    ) == (1, True)
    assert DirectoryStore(settings.store_place).path(artifact).exists()


def test_a_data_directory_with_another_database_is_refused(settings: Settings) -> None:
    with opened(settings.model_copy(update={"database": None}), Role.upkeep):
        pass
    with pytest.raises(
        DatabaseRefusedError, match=r"coordinator\.sqlite3 holds another one: move that file away"
    ):
        check(settings, Role.coordinator)


def test_databases_that_are_refused(postgresql: "PostgresqlServer", tmp_path: Path) -> None:
    def refusal(url: str) -> str:
        with pytest.raises(DatabaseRefusedError) as raised:
            check(Settings.chosen(data=tmp_path, database=url), Role.coordinator)
        assert "secret" not in str(raised.value)
        assert "\n" not in str(raised.value)
        return str(raised.value)

    newer = postgresql.empty()
    with opened(Settings.chosen(data=tmp_path, database=newer), Role.upkeep):
        pass
    postgresql.execute(
        "UPDATE alembic_version SET version_num = '9042'",
        newer.partition("?")[0].rpartition("/")[2],
    )
    assert "has the schema 9042, and this version of stickslip knows 0001" in refusal(newer)
    foreign = postgresql.empty()
    postgresql.execute(
        "CREATE TABLE birds (name text)", foreign.partition("?")[0].rpartition("/")[2]
    )
    assert "is not a database of stickslip: give it one of its own" in refusal(foreign)
    postgresql.execute("CREATE DATABASE latin ENCODING latin1 LOCALE 'C' TEMPLATE template0")
    assert "must be UTF8, and is LATIN1" in refusal(postgresql.url("latin"))
    missing = refusal(postgresql.url("nowhere").replace("stickslip@", "stickslip:secret@"))
    assert "postgresql://stickslip:***@/nowhere cannot be opened" in missing
    assert 'database "nowhere" does not exist' in missing
    assert "cannot be opened: invalid" in refusal(postgresql.url("postgres") + "&colour=red")
    postgresql.execute("CREATE ROLE guest LOGIN")
    guest = postgresql.empty().replace("stickslip@", "guest@")
    assert "its user may not make tables in the database postgresql://guest@/" in refusal(guest)


@pytest.mark.parametrize(
    ("value", "censored"),
    [
        ("mysql://me:secret@host/x", "'mysql://me:***@host/x'"),
        ("postgresql+asyncpg://me:sec?ret@host/x", "'postgresql+asyncpg://me:***@host/x'"),
        ("postgresql://me@host", "'postgresql://me@host'"),
        ("sqlite:///file?password=secret", "'sqlite:///file'"),
        ("me:secret@host", "something else, which is not shown because it may hold a password"),
        ("coordinator.sqlite3", "'coordinator.sqlite3'"),
        ("", "''"),
    ],
)
def test_other_databases_are_refused_without_their_password(
    value: str, censored: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rule = "database must be a URL of the form postgresql://USER@HOST/NAME, and is "
    with pytest.raises(SettingsError) as raised:
        Settings.chosen(data=tmp_path, database=value)
    assert str(raised.value) == rule + censored
    assert main(["--data", str(tmp_path), "--database", value]) == 2
    assert capsys.readouterr().err == f"error: {rule}{censored}\n"
    result = CliRunner().invoke(app, ["up", "--data", str(tmp_path), "--database", value])
    assert result.exit_code != 0
    assert rule + censored in result.stderr


@pytest.mark.parametrize(
    "value",
    [
        "postgresql://me:first@second@host/x",
        "postgresql://me:first@second/third@host/x",
        "postgresql://me:first@second@host:54x/x",
        "postgresql://me:first@second@host/",
        "mysql://me:first@second@host/x",
    ],
)
def test_no_part_of_a_password_with_an_at_sign_is_shown(value: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="not shown because it may hold a password") as raised:
        Settings.chosen(data=tmp_path, database=value)
    for part in ("first", "second", "third"):
        assert part not in str(raised.value)


def test_a_password_is_not_shown(tmp_path: Path) -> None:
    settings = Settings.chosen(
        data=tmp_path, database="postgresql://me:s3cret@host/name?sslpassword=s3cret"
    )
    assert "s3cret" not in f"{settings!r} {settings} {settings.model_dump_json()}"
    assert settings.database_name == "postgresql://me:***@host/name"


def test_a_missing_driver_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stickslip_services.database.opening.find_spec", lambda _name: None)
    with pytest.raises(
        DatabaseRefusedError, match=r"pip install ./schemas './services\[server,postgresql\]'"
    ):
        connect(Settings.chosen(data=tmp_path, database="postgresql://me@host/name"))
