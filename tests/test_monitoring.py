"""Alerts and dashboard outside of Kubernetes: they ask for metrics that exist, and fire once.

promtool and Prometheus are Debian's package `prometheus`; without them, those tests are skipped.
"""

import json
import re
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from stickslip_schemas.store import DirectoryStore, DiskUsage
from stickslip_services.access.keys import create_key
from stickslip_services.access.principals import Scope
from stickslip_services.app import make_app
from stickslip_services.local.supervisor import listen
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, rods
from stickslip_testing.servers import HttpApi, serving, wait_until
from stickslip_testing.worker import PretendWorker

ROOT = Path(__file__).parents[1]
MONITORING = ROOT / "deploy" / "monitoring"
ALERTS = MONITORING / "alerts.yaml"
RULES = yaml.safe_load(ALERTS.read_text())["groups"][0]["rules"]
_SAMPLE = re.compile(r"^((?:stickslip_\w+|up)(?:\{.*\})?) (\S+)$", re.M)


def program(name: str) -> str:
    """Return the path of a program; skip the test without it."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed: apt-get install prometheus")
    return path


def promtool(*words: str | Path, cwd: Path = MONITORING) -> str:
    """Run promtool, and return its output; fail if it finds a fault."""
    done = subprocess.run(
        [program("promtool"), *words], cwd=cwd, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_promtool_takes_the_alerts_and_the_configuration() -> None:
    assert f"{len(RULES)} rules found" in promtool("check", "rules", ALERTS.name)
    promtool("check", "config", "--syntax-only", "prometheus.yaml")


def test_each_fault_of_the_examples_fires_once() -> None:
    assert "SUCCESS" in promtool("test", "rules", "alerts.test.yaml")


def test_every_rule_says_what_to_do() -> None:
    for rule in RULES:
        assert set(rule["annotations"]) == {"summary", "action"}, rule["alert"]
        assert rule["labels"]["severity"] in ("warning", "critical")
    tested = (MONITORING / "alerts.test.yaml").read_text()
    missing = [rule["alert"] for rule in RULES if rule["alert"] not in tested]
    # Files that scrubbing has found are counted by test_damage.py.
    assert missing == ["StickslipDamagedFiles"]


# ---- The metrics of a real coordinator in trouble ------------------------------------------------

MINUTES = 200
"""Length of the recording [min]; a stuck job is reported after two hours and five minutes."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the values of all metrics, a minute each, of a coordinator with three faults.

    A worker dies with the tasks of a job on lease, so the job is stuck, and the disk fills.
    """
    clock = ManualClock()
    patch = pytest.MonkeyPatch()
    series: dict[str, list[str]] = defaultdict(list)
    app = make_app(
        Settings(
            data=tmp_path_factory.mktemp("watched"),
            durable=False,
            sweep_seconds=3600.0,
            require_keys=True,
        ),
        clock=clock,
    )
    free_bytes = [600 * 10**9]
    patch.setattr(
        DirectoryStore,
        "disk_usage",
        lambda _: DiskUsage(10**12, 10**12 - free_bytes[0], free_bytes[0]),
    )
    try:
        with serving(app) as url:
            with app.state.context.database.write() as connection:
                month = clock.now + 30 * 86_400.0
                _, key = create_key(
                    connection, "watcher", [Scope.admin], clock.now, expires_at=month
                )
            headers = {"Authorization": f"Bearer {key}"}
            wait_until(lambda: httpx.get(f"{url}/metrics", headers=headers).is_success)
            api = HttpApi(url, app.state.worker_key)
            healthy = PretendWorker(api, app.state.context.store, name="healthy").register()
            dying = PretendWorker(api, app.state.context.store, name="dying").register()
            httpx.post(f"{url}/v1/jobs", json=rods(), headers=headers).raise_for_status()
            dying.start(*dying.lease())
            for _ in range(MINUTES):
                healthy.beat()
                text = httpx.get(f"{url}/metrics", headers=headers).text
                for name, value in _SAMPLE.findall(text):
                    series[name].append(value)
                clock.advance(60.0)
                free_bytes[0] -= 3 * 10**9
    finally:
        patch.undo()
    return {name: values for name, values in series.items() if len(values) == MINUTES}


def names_and_labels(series: dict[str, list[str]]) -> dict[str, set[str]]:
    """Return the labels of each metric."""
    labels_of_metric: dict[str, set[str]] = {}
    for name in series:
        metric, _, labels = name.partition("{")
        labels_of_metric.setdefault(metric, set()).update(re.findall(r'(\w+)="', labels))
    return labels_of_metric


def test_every_rule_asks_for_metrics_and_labels_that_exist(
    recording: dict[str, list[str]],
) -> None:
    metrics = names_and_labels(recording)
    for rule in RULES:
        used = re.findall(r"(stickslip_\w+)(?:\{([^}]*)\})?", rule["expr"])
        known = {"instance", "pod", "job"}
        for name, matchers in used:
            assert name in metrics, (rule["alert"], name)
            known |= metrics[name]
            assert set(re.findall(r"(\w+)=", matchers)) <= metrics[name], rule["alert"]
        for listed in re.findall(r"without \(([^)]*)\)", rule["expr"]):
            assert set(listed.split(", ")) <= known, rule["alert"]
        for text in rule["annotations"].values():
            assert set(re.findall(r"\$labels\.(\w+)", text)) <= known, rule["alert"]


def test_a_dead_worker_a_full_disk_and_a_stuck_job_fire_once_each(
    recording: dict[str, list[str]], tmp_path: Path
) -> None:
    shutil.copy(ALERTS, tmp_path / ALERTS.name)
    inputs = [
        {
            "series": name.replace("{", '{instance="a",', 1)
            if "{" in name
            else f'{name}{{instance="a"}}',
            "values": " ".join(values),
        }
        for name, values in recording.items()
        if not name.endswith(("_bucket", "_total")) and "_seconds_" not in name
    ]
    expected = [
        {"labels": f'{{alertname="{name}"}}', "value": 1}
        for name in ("StickslipWorkerDead", "StickslipDiskFull", "StickslipJobStuck")
    ]
    firing = 'count by (alertname) (ALERTS{alertstate="firing"})'
    document = {
        "rule_files": [ALERTS.name],
        "evaluation_interval": "1m",
        "tests": [
            {
                "interval": "1m",
                "input_series": inputs,
                "promql_expr_test": [
                    {"expr": firing, "eval_time": "1m", "exp_samples": []},
                    {"expr": firing, "eval_time": f"{MINUTES - 5}m", "exp_samples": expected},
                ],
            }
        ],
    }
    (tmp_path / "test.yaml").write_text(yaml.safe_dump(document))
    promtool("test", "rules", "test.yaml", cwd=tmp_path)


def test_a_worker_that_was_stopped_is_not_dead(tmp_path: Path) -> None:
    clock = ManualClock()
    app = make_app(Settings(data=tmp_path, durable=False), clock=clock)
    with serving(app) as url:
        worker = PretendWorker(HttpApi(url, app.state.worker_key), app.state.context.store)
        worker.register()
        assert 'worker_silent_seconds{worker="pretend"} 0.0' in httpx.get(f"{url}/metrics").text
        stopped = {"state": "stopped", "slots": 0}
        headers = {"Authorization": f"Bearer {app.state.worker_key}"}
        beat = {"worker_id": worker.id, "leases": [], "condition": stopped}
        httpx.post(f"{url}/v1/worker/heartbeat", json=beat, headers=headers).raise_for_status()
        assert "worker_silent_seconds{" not in httpx.get(f"{url}/metrics").text


@pytest.mark.real
def test_prometheus_reads_the_metrics_with_a_key(tmp_path: Path) -> None:
    """Our configuration, with the paths and the port of the test, in a real Prometheus."""
    server = program("prometheus")
    app = make_app(Settings(data=tmp_path / "data", durable=False, require_keys=True))
    with listen("127.0.0.1", 0) as probe:
        port = probe.getsockname()[1]
    with serving(app) as url:
        database = app.state.context.database
        with database.write() as connection:
            _, key = create_key(connection, "prometheus", [Scope.read], database.clock())
        (tmp_path / "stickslip-key").write_text(key)
        shutil.copy(ALERTS, tmp_path / "stickslip-alerts.yaml")
        text = (MONITORING / "prometheus.yaml").read_text()
        text = text.replace("/etc/prometheus", str(tmp_path)).replace(
            "127.0.0.1:8765", url.removeprefix("http://")
        )
        (tmp_path / "prometheus.yaml").write_text(text.replace(": 30s", ": 1s"))
        command = [
            server,
            f"--config.file={tmp_path / 'prometheus.yaml'}",
            f"--storage.tsdb.path={tmp_path / 'tsdb'}",
            f"--web.listen-address=127.0.0.1:{port}",
        ]
        with (tmp_path / "log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
        try:

            def asked(path: str) -> Any:
                try:
                    answer = httpx.get(f"http://127.0.0.1:{port}/api/v1/{path}", trust_env=False)
                except httpx.TransportError:
                    return {}
                return answer.json().get("data", {}) if answer.is_success else {}

            query = "query?query=stickslip_workers{namespace=%22stickslip%22}"
            wait_until(lambda: bool(asked(query).get("result")))
            wait_until(
                lambda: (
                    [
                        rule["health"]
                        for group in asked("rules").get("groups", [])
                        for rule in group["rules"]
                    ]
                    == ["ok"] * len(RULES)
                )
            )
        finally:
            process.terminate()
            process.wait(60)


# ---- Grafana -------------------------------------------------------------------------------------


def test_grafana_finds_its_dashboard_and_its_prometheus() -> None:
    provisioning = MONITORING / "grafana" / "provisioning"
    (source,) = yaml.safe_load((provisioning / "datasources/stickslip.yaml").read_text())[
        "datasources"
    ]
    assert (source["type"], source["access"]) == ("prometheus", "proxy")
    (provider,) = yaml.safe_load((provisioning / "dashboards/stickslip.yaml").read_text())[
        "providers"
    ]
    assert provider["type"] == "file"
    guide = (ROOT / "docs" / "run-for-a-year.md").read_text()
    assert provider["options"]["path"] in guide
    dashboard = json.loads((ROOT / "deploy/helm/stickslip/files/dashboard.json").read_text())
    variables = {variable["name"]: variable for variable in dashboard["templating"]["list"]}
    assert variables["datasource"]["query"] == source["type"]
    # The dashboard is that of the Helm chart; Prometheus adds the label that Kubernetes has.
    config = yaml.safe_load((MONITORING / "prometheus.yaml").read_text())
    (target,) = config["scrape_configs"][0]["static_configs"]
    assert set(target["labels"]) == {"namespace"} <= set(variables)
    for panel in dashboard["panels"]:
        assert panel["targets"], panel["title"]
        assert all('namespace="$namespace"' in item["expr"] for item in panel["targets"])
