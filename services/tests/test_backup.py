"""A backup of a running service is consistent, and a service that starts with it goes on."""

import json
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner, Result
from stickslip_schemas.format.manifest import MANIFEST_NAME
from stickslip_schemas.store import DirectoryStore, open_store
from stickslip_services.app import make_app
from stickslip_services.cli import app as cli
from stickslip_services.database.database import Role
from stickslip_services.database.opening import connect
from stickslip_services.local.supervisor import locked
from stickslip_services.queue.backup import BackupRecord, make_backup
from stickslip_services.queue.backup import _copy_store as copy_store
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import rods
from stickslip_testing.servers import HttpApi, RunningServer, served, serving, wait_until
from stickslip_testing.worker import PretendWorker


def backup(settings: Settings, target: Path) -> Result:
    return CliRunner().invoke(cli, ["backup", str(target), "--data", str(settings.data)])


def submit(server: RunningServer, gamma: tuple[float, ...], name: str) -> str:
    answer = httpx.post(f"{server.url}/v1/jobs", json=rods(gamma=gamma, name=name))
    answer.raise_for_status()
    return str(answer.json()["id"])


def state(server: RunningServer, job: str) -> str:
    return str(httpx.get(f"{server.url}/v1/jobs/{job}").json()["state"])


def restore(
    target: Path, data: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restore a backup as the guide says."""
    shutil.copytree(target, data)
    dump = data / "database.dump"
    if dump.exists():
        url = request.getfixturevalue("postgresql").empty()
        command = ["pg_restore", "--no-owner", "--exit-on-error", f"--dbname={url}", str(dump)]
        subprocess.run(command, check=True)
        monkeypatch.setenv("STICKSLIP_DATABASE", url)


@pytest.fixture
def _needs_pg_dump(database: str) -> None:
    if database == "postgresql" and shutil.which("pg_dump") is None:
        pytest.skip("pg_dump is not installed: apt-get install postgresql-client")


@pytest.mark.databases
@pytest.mark.usefixtures("_needs_pg_dump")
def test_a_restored_service_finishes_a_job_that_was_half_done(
    settings: Settings,
    database: str,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The backup is made while a worker reports; the old service then disappears."""
    target = tmp_path / "backup"
    with served(settings.data) as server:
        first = server.worker(name="first")
        done = submit(server, (1.0, 2.0), "done")
        first.work()
        wait_until(lambda: state(server, done) == "succeeded")
        half = submit(server, tuple(float(number) for number in range(10, 40)), "half")
        worker = server.worker(name="second")
        worker.finish(*worker.lease(simulate=20))
        # A lease is open in the backup, and its worker never comes back.
        worker.start(*worker.lease(simulate=5))
        is_over = threading.Event()

        def keep_writing() -> None:
            writer = server.worker(name="writer")
            while not is_over.is_set():
                writer.finish(*writer.lease(simulate=1))

        thread = threading.Thread(target=keep_writing)
        thread.start()
        result = backup(settings, target)
        is_over.set()
        thread.join()
        assert result.exit_code == 0, result.output
    shutil.rmtree(settings.data)
    restored = tmp_path / "restored"
    restore(target, restored, request, monkeypatch)
    monkeypatch.setenv("STICKSLIP_LEASE_SECONDS", "1")
    with served(restored) as server:
        assert state(server, done) == "succeeded"
        before = httpx.get(f"{server.url}/v1/jobs/{half}").json()
        assert before["progress"]["stages"]["simulate"]["counts"]["succeeded"] >= 20
        worker = server.worker(name="third")

        def finished() -> bool:
            worker.work()
            return state(server, half) == "succeeded"

        wait_until(finished)
        for name in ("done", "half"):
            pulled = tmp_path / name
            words = ["pull", name, str(pulled), "--url", server.url]
            result = CliRunner().invoke(cli, words)
            assert result.exit_code == 0, result.output
            assert CliRunner().invoke(cli, ["verify", str(pulled)]).exit_code == 0
    opened = connect(Settings.chosen(data=restored), Role.visitor)
    with opened.read() as connection:
        assert violations(connection) == []
    opened.close()
    record = BackupRecord.model_validate_json((target / "backup.json").read_bytes())
    assert (
        record.database
        == {"sqlite": "coordinator.sqlite3", "postgresql": "database.dump"}[database]
    )
    assert (target / record.database).stat().st_mode & 0o077 == 0
    assert (target / "worker-key").stat().st_mode & 0o077 == 0


def test_a_second_backup_copies_only_what_is_new(settings: Settings, tmp_path: Path) -> None:
    target = tmp_path / "backup"
    with served(settings.data) as server:
        worker = server.worker()
        submit(server, (1.0, 2.0), "first")
        worker.work()
        wait_until(lambda: len(list(server.store.versions(MANIFEST_NAME))) == 1)
        first = make_backup(settings, target)
        assert first.new_artifacts == first.artifacts > 0
        again = make_backup(settings, target)
        assert (again.new_artifacts, again.artifacts) == (0, first.artifacts)
        submit(server, (3.0, 4.0), "second")
        worker.work()
        wait_until(lambda: len(list(server.store.versions(MANIFEST_NAME))) == 2)
        third = make_backup(settings, target)
        assert 0 < third.new_artifacts < third.artifacts
    copy = DirectoryStore(target / "store")
    versions = list(copy.versions(MANIFEST_NAME))
    assert len(versions) == 2
    # Versions of the copy are hard links, too: they need no room.
    assert all(stored.is_shown for stored in copy.stored() if stored.name in version_files(copy))
    gone = versions[0]
    removed = CliRunner().invoke(
        cli, ["rm", f"{gone.dataset}:v{gone.version}", "--data", str(settings.data)]
    )
    assert removed.exit_code == 0, removed.output
    make_backup(settings, target)
    assert [version.dataset for version in copy.versions(MANIFEST_NAME)] == [versions[1].dataset]


def version_files(store: DirectoryStore) -> set[str]:
    """Return the digests of the files that versions show."""
    inodes = {path.stat().st_ino for path in (store.root / "datasets").rglob("*") if path.is_file()}
    return {
        path.name for path in (store.root / "artifacts").glob("*/*") if path.stat().st_ino in inodes
    }


def test_an_interrupted_backup_leaves_the_one_before(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "backup"
    with served(settings.data) as server:
        worker = server.worker()
        submit(server, (1.0, 2.0), "first")
        make_backup(settings, target)
        before = (target / "coordinator.sqlite3").read_bytes()
        worker.work()

        def fail(*_: object) -> None:
            raise OSError("the disk is full")

        monkeypatch.setattr("stickslip_services.queue.backup._copy_artifact", fail)
        with pytest.raises(OSError, match="the disk is full"):
            make_backup(settings, target)
        monkeypatch.undo()
        assert (target / "coordinator.sqlite3").read_bytes() == before
        assert make_backup(settings, target).new_artifacts > 0
    assert not list(target.glob("*.new*"))


def test_a_damaged_or_deleted_file_is_named(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`gc` runs on a stopped coordinator while the store is copied."""
    with served(settings.data) as server:
        worker = server.worker()
        submit(server, (1.0, 2.0), "first")
        worker.work()
        wait_until(lambda: len(list(server.store.versions(MANIFEST_NAME))) == 1)
        # The first file is the manifest: it says what the database needs.
        files = [file for file in server.store.stored() if file.is_shown and file.bytes < 1000]
        damaged, deleted = files[0].name, files[1].name
        server.store.path(damaged).write_bytes(b"\0" * files[0].bytes)

        def copied_after_gc(store: DirectoryStore, *rest: Any) -> object:
            store.path(deleted).unlink()
            return copy_store(store, *rest)

        monkeypatch.setattr("stickslip_services.queue.backup._copy_store", copied_after_gc)
        result = backup(settings, tmp_path / "backup")
    assert result.exit_code == 1, result.output
    assert f"left out, because it is damaged: {damaged}" in result.stderr
    assert f"left out, because it was deleted meanwhile: {deleted}" in result.stderr


def test_a_backup_overwrites_nothing_else(settings: Settings, tmp_path: Path) -> None:
    with served(settings.data) as server:
        submit(server, (1.0, 2.0), "first")
        foreign = tmp_path / "home"
        foreign.mkdir()
        (foreign / "thesis.tex").touch()
        for target in (foreign, settings.data):
            result = backup(settings, target)
            assert (
                result.exit_code,
                "must be empty or hold an earlier backup" in result.stderr,
            ) == (1, True)
        # A service that runs on a backup has locked it.
        target = tmp_path / "backup"
        make_backup(settings, target)
        with locked(target):
            result = backup(settings, target)
        assert (result.exit_code, "is in use" in result.stderr) == (1, True)
    empty = backup(Settings(data=tmp_path / "none"), tmp_path / "other")
    assert (empty.exit_code, "does not exist or is empty" in empty.stderr) == (1, True)
    assert json.loads((target / "backup.json").read_text())["store"] == "store"


def worker_of(server: RunningServer, place: str) -> PretendWorker:
    """Return a registered worker that writes to a store at a place."""
    key = (server.data / "worker-key").read_text().strip()
    return PretendWorker(HttpApi(server.url, key), open_store(place)).register()


def test_a_bucket_is_copied_where_that_is_asked_for(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The backup is a data directory of its own: a service starts with it, without the bucket."""
    in_bucket = Settings.chosen(data=tmp_path / "data", store=bucket, durable=False)
    target = tmp_path / "backup"
    words = ["backup", str(target), "--data", str(in_bucket.data), "--store", bucket]
    with serving(make_app(in_bucket)) as url:
        server = RunningServer(url, in_bucket.data)
        worker = worker_of(server, bucket)
        submit(server, (1.0, 2.0), "first")
        worker.work()
        without = CliRunner().invoke(cli, words)
        assert f"{bucket} is not copied: add --bucket" in without.stderr
        assert not (target / "store").exists()

        copied = CliRunner().invoke(cli, [*words, "--bucket"])
        assert copied.exit_code == 0, copied.output
        again = make_backup(in_bucket, target, copies_bucket=True)
        assert (again.new_artifacts, again.damaged, again.missing) == (0, [], [])
        assert again.artifacts == len(list(open_store(bucket).stored())) > 0
        submit(server, (3.0, 4.0), "second")
        worker.work()
        third = make_backup(in_bucket, target, copies_bucket=True)
        assert 0 < third.new_artifacts < third.artifacts

    copy = DirectoryStore(target / "store")
    assert set(copy.version_files()) == set(open_store(bucket).version_files())
    # Versions of the copy are hard links: they need no room.
    assert all(stored.is_shown for stored in copy.stored() if stored.name in version_files(copy))
    # The account of the bucket is gone.
    for name in ("AWS_ENDPOINT_URL", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name, raising=False)
    restored = tmp_path / "restored"
    shutil.copytree(target, restored)
    with served(restored) as server:
        for name in ("first", "second"):
            pulled = tmp_path / name
            result = CliRunner().invoke(cli, ["pull", name, str(pulled), "--url", server.url])
            assert result.exit_code == 0, result.output
            assert CliRunner().invoke(cli, ["verify", str(pulled)]).exit_code == 0


def test_a_version_that_is_removed_from_a_bucket_is_hidden_in_its_copy(
    bucket: str, tmp_path: Path
) -> None:
    in_bucket = Settings.chosen(data=tmp_path / "data", store=bucket, durable=False)
    target = tmp_path / "backup"
    with serving(make_app(in_bucket)) as url:
        server = RunningServer(url, in_bucket.data)
        worker = worker_of(server, bucket)
        submit(server, (1.0, 2.0), "first")
        worker.work()
        make_backup(in_bucket, target, copies_bucket=True)
    copy = DirectoryStore(target / "store")
    (version,) = copy.versions(MANIFEST_NAME)
    open_store(bucket).hide(version.dataset, version.version)
    make_backup(in_bucket, target, copies_bucket=True)
    assert list(copy.version_files()) == []
