"""A lost database is built again from the datasets.

One that is damaged or newer is refused in one sentence.
"""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from sqlalchemy import text
from stickslip_schemas.base import JobState, sha256
from stickslip_schemas.format.manifest import MANIFEST_NAME
from stickslip_schemas.store import DirectoryStore
from stickslip_services.app import main
from stickslip_services.cli import app
from stickslip_services.database.database import Role, SqliteDatabase
from stickslip_services.database.opening import check, opened
from stickslip_services.errors import DatabaseRefusedError
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.maintenance import reindex
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import list_datasets, list_jobs, parsed, rods, show_job
from stickslip_testing.servers import served
from stickslip_testing.worker import DirectApi, PretendWorker, rejection


@pytest.fixture
def datasets_before(settings: Settings) -> dict[str, object]:
    """Two datasets, one with a rejected sample; then the database is lost. Their listings."""
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    worker.judge = lambda task: (
        rejection() if task.stage == "simulate" and task.simulation.gamma == 9.0 else None
    )
    for spec in (rods(name="first"), rods(gamma=(9.0, 1.0))):
        submit_job(context, parsed(spec), None)
        worker.work()
    known = {dataset.id: dataset for dataset in list_datasets(context)}
    context.close()
    for path in settings.data.glob("coordinator.sqlite3*"):
        path.unlink()
    return dict(known)


def run(settings: Settings) -> Result:
    return CliRunner().invoke(app, ["reindex", "--data", str(settings.data)])


def test_a_lost_database_is_not_taken_for_a_new_one(
    settings: Settings, datasets_before: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(settings.data), "--port", "0"]) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert "is gone: run `stickslip reindex --data" in sentence
    up = CliRunner().invoke(app, ["up", "--data", str(settings.data), "--port", "0"])
    assert (up.exit_code, "stickslip reindex" in up.stderr) == (1, True)


def test_a_database_is_migrated_before_a_coordinator_starts(
    settings: Settings,
    datasets_before: dict[str, object],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--migrate", "--data", str(tmp_path / "new")]) == 0
    assert check(Settings(data=tmp_path / "new"), Role.coordinator)
    assert (
        main(["--migrate", "--data", str(settings.data)]) == 2
    )  # or the next coordinator would not miss anything
    assert "is gone: run `stickslip reindex --data" in capsys.readouterr().err
    assert not settings.database_path.exists()


def test_datasets_are_found_again(
    settings: Settings, datasets_before: dict[str, object], tmp_path: Path
) -> None:
    result = run(settings)
    assert result.exit_code == 0, result.output
    assert "2 versions found again, 0 known before, 0 left out" in result.stderr
    again = run(settings)
    assert "0 versions found again, 2 known before, 0 left out" in again.stderr
    with served(settings.data) as server:
        for dataset in datasets_before:
            pulled = CliRunner().invoke(
                app, ["pull", dataset, str(tmp_path / dataset), "--url", server.url]
            )
            assert pulled.exit_code == 0, pulled.output
            assert CliRunner().invoke(app, ["verify", str(tmp_path / dataset)]).exit_code == 0
    context = Context.open(settings)
    start(context)
    indexed = {dataset.id: dataset for dataset in list_datasets(context)}
    assert indexed.keys() == datasets_before.keys()
    for dataset, before in datasets_before.items():
        (old,), (new,) = before.versions, indexed[dataset].versions  # type: ignore[attr-defined]
        same = ("version", "manifest", "group", "sample_count", "valid_count", "bytes")
        assert [getattr(new, name) for name in same[:-1]] == [
            getattr(old, name) for name in same[:-1]
        ]
        assert indexed[dataset].name == before.name  # type: ignore[attr-defined]
    assert {job.state for job in list_jobs(context)} == {
        JobState.succeeded,
        JobState.succeeded_with_rejects,
    }
    assert all(job.message.startswith("found again in the store") for job in list_jobs(context))
    with context.database.read() as connection:
        assert violations(connection) == []
    context.close()


def test_a_spec_that_is_submitted_again_finds_its_dataset(
    settings: Settings, datasets_before: dict[str, object]
) -> None:
    run(settings)
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(rods(name="first")), None)
    sweep(context)
    detail = show_job(context, job.id)  # type: ignore[union-attr]
    assert detail.state is JobState.succeeded
    assert worker.work() == 0
    bigger = submit_job(context, parsed(rods(gamma=(1.0, 2.0, 3.0))), None)
    worker.work()
    assert show_job(context, bigger.id).state is JobState.succeeded  # type: ignore[union-attr]
    with context.database.read() as connection:
        assert violations(connection) == []
    context.close()


def test_a_dataset_that_rots_afterwards_is_made_again(
    settings: Settings, datasets_before: dict[str, object]
) -> None:
    run(settings)
    store = DirectoryStore(settings.store_place)
    (path,) = store.dataset_path(next(iter(datasets_before)), 1).glob("views/c/0/0")
    store.path(sha256(path.read_bytes())).unlink()
    path.write_bytes(b"rotten")
    context = Context.open(settings)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    worker.judge = lambda task: (
        rejection() if task.stage == "simulate" and task.simulation.gamma == 9.0 else None
    )
    spec = (
        rods(gamma=(9.0, 1.0))
        if path.parts[-6] == next(iter(datasets_before))
        else rods(name="first")
    )
    job = submit_job(context, parsed(spec), None)
    sweep(context)
    assert worker.work() > 0
    assert not show_job(context, job.id).state.is_open  # type: ignore[union-attr]
    assert show_job(context, job.id).dataset is not None  # type: ignore[union-attr]
    context.close()


