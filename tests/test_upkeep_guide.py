"""The page "Run it for a year": its blocks run as they are printed, with the paths of the test."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner
from harness import STICKSLIP, Service, wait_for
from stickslip_services.app import main as coordinator
from stickslip_services.cli import app as cli

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "run-for-a-year.md").read_text()
OLDER = ROOT / "tests" / "data" / "older-data.tar.xz"
"""Data of a coordinator 300 commits before this test: a dataset, and a job that is half done."""


def block(begin: str) -> str:
    """Return the code of the first block that begins with some words."""
    codes = re.findall(rf"```sh\n({re.escape(begin)}.*?)```", PAGE, re.S)
    return str(codes[0])


def run(code: str, data: Path, backup: Path) -> str:
    """Run a block with the directories of the test; return its output."""
    script = code.replace("/srv/stickslip-data", str(data)).replace(
        "/backup/stickslip", str(backup)
    )
    environment = {**os.environ, "PATH": f"{STICKSLIP.parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-euc", script], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_service_is_lost_and_restored(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """The machine dies in the middle of a job; the service that is restored ends the job."""
    data, backup = tmp_path / "data", tmp_path / "backup"
    service = Service(data, "--slots", "1")
    service.start()
    request.addfinalizer(service.stop)
    gamma = {"type": "linspace", "start": 100, "stop": 1300, "num": 60}
    axes = {"gamma": gamma, "phi0": 0.2, "phi1": 6.0}
    job = service.submit({"kind": "rod_hang", "name": "half", "axes": axes, "quality": "draft"})

    def is_half_done() -> bool | None:
        counts = service.get(f"/v1/jobs/{job}")["progress"]["stages"]
        return counts.get("render", {}).get("counts", {}).get("succeeded", 0) >= 5 or None

    wait_for("the first pictures", is_half_done, 200)
    result = run(block("stickslip backup /backup"), data, backup)
    assert " files, " in result
    assert service.process is not None
    service.process.send_signal(signal.SIGKILL)
    service.process.wait()
    *commands, last = block("mv /srv/stickslip-data /srv").splitlines()
    run("\n".join(commands), data, backup)
    assert last == "stickslip up --data /srv/stickslip-data"
    restored = Service(data, "--slots", "1")
    restored.start()
    try:
        assert restored.finished(job)["state"] == "succeeded"
        pulled = [str(STICKSLIP), "pull", "half", str(tmp_path / "half"), "--url", restored.url]
        subprocess.run(pulled, check=True, capture_output=True)
        subprocess.run([STICKSLIP, "verify", tmp_path / "half"], check=True, capture_output=True)
    finally:
        restored.stop()


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """A data directory of an older state."""
    data = tmp_path / "data"
    with tarfile.open(OLDER) as archive:
        archive.extractall(data, filter="data")
    return data


def test_an_older_data_directory_is_refused_and_stays_as_it_is(
    older: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = older / "coordinator.sqlite3"
    before = database.read_bytes()
    assert coordinator(["--data", str(older), "--port", "0"]) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert "made by an earlier state of this version of stickslip" in sentence
    assert f"move {database} away and run `stickslip reindex --data {older}`" in sentence
    for words in (["up", "--port", "0"], ["keys", "list"], ["gc"], ["backup", str(older / "x")]):
        refused = CliRunner().invoke(cli, [*words, "--data", str(older)])
        assert refused.exit_code == 1, words
        assert "earlier state" in refused.stderr, words
    assert database.read_bytes() == before


def test_the_datasets_of_an_older_directory_go_on(older: Path, tmp_path: Path) -> None:
    """As the page says: move the database away, and index the store."""
    run(block("mv /srv/stickslip-data/coordinator.sqlite3"), older, tmp_path)
    assert (older / "coordinator.sqlite3.old").exists()
    command = [sys.executable, "-m", "stickslip_services.app", "--data", str(older), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        pulled = CliRunner().invoke(cli, ["pull", "older", str(tmp_path / "x"), "--url", url])
        assert pulled.exit_code == 0, pulled.output
        assert CliRunner().invoke(cli, ["verify", str(tmp_path / "x")]).exit_code == 0
        assert [job["name"] for job in httpx.get(f"{url}/v1/jobs").json()["items"]] == ["older"]
        process.terminate()
    shutil.rmtree(tmp_path / "x")
