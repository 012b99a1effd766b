"""The command line against a real coordinator."""

import json
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner, Result
from stickslip_services.cli import app
from stickslip_services.client import Client
from stickslip_testing.jobs import rods
from stickslip_testing.servers import RunningServer, served, start_server, wait_until
from stickslip_testing.worker import PretendWorker, rejection


@pytest.fixture
def cli(shared_server: RunningServer) -> Any:
    runner = CliRunner()

    def run(*arguments: object) -> Result:
        words = [str(argument) for argument in arguments]
        return runner.invoke(app, words, env={"STICKSLIP_URL": shared_server.url, "COLUMNS": "200"})

    return run


def write(path: Path, spec: Any) -> Path:
    path.write_text(yaml.safe_dump(spec) if path.suffix == ".yaml" else json.dumps(spec))
    return path


def test_a_grid_becomes_a_verified_directory(
    cli: Any, shared_server: RunningServer, tmp_path: Path
) -> None:
    spec = write(tmp_path / "spec.yaml", rods(name="cli", gamma=(1.0, 2.0)))
    worker = shared_server.worker()
    rejected: list[str] = []

    def reject_the_first_render(task: Any) -> Any:
        if task.stage != "render" or rejected:
            return None
        rejected.append(task.record.digest)
        return rejection("it [fell] off")

    worker.judge = reject_the_first_render
    counts = json.loads(cli("validate", spec, "--json").stdout)
    assert (counts["sample_count"], counts["cached_count"]) == (4, 0)
    assert "4" in cli("validate", spec).stdout
    done = threading.Thread(target=wait_until, args=(lambda: worker.work() > 0,))
    done.start()
    submitted = cli("submit", spec, "--watch")
    done.join()
    assert submitted.exit_code == 0, submitted.output
    job = submitted.stdout.split()[0]
    assert "published ds-" in submitted.stdout
    assert "succeeded_with_rejects" in submitted.stdout
    assert cli("watch", job).exit_code == 0
    output = cli("show", job).stdout
    assert "3 of 4 samples (75.0%)" in output
    assert "it [fell] off" in output
    assert json.loads(cli("show", job, "--json").stdout)["state"] == "succeeded_with_rejects"
    assert job in cli("jobs").stdout
    assert json.loads(cli("jobs", "--json").stdout)[0]["id"] == job
    dataset = json.loads(cli("datasets", "--json").stdout)[0]
    assert f"{dataset['id']}:v1" in cli("datasets").stdout
    pulled = cli("pull", dataset["id"], tmp_path / "d")
    assert "8 files downloaded" in pulled.stdout, pulled.output
    assert (
        "0 files downloaded (0 B), 8 already there"
        in cli("pull", f"{dataset['id']}:v1", tmp_path / "d").stdout
    )
    assert cli("verify", tmp_path / "d").exit_code == 0
    (tmp_path / "d" / "views/c/0/0").write_bytes(b"")
    wrong = cli("verify", tmp_path / "d")
    assert wrong.exit_code == 1
    assert "views/c/0/0" in wrong.stdout
    assert cli("pull", f"{dataset['id']}:v7", tmp_path / "e").exit_code == 1
    assert cli("pull", f"{dataset['id']}:vx", tmp_path / "e").exit_code == 1
    assert "has ended" in cli("cancel", job).stderr


def test_a_valid_spec_that_would_be_refused_now(tmp_path: Path) -> None:
    axes = {"material": ["gray-interlock"], "mu": [0.5], "texture": ["dots"], "viewpoint": ["left"]}
    file = write(tmp_path / "cloth.yaml", {"kind": "cloth_drag", "axes": axes})
    # Workers of other tests may be registered at the shared server.
    with served(tmp_path / "data") as server:
        server.worker()
        env = {"STICKSLIP_URL": server.url, "COLUMNS": "200"}
        refused = CliRunner().invoke(app, ["validate", str(file)], env=env)
    assert refused.exit_code == 1
    assert "would be refused now: no worker" in refused.stderr


def test_a_cancelled_job_is_no_success(
    cli: Any, tmp_path: Path, shared_server: RunningServer
) -> None:
    job = cli("submit", write(tmp_path / "spec.json", rods(gamma=(31.0,)))).stdout.strip()
    assert "cancelled" in cli("cancel", job).stdout
    watched = cli("watch", job)
    assert watched.exit_code == 1
    assert ": cancelled" in watched.stdout


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "kind: rod_hang\naxes: {gamma: -1e0, phi0: 0.0, phi1: 0.0}",
            ["axes.gamma", "greater than or equal to 0", "-1.0"],
        ),
        (
            "kind: rod_hang\naxes: {gamma: .nan, phi0: 0.0, phi1: 0.0}",
            ["axes.gamma must be a finite number", "nan"],
        ),
        ("kind: rod_hang\nkind: rod_hang", ["the key 'kind' is there twice"]),
        ("kind: [", ["is not YAML"]),
        ("- 1", ["must hold a mapping"]),
        ("kind: rod_hang\naxes: 2020-01-01", ["axes: must be an object"]),
        ("1: 2", ["the key 1 is no word"]),
        ("kind: &a {axes: *a}", ["the alias *a must not stand inside of its own anchor"]),
        (
            "a: &a [1, 1]"
            + "".join(f"\n{to}: &{to} [*{of}, *{of}]" for of, to in pairwise("abcdefghijklm")),
            ["must hold at most 5000 values, with aliases written out"],
        ),
        ("kind: cloth_scene\nscene: a.yaml", ["there is no file"]),
        (
            "kind: cloth_scene\nscene: {format: stickslip-scene/1, duration: 1, "
            "default_friction: 0, bodies: {egg: {type: mesh, file: egg.obj}}, sheets: {a: "
            "{material: gray-interlock, mesh: {type: grid, size: [1, 1], cells: [1, 1]}}}}",
            ["bodies.egg.file: must be readable: No such file or directory, in egg.obj"],
        ),
    ],
)
def test_a_bad_file_is_refused_in_words(
    cli: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, words: list[str]
) -> None:
    monkeypatch.setattr("stickslip_services.cli.documents.MAX_VALUES", 5000)
    (tmp_path / "spec.yaml").write_text(text)
    result = cli("submit", tmp_path / "spec.yaml")
    assert result.exit_code == 1
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.stderr