@pytest.mark.parametrize("damage", ["manifest", "file", "moved"])
def test_a_version_that_is_not_whole_is_left_out(
    settings: Settings, datasets_before: dict[str, object], damage: str
) -> None:
    store = DirectoryStore(settings.store_place)
    place = store.dataset_path(next(iter(datasets_before)), 1)
    if damage == "manifest":
        (
            place / MANIFEST_NAME
        ).unlink()  # it is a link: the artifact must not be written through it
        (place / MANIFEST_NAME).write_text("{}")
    elif damage == "file":
        store.path(sha256((place / "views/c/0/0").read_bytes())).unlink()
        (place / "views/c/0/0").unlink()
    else:
        place.rename(place.parent / "v7")
    result = run(settings)
    assert result.exit_code == 1
    assert "1 versions found again, 0 known before, 1 left out" in result.stderr
    assert f"left out: {place.parent.name}:v" in result.stderr.replace("\n", "")


def test_an_artifact_that_is_gone_is_put_back_from_the_version(
    settings: Settings, datasets_before: dict[str, object]
) -> None:
    store = DirectoryStore(settings.store_place)
    path = store.dataset_path(next(iter(datasets_before)), 1) / "views/c/0/0"
    digest = sha256(path.read_bytes())
    store.path(digest).unlink()
    assert run(settings).exit_code == 0
    assert store.holds(digest)


def test_it_does_not_write_beside_a_running_coordinator(
    settings: Settings, datasets_before: dict[str, object]
) -> None:
    with locked(settings.data):
        result = run(settings)
    assert result.exit_code == 1
    assert "is in use by another `stickslip up`" in result.stderr
    with opened(settings, Role.upkeep) as database:
        assert [
            version.is_new for version in reindex(database, DirectoryStore(settings.store_place))
        ] == [True, True]


def one_sentence(settings: Settings, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the sentence with which a coordinator refuses its database."""
    with pytest.raises(DatabaseRefusedError) as raised:
        check(settings, Role.coordinator, with_store=True)
    assert "\n" not in str(raised.value)
    assert main(["--data", str(settings.data), "--port", "0"]) == 2
    assert capsys.readouterr().err == f"error: {raised.value}\n"
    return str(raised.value)


def test_a_newer_database_is_refused(
    settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:
    with opened(settings, Role.upkeep) as database, database.write() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9042'"))
    sentence = one_sentence(settings, capsys)
    assert "has the schema 9042, and this version of stickslip knows 0001" in sentence
    assert "install the version that made it again" in sentence


@pytest.mark.parametrize("revision", ["0001", "0001_0123456789ab"])
def test_the_directory_of_an_earlier_state_is_refused_and_not_touched(
    settings: Settings,
    datasets_before: dict[str, object],
    capsys: pytest.CaptureFixture[str],
    revision: str,
) -> None:
    """0.1.0 was not released: its tables have changed without a migration."""
    with opened(settings, Role.upkeep) as database, database.write() as connection:
        connection.execute(text("DROP TABLE ready_tasks"))
        connection.execute(text(f"UPDATE alembic_version SET version_num = '{revision}'"))
    before = settings.database_path.read_bytes()
    sentence = one_sentence(settings, capsys)
    assert (
        "was made by an earlier state of this version of stickslip, whose tables were others "
        f"(schema {revision})" in sentence
    )
    assert (
        f"move {settings.database_path} away and run `stickslip reindex --data {settings.data}`"
        in sentence
    )
    with pytest.raises(DatabaseRefusedError), opened(settings, Role.upkeep):
        pass
    assert settings.database_path.read_bytes() == before

    # Doing as the sentence says brings the datasets back.
    settings.database_path.rename(settings.data / "old.sqlite3")
    result = run(settings)
    assert (result.exit_code, "2 versions found again" in result.output) == (0, True)


@pytest.mark.parametrize("how", ["overwritten", "truncated", "not one", "another's"])
def test_a_damaged_database_is_refused(
    settings: Settings, how: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = settings.database_path
    with opened(settings, Role.upkeep):
        pass
    if how == "another's":
        path.unlink()
        other = SqliteDatabase(path)
        with other.write() as connection:
            connection.execute(text("CREATE TABLE birds (name)"))
        other.close()
        assert "is not a database of stickslip" in one_sentence(settings, capsys)
        return
    content = path.read_bytes()
    for beside in settings.data.glob("coordinator.sqlite3-*"):
        beside.unlink()
    if how == "overwritten":
        path.write_bytes(content[:4096] + b"\xff" * 8192 + content[12288:])
    elif how == "truncated":
        path.write_bytes(content[: len(content) // 2])
    else:
        path.write_text("no database at all, " * 500)
    sentence = one_sentence(settings, capsys)
    assert "is damaged" in sentence
    assert "run `stickslip reindex --data" in sentence
