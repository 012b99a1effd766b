"""A store by its URL: everything that takes `--store` uses a bucket, or refuses in a sentence."""

import re
from pathlib import Path

import numpy as np
import pytest
import zarr
import zarr.storage
from click.testing import CliRunner, Result
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.documents.responses import JobDetail
from stickslip_services import app as program
from stickslip_services.app import make_app
from stickslip_services.catalog.versions import damaged_files
from stickslip_services.cli import app
from stickslip_services.errors import SettingsError
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import PROBE_SECONDS, Context
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, list_datasets, parsed, rods, show_job
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker

pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")

import obstore.store
from stickslip_testing.s3 import Proxy, no_fault

REFUSAL = r"store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got 's3:/lab/store'"


@pytest.mark.parametrize(
    "command", [["up"], ["gc"], ["rm", "ds-0123456789abcdef:v1"], ["reindex"], ["coordinator"]]
)
def test_a_place_that_is_no_store_is_refused(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    verb, *rest = command
    words = [*rest, "--data", "data", "--store", "s3:/lab/store"]
    if verb == "coordinator":
        status, output = program.main(words), ""
    else:
        result = CliRunner().invoke(app, [verb, *words], env={"COLUMNS": "200"})
        status, output = result.exit_code, result.output
    assert status != 0
    assert re.search(REFUSAL, output + capfd.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_nobody_else_reads_the_database(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir(mode=0o755)
    (data / "coordinator.sqlite3").touch(mode=0o644)
    context = Context.open(Settings(data=data, durable=False))
    start(context)
    (database,) = data.glob("coordinator.sqlite3")
    context.close()
    assert [place.stat().st_mode & 0o777 for place in (data, database)] == [0o700, 0o600]


def test_the_environment_is_checked_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STICKSLIP_STORE", "s3:/lab/store")
    with pytest.raises(SettingsError, match=REFUSAL):
        Settings.chosen(data=tmp_path)


@pytest.fixture
def in_bucket(bucket: str, tmp_path: Path) -> Settings:
    return Settings.chosen(data=tmp_path / "data", store=bucket, durable=False)


def stickslip(*words: str) -> Result:
    return CliRunner().invoke(app, words)


def objects(bucket: str) -> dict[str, float]:
    """Return the names of all objects of a bucket, and when they were written."""
    root = obstore.store.S3Store(bucket.removeprefix("s3://").partition("/")[0])
    return {
        item["path"]: item["last_modified"].timestamp()
        for page in obstore.list(root)
        for item in page
    }


def submitted(context: Context, gamma: tuple[float, ...]) -> JobDetail:
    job = submit_job(context, parsed(rods(gamma=gamma)), None)
    assert isinstance(job, JobDetail)
    return job


def test_a_bucket_is_a_store_like_any_other(
    in_bucket: Settings, bucket: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Make two datasets, read one, remove one, collect, lose the database, and find the other one
    again.
    """
    context = Context.open(in_bucket)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    names = []
    for gamma in ((1.0, 2.0), (2.0, 3.0)):
        job = submitted(context, gamma)
        worker.work()
        dataset = show_job(context, job.id).dataset
        assert dataset is not None
        names.append(dataset.dataset)
    stray = context.store.publish(b"nobody refers to this")
    context.close()
    assert not (tmp_path / "data" / "store").exists()

    with serving(make_app(in_bucket)) as url:
        served = zarr.open_group(f"{url}/v1/datasets/{names[0]}/versions/1/files/", mode="r")["mu"]
        assert isinstance(served, zarr.Array)
        assert np.array_equal(served[:], np.arange(4.0))
    host, _, prefix = bucket.removeprefix("s3://").partition("/")
    place = obstore.store.S3Store(host, prefix=f"{prefix}/datasets/{names[0]}/v1")
    column = zarr.open_group(zarr.storage.ObjectStore(place, read_only=True), mode="r")["mu"]
    assert isinstance(column, zarr.Array)
    assert np.array_equal(column[:], np.arange(4.0))

    place_options = ["--data", str(in_bucket.data), "--store", bucket]
    assert stickslip("gc", "--delete", "--older-than", "0", *place_options).exit_code == 0
    assert not any(stray in name for name in objects(bucket))
    assert stickslip("rm", f"{names[1]}:v1", *place_options).exit_code == 0
    assert not any(names[1] in name for name in objects(bucket))
    assert stickslip("gc", "--delete", "--older-than", "0", *place_options).exit_code == 0
    counted = stickslip("gc", "--older-than", "0", *place_options)
    assert "0 files, 0.0 MB, that nothing refers to may be deleted" in counted.output

    in_bucket.database_path.unlink()
    assert program.main(["--port", "0", *place_options]) == 2
    output = capfd.readouterr().err
    assert f"{bucket} holds datasets, and the database" in output
    assert "run `stickslip reindex" in output
    assert f"{names[0]}:v1  4 samples" in stickslip("reindex", *place_options).output
    context = Context.open(in_bucket)
    start(context)
    (listed,) = list_datasets(context)
    (version,) = listed.versions
    assert listed.id == names[0]
    assert damaged_files(context.store, version.manifest, version.group) == {}
    context.close()


def test_what_a_version_shows_is_kept_though_no_database_knows_it(
    in_bucket: Settings, bucket: str
) -> None:
    """A database from an old backup knows less than the bucket."""
    context = Context.open(in_bucket)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    submitted(context, (1.0, 2.0))
    worker.work()
    context.close()
    in_bucket.database_path.unlink()
    fresh = Context.open(in_bucket)
    start(fresh)
    PretendWorker(DirectApi(fresh), fresh.store).register()
    submitted(fresh, (5.0,))  # it is in use, and has none of the earlier results
    fresh.close()
    before = {name for name in objects(bucket) if "/datasets/" in name}
    assert (
        stickslip(
            "gc", "--delete", "--older-than", "0", "--data", str(in_bucket.data), "--store", bucket
        ).exit_code
        == 0
    )
    assert {name for name in objects(bucket) if "/datasets/" in name} == before
    assert stickslip("reindex", "--data", str(in_bucket.data), "--store", bucket).exit_code == 0


def test_jobs_wait_while_the_bucket_is_away(
    in_bucket: Settings, s3: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stickslip_schemas.store.bucket.PROBE_SECONDS", 0.5)
    clock = ManualClock()
    context = Context.open(in_bucket, clock)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submitted(context, (1.0,)).id
    sweep(context)
    asked = s3.counts["PUT"]
    sweep(context)
    assert s3.counts["PUT"] == asked  # a look costs money

    s3.fault = lambda method, path: "503"
    clock.advance(PROBE_SECONDS)
    sweep(context)
    detail = show_job(context, job)
    assert (detail.state, detail.reason) == (JobState.paused, Reason.store_unavailable)
    assert in_bucket.store_place in detail.message
    assert worker.lease() == ()

    s3.fault = no_fault
    sweep(context)
    worker.work()
    assert show_job(context, job).state is JobState.succeeded
    context.close()


def test_a_new_coordinator_wants_an_answer_of_its_bucket(
    bucket: str,
    s3: Proxy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """It must not start an empty queue beside datasets that it cannot see."""
    monkeypatch.setattr("stickslip_schemas.store.bucket.RETRY_SECONDS", 0.5)
    words = ["--data", str(tmp_path / "data"), "--port", "0", "--store"]
    assert program.main([*words, "s3://nobody-has-made-this/store"]) == 2
    assert "cannot be asked whether it holds datasets" in capfd.readouterr().err
    s3.fault = lambda method, path: "503"
    assert program.main([*words, bucket]) == 2
    assert f"the store {bucket} cannot be asked" in capfd.readouterr().err