def test_other_errors_are_words_too(cli: Any, tmp_path: Path) -> None:
    assert "there is no file" in cli("submit", tmp_path / "none.yaml").stderr
    assert "there is no job" in cli("show", "job-0").stderr
    assert "there is nothing at /v1/jobs/../jobs" in cli("show", "../jobs").stderr
    assert "job-0" in cli("watch", "job-0").stderr
    assert "no dataset" in cli("verify", tmp_path).stdout
    assert cli("--version").stdout.startswith("stickslip 0.")
    up = cli("up", "--host", "0.0.0.0", "--data", tmp_path / "data")
    assert up.exit_code == 1
    assert "loopback" in up.stderr


@pytest.mark.real
def test_watching_survives_a_restart_of_the_coordinator(tmp_path: Path) -> None:
    server = start_server(tmp_path / "data")
    port = int(server.url.rsplit(":", 1)[1])
    worker: PretendWorker = server.worker()
    spec = write(tmp_path / "spec.yaml", rods())
    results: list[Result] = []

    def watch() -> None:
        results.append(
            CliRunner().invoke(app, ["submit", str(spec), "--watch", "--url", server.url])
        )

    watching = threading.Thread(target=watch)
    watching.start()
    wait_until(lambda: bool(worker.lease(simulate=1)))
    server.process.kill()
    server.process.wait()
    server.stop()
    again = start_server(tmp_path / "data", port)
    wait_until(
        lambda: worker.work() > 0
    )  # the one that was leased is given back: its holder is alive
    worker.register()
    wait_until(lambda: worker.work() > 0 or bool(results))
    watching.join(30)
    again.stop()
    assert results[0].exit_code == 0, results[0].output
    assert results[0].stdout.count(": succeeded\n") == 1


def test_pausing_and_resuming(cli: Any, tmp_path: Path, shared_server: RunningServer) -> None:
    submitted = cli("submit", write(tmp_path / "spec.json", rods(gamma=(41.0,))))
    job = submitted.stdout.strip()
    assert f"stickslip watch {job}" in submitted.stderr
    paused = cli("pause", job).stdout
    assert "paused" in paused
    assert f"stickslip resume {job}" in paused
    assert "is queued" in cli("resume", job).stdout
    assert "cancelled" in cli("cancel", job).stdout
    assert "can be paused" in cli("pause", job).stderr
    shared_server.worker(name="shown")
    assert "shown" in cli("workers").stdout


def test_without_a_coordinator_it_fails_at_once_and_validates_all_the_same(tmp_path: Path) -> None:
    runner = CliRunner()
    spec = write(tmp_path / "spec.yaml", rods())
    env = {"STICKSLIP_URL": "http://127.0.0.1:1", "COLUMNS": "200"}
    begin = time.monotonic()
    for command in (["jobs"], ["submit", str(spec)], ["workers"], ["watch", "job-0"]):
        done = runner.invoke(app, command, env=env)
        assert done.exit_code == 1
        assert "stickslip up" in done.stderr
    assert time.monotonic() - begin < 5.0
    valid = runner.invoke(app, ["validate", str(spec)], env=env)
    assert valid.exit_code == 0, valid.output
    assert "samples                    4" in valid.stdout
    assert "No coordinator answers" in valid.stderr
    wrong = write(tmp_path / "wrong.yaml", rods(gamma=(-1.0,)))
    costs = json.loads(runner.invoke(app, ["validate", str(spec), "--json"], env=env).stdout)[
        "estimate"
    ]
    assert (
        costs["cpu_seconds"]["low"] < costs["cpu_seconds"]["median"] < costs["cpu_seconds"]["high"]
    )
    assert "CPU time, render" in valid.stdout
    invalid = runner.invoke(app, ["validate", str(wrong)], env=env)
    assert invalid.exit_code == 1
    assert "axes.gamma" in invalid.stderr
    assert "-1.0" in invalid.stderr


def test_ctrl_c_leaves_the_job_alone(
    cli: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared_server: RunningServer
) -> None:
    job = cli("submit", write(tmp_path / "spec.json", rods(gamma=(51.0,)))).stdout.strip()

    def interrupt(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Client, "events", interrupt)
    done = cli("watch", job)
    assert done.exit_code == 130
    assert f"stickslip cancel {job}" in done.stderr
    assert "queued" in cli("jobs").stdout
    cli("cancel", job)
