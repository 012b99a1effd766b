"""A coordinator on a temporary directory: in the process with a clock of its own, or as a server.

Tests marked `databases` run on SQLite and on PostgreSQL; with `databases(slow=True)` on PostgreSQL
only as slow tests.
"""

import itertools
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING

import pytest
from stickslip_services.database.database import Database, Role
from stickslip_services.database.opening import connect, opened
from stickslip_services.queue.background import start
from stickslip_services.queue.context import Context
from stickslip_services.queue.planner import Planner
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock
from stickslip_testing.servers import RunningServer, served
from stickslip_testing.worker import DirectApi, PretendWorker

if TYPE_CHECKING:
    from stickslip_testing.postgresql import PostgresqlServer
    from stickslip_testing.s3 import Proxy

_buckets = itertools.count()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    marker = metafunc.definition.get_closest_marker("databases")
    if marker is not None and "database" in metafunc.fixturenames:
        marks = [pytest.mark.slow] if marker.kwargs.get("slow") else []
        both = ["sqlite", pytest.param("postgresql", marks=marks)]
        metafunc.parametrize("database", both, indirect=True)


@pytest.fixture(scope="session")
def postgresql() -> Iterator["PostgresqlServer"]:
    """A PostgreSQL server, started with the first test that needs it."""
    if find_spec("psycopg") is None:
        pytest.skip("psycopg is not installed: make setup-dev")
    from stickslip_testing.postgresql import find_programs, postgresql_server

    programs = find_programs()
    if programs is None:
        pytest.skip("PostgreSQL's server is not installed: apt-get install postgresql")
    with postgresql_server(programs) as server:
        yield server


@pytest.fixture(scope="session")
def s3() -> Iterator["Proxy"]:
    """An S3 server behind a proxy, started with the first test that needs it."""
    pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
    pytest.importorskip("moto", reason="moto is not installed: make setup-dev")
    from stickslip_testing.s3 import s3_proxy

    with s3_proxy() as proxy:
        yield proxy


@pytest.fixture
def bucket(s3: "Proxy", monkeypatch: pytest.MonkeyPatch) -> str:
    """The place of an empty store in a bucket, which processes find by their environment."""
    from stickslip_testing.s3 import make_bucket, no_fault, variables

    s3.fault = no_fault
    for variable, value in variables(s3).items():
        monkeypatch.setenv(variable, value)
    name = f"services-{next(_buckets)}"
    make_bucket(s3, name)
    return f"s3://{name}/lab"


@pytest.fixture
def database(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Which database the coordinators of a test use, also those in other processes."""
    chosen: str = getattr(request, "param", "sqlite")
    if chosen == "postgresql":
        server: PostgresqlServer = request.getfixturevalue("postgresql")
        monkeypatch.setenv("STICKSLIP_DATABASE", server.clean())
    return chosen


@pytest.fixture
def empty_database(
    database: str, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[Callable[[], Database]]:
    """Makes databases without tables."""
    databases: list[Database] = []

    def make() -> Database:
        url = None if database == "sqlite" else request.getfixturevalue("postgresql").empty()
        databases.append(
            connect(
                Settings.chosen(data=tmp_path / str(len(databases)), durable=False, database=url)
            )
        )
        return databases[-1]

    yield make
    for database_ in databases:
        database_.close()


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test cuts the power, so none waits for the disk."""
    monkeypatch.setattr("os.fsync", lambda _descriptor: None)
    monkeypatch.setenv("STICKSLIP_DURABLE", "0")


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def settings(tmp_path: Path, database: str, request: pytest.FixtureRequest) -> Settings:
    """Settings of a coordinator.

    Parametrise it indirectly with a dictionary for others than the defaults.
    """
    return Settings(data=tmp_path / "data", durable=False, **getattr(request, "param", {}))


@pytest.fixture(scope="session")
def migrated_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite file with all tables: a copy of it saves each test the migration."""
    settings = Settings(data=tmp_path_factory.mktemp("migrated"), database=None, durable=False)
    with opened(settings, Role.visitor):
        return settings.database_path


@pytest.fixture
def context(settings: Settings, clock: ManualClock, migrated_file: Path) -> Iterator[Context]:
    if settings.database is None:
        settings.data.mkdir()
        copyfile(migrated_file, settings.database_path)
    opened = Context.open(settings, clock)
    start(opened)
    yield opened
    opened.close()


@pytest.fixture
def planner(context: Context) -> Planner:
    """The planner of the coordinator's background service."""
    return Planner(context)


@pytest.fixture
def worker(context: Context) -> PretendWorker:
    """A registered worker that talks to the coordinator without HTTP."""
    return PretendWorker(DirectApi(context), context.store).register()


@pytest.fixture
def server(tmp_path: Path, database: str) -> Iterator[RunningServer]:
    """A server for one test."""
    with served(tmp_path / "data") as running:
        yield running


@pytest.fixture(scope="session")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server for all tests that do not depend on its other jobs."""
    with served(tmp_path_factory.mktemp("shared") / "data") as running:
        yield running
