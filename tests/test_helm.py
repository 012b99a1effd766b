"""The Helm chart: it renders to what Kubernetes takes, refuses wrong values, and asks for metrics
that there are.

Kubernetes' own objects are checked against its schemas. Those of KubeRay, KEDA and the Prometheus
Operator are checked against `CRDS` below, the fields that the chart sets, written down from the
operators' own definitions.
"""

import io
import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_services.app import GRACE_SECONDS, make_app
from stickslip_services.app import main as coordinator
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import HttpApi, serving
from stickslip_testing.worker import PretendWorker, failure
from stickslip_workers.__main__ import main as workers
from stickslip_workers.settings import Settings as WorkerSettings

ROOT = Path(__file__).parents[1]
CHART = ROOT / "deploy" / "helm" / "stickslip"
CI = {path.stem: yaml.safe_load(path.read_text()) for path in sorted((CHART / "ci").glob("*.yaml"))}
RELEASE, NAMESPACE = "demo", "lab"
KUBERNETES = ("1.27", "1.31", "1.37")
"""Versions that the chart is checked against: the oldest and the newest that are known, and one
between.
"""

helm = pytest.importorskip("helm_python", reason="Helm is not installed: make setup-dev")


def rendered(values: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the objects that a release with these values has."""
    with helm.Chart.load(CHART) as chart:
        texts = chart.render(values, name=RELEASE, namespace=NAMESPACE)
    documents = (yaml.safe_load_all(text) for name, text in texts.items() if name.endswith(".yaml"))
    return [document for each in documents for document in each if document is not None]


def of_kind(objects: list[dict[str, Any]], kind: str) -> dict[str, dict[str, Any]]:
    """Return the objects of a kind by their component."""
    return {
        item["metadata"]["labels"]["app.kubernetes.io/component"]: item
        for item in objects
        if item["kind"] == kind
    }


def pods(objects: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the specs of all Pods, by what they are."""
    templates = {}
    for item in objects:
        if item["kind"] in ("Deployment", "Job"):
            templates[item["metadata"]["name"]] = item["spec"]["template"]["spec"]
        if item["kind"] == "RayCluster":
            for group in (item["spec"]["headGroupSpec"], *item["spec"]["workerGroupSpecs"]):
                templates[group.get("groupName", "head")] = group["template"]["spec"]
    return templates


@pytest.mark.parametrize("name", CI)
def test_helm_finds_no_fault(name: str) -> None:
    report = helm.lint(CHART, CI[name], strict=True)
    assert [message for message in report["messages"] if message["severity"] > 1] == []


_STRING, _NUMBER, _BOOLEAN = {"type": "string"}, {"type": "integer"}, {"type": "boolean"}
_STRINGS = {"type": "object", "additionalProperties": _STRING}


def _object(*required: str, **properties: Any) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_SELECTOR = _object("matchLabels", matchLabels=_STRINGS)
_GROUP = {"rayStartParams": _STRINGS, "template": _object("metadata", "spec", metadata={}, spec={})}
"""Its Pods are checked as such."""
CRDS = {
    ("ray.io/v1", "RayCluster"): _object(
        "rayVersion",
        "authOptions",
        "headGroupSpec",
        "workerGroupSpecs",
        rayVersion=_STRING,
        authOptions=_object("mode", mode={"enum": ["token"]}),
        enableInTreeAutoscaling={"const": True},
        autoscalerOptions=_object("version", version={"const": "v2"}, idleTimeoutSeconds=_NUMBER),
        headGroupSpec=_object(*_GROUP, **_GROUP),
        workerGroupSpecs=_list(
            _object(
                *_GROUP,
                "groupName",
                groupName=_STRING,
                replicas=_NUMBER,
                minReplicas=_NUMBER,
                maxReplicas=_NUMBER,
                **_GROUP,
            )
        ),
    ),
    ("keda.sh/v1alpha1", "ScaledObject"): _object(
        "scaleTargetRef",
        "triggers",
        scaleTargetRef=_object("name", name=_STRING),
        minReplicaCount=_NUMBER,
        maxReplicaCount=_NUMBER,
        cooldownPeriod=_NUMBER,
        advanced=_object(
            horizontalPodAutoscalerConfig=_object(
                behavior=_object(scaleDown=_object(stabilizationWindowSeconds=_NUMBER))
            )
        ),
        triggers=_list(
            _object("type", "metadata", type={"const": "prometheus"}, metadata=_STRINGS)
        ),
    ),
    ("monitoring.coreos.com/v1", "ServiceMonitor"): _object(
        "selector",
        "endpoints",
        selector=_SELECTOR,
        endpoints=_list(
            _object(
                port=_STRING,
                path=_STRING,
                interval=_STRING,
                authorization=_object(
                    credentials=_object("name", "key", name=_STRING, key=_STRING)
                ),
            )
        ),
    ),
}


@pytest.mark.parametrize("version", KUBERNETES)
@pytest.mark.parametrize("name", CI)
def test_kubernetes_takes_every_object(name: str, version: str) -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="make setup-dev")
    kubernetes = pytest.importorskip("kubernetes_validate", reason="make setup-dev")
    objects = rendered(CI[name])
    for item in objects:
        spec = CRDS.get((item["apiVersion"], item["kind"]))
        if spec is None:
            kubernetes.validate(item, version, strict=True)
        else:
            head = {
                "apiVersion": _STRING,
                "kind": _STRING,
                "metadata": _object("name", name=_STRING, labels=_STRINGS),
            }
            jsonschema.validate(item, _object(*head, "spec", **head, spec=spec))
    for pod in pods(objects).values():
        kubernetes.validate(
            {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "x"}, "spec": pod},
            version,
            strict=True,
        )
    names = [(item["kind"], item["metadata"]["name"]) for item in objects]
    assert len(set(names)) == len(names)


def test_strict_means_strict() -> None:
    kubernetes = pytest.importorskip("kubernetes_validate", reason="make setup-dev")
    (service,) = of_kind(rendered(CI["minimal"]), "Service").values()
    service["spec"]["portz"] = []
    with pytest.raises(kubernetes.ValidationError, match="portz"):
        kubernetes.validate(service, KUBERNETES[-1], strict=True)


def changed(values: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(json.dumps(values))
    *parents, last = path.split(".")
    place = document
    for parent in parents:
        place = place.setdefault(parent, {})
    place[last] = value
    return document


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("store", {"url": ""}),
        ("store.url", "/srv/store"),
        ("store.url", "s3://lab/a b"),
        ("replicas", 3),
        ("coordinator.replica", 2),
        ("coordinator.replicas", 0),
        ("coordinator.replicas", "2"),
        ("coordinator.image", "stickslip-coordinator"),
        ("coordinator.settings", {"STICKSLIP_LEASE_SECONDS": 30}),
        ("coordinator.settings", {"LD_PRELOAD": "/tmp/x.so"}),
        ("coordinator.resources", {"request": {"cpu": 1}}),
        ("worker.slots", 0),
        ("worker.slots", 129),
        ("worker.resources.requests", {"memory": "10 GB"}),
        ("worker.autoscaling.enabled", "yes"),
        ("worker.autoscaling.max", 3),
        ("worker.autoscaling.prometheus", "prometheus:9090"),
        ("ingress", {"enabled": True, "host": "stick.example.org"}),
        ("networkPolicy.from", [{"namespace": "monitoring"}]),
        ("networkPolicy.from", [{}]),
        ("database.secret", "My Secret"),
        ("imagePullPolicy", "Sometimes"),
    ],
)
def test_wrong_values_are_refused(path: str, value: Any) -> None:
    with pytest.raises(helm.HelmError, match="schema"):
        rendered(changed(CI["minimal"], path, value))


def test_every_value_is_in_the_schema_and_is_used() -> None:
    values, schema = (
        yaml.safe_load((CHART / "values.yaml").read_text()),
        json.loads((CHART / "values.schema.json").read_text()),
    )
    templates = "".join(path.read_text() for path in (CHART / "templates").iterdir())

    def compare(values: dict[str, Any], schema: dict[str, Any], path: str) -> None:
        assert set(values) == set(schema["properties"]), path
        assert schema["additionalProperties"] is False
        for name, value in values.items():
            assert f".{name}" in templates, f"{path}.{name}"
            if "properties" in schema["properties"][name]:
                compare(value, schema["properties"][name], f"{path}.{name}")

    compare(values, schema, "values")


@pytest.mark.parametrize("name", CI)
def test_pods_may_do_little(name: str) -> None:
    templates = pods(rendered(CI[name]))
    assert len(templates) >= 3
    for pod in templates.values():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] == 10001
        assert pod["automountServiceAccountToken"] is False
        assert (
            pod["enableServiceLinks"] is False
        )  # STICKSLIP_PORT=tcp://... would be a wrong setting
        for container in pod["containers"]:
            security = container["securityContext"]
            assert security["readOnlyRootFilesystem"] is True
            assert security["allowPrivilegeEscalation"] is False
            assert security["capabilities"] == {"drop": ["ALL"]}
            assert {"name": "tmp", "mountPath": "/tmp"} in container["volumeMounts"]
            assert {mount["name"] for mount in container["volumeMounts"]} <= {
                item["name"] for item in pod["volumes"]
            }


def test_pods_have_the_time_that_a_drain_takes() -> None:
    templates = pods(rendered(CI["minimal"])) | pods(rendered(CI["ray"]))
    drain = WorkerSettings(urls=(), store="", name="").stop_seconds
    for name in ("demo-worker", "demo-ray-dispatcher"):
        assert templates[name]["terminationGracePeriodSeconds"] >= 2 * drain
    assert templates["demo-coordinator"]["terminationGracePeriodSeconds"] >= 2 * GRACE_SECONDS


def commands(name: str) -> Iterator[tuple[str, list[str]]]:
    """Return the commands of our programs, by their module."""
    images = {"coordinator": "stickslip_services.app", "worker": "stickslip_workers"}
    for pod in pods(rendered(CI[name])).values():
        for container in pod["containers"]:
            if "command" not in container and "args" in container:
                program = next(
                    module
                    for image, module in images.items()
                    if f"stickslip-{image}" in container["image"]
                )
                yield program, container["args"]
            elif "args" in container:
                _, _, line = container["args"][0].partition("python -m ")
                program, *arguments = shlex.split(line)
                yield program, arguments


@cache
def options(program: str, *verb: str) -> set[str]:
    main = {"stickslip_services.app": coordinator, "stickslip_workers": workers}[program]
    out = io.StringIO()
    with redirect_stdout(out), suppress(SystemExit):
        main([*verb, "--help"])
    return set(re.findall(r"--[a-z][a-z-]+", out.getvalue()))


@pytest.mark.parametrize("name", CI)
def test_programs_have_the_options_that_they_are_given(name: str) -> None:
    commands_of_chart = list(commands(name))
    assert {program for program, _ in commands_of_chart} == {
        "stickslip_services.app",
        "stickslip_workers",
    }
    for program, arguments in commands_of_chart:
        verb = [word for word in arguments[:1] if not word.startswith("-")]
        option_names = {word.split("=")[0] for word in arguments if word.startswith("--")}
        assert option_names <= options(program, *verb), program


def test_ray_is_of_the_version_of_the_image() -> None:
    (cluster,) = of_kind(rendered(CI["ray"]), "RayCluster").values()
    assert (
        f"ray=={cluster['spec']['rayVersion']}"
        in (ROOT / "constraints.txt").read_text().splitlines()
    )


def test_only_who_must_reaches_the_coordinator() -> None:
    policies = of_kind(rendered(CI["full"]), "NetworkPolicy")
    (rule,) = policies["coordinator"]["spec"]["ingress"]
    release, *further = rule["from"]
    assert release["podSelector"]["matchExpressions"][0]["values"] == ["worker", "dispatcher"]
    assert further == CI["full"]["networkPolicy"]["from"]
    assert policies["worker"]["spec"]["policyTypes"] == ["Ingress"]
    assert "ingress" not in policies["worker"]["spec"]  # nobody
    ray = of_kind(rendered(CI["ray"]), "NetworkPolicy")["ray"]["spec"]
    assert ray["ingress"] == [{"from": [{"podSelector": ray["podSelector"]}]}]


def test_scaling_decides_how_many_workers_there_are() -> None:
    assert "replicas" in of_kind(rendered(CI["minimal"]), "Deployment")["worker"]["spec"]
    objects = rendered(CI["full"])
    worker = of_kind(objects, "Deployment")["worker"]
    assert "replicas" not in worker["spec"]
    (scaled,) = of_kind(objects, "ScaledObject").values()
    assert scaled["spec"]["scaleTargetRef"]["name"] == worker["metadata"]["name"]


@pytest.fixture(scope="module")
def metrics(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Return the labels of all metrics of a coordinator that has done a bit of everything."""
    app = make_app(Settings.chosen(data=tmp_path_factory.mktemp("coordinator"), durable=False))
    with serving(app) as url:
        api = HttpApi(url, app.state.worker_key)

        def judge(task: Any) -> Any:
            return failure() if task.stage == "render" else None

        worker = PretendWorker(api, app.state.context.store, judge=judge).register()
        httpx.post(f"{url}/v1/jobs", json=rods(), trust_env=False).raise_for_status()
        worker.finish(*worker.lease())
        worker.finish(*worker.lease())
        text = httpx.get(f"{url}/metrics", trust_env=False).text
    labels_of_metric: dict[str, set[str]] = {}
    for name, labels in re.findall(r"^(stickslip_\w+)(?:\{(.*)\})? ", text, re.M):
        labels_of_metric.setdefault(name, set()).update(re.findall(r'(\w+)="', labels))
    return labels_of_metric


def expressions() -> list[str]:
    dashboard = json.loads((CHART / "files" / "dashboard.json").read_text())
    texts = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    (scaled,) = of_kind(rendered(CI["full"]), "ScaledObject").values()
    return [*texts, scaled["spec"]["triggers"][0]["metadata"]["query"]]


STATES: dict[str, set[str]] = {
    "stickslip_tasks": set(TaskState),
    "stickslip_jobs": set(JobState),
    "stickslip_disk_bytes": {"free", "used"},
}


@pytest.mark.parametrize("expression", expressions())
def test_every_expression_names_metrics_and_labels_that_exist(
    expression: str, metrics: dict[str, set[str]]
) -> None:
    used = re.findall(r"(stickslip_\w+)\{([^}]*)\}", expression)
    assert len(used) == expression.count("stickslip_") > 0  # each has matchers
    known = {"namespace"}
    for name, matchers in used:
        assert name in metrics
        labels = dict(re.findall(r'(\w+)=~?"([^"]*)"', matchers))
        assert set(labels) <= metrics[name] | {"namespace"}, name
        assert set(filter(None, labels.get("state", "").split("|"))) <= {
            str(s) for s in STATES.get(name, ())
        }
        assert labels.get("outcome", "succeeded") == "succeeded"
        assert "stage" not in labels or labels["stage"] in set(Stage)
        known |= metrics[name]
    for listed in re.findall(r"by \(([^)]*)\)", expression):
        assert set(listed.split(", ")) <= known, expression


def test_the_dashboard_reaches_its_config_map() -> None:
    config = of_kind(rendered(CI["full"]), "ConfigMap")["dashboard"]
    assert json.loads(config["data"]["stickslip.json"]) == json.loads(
        (CHART / "files/dashboard.json").read_text()
    )
    places = [
        (panel["gridPos"]["x"], panel["gridPos"]["y"])
        for panel in json.loads(config["data"]["stickslip.json"])["panels"]
    ]
    assert len(set(places)) == len(places)


def test_promql_is_sound() -> None:
    parser = pytest.importorskip(
        "promql_parser", reason="promql-parser is not installed: make setup-dev"
    )
    for expression in expressions():
        parser.parse(expression.replace("$__rate_interval", "5m"))


@pytest.mark.parametrize(
    ("series", "expected"),
    [
        ({}, 0),
        (
            {
                'stickslip_jobs{state="succeeded"}': 4,
                'stickslip_tasks{stage="render",state="succeeded"}': 900,
            },
            0,
        ),
        ({'stickslip_jobs{state="queued"}': 1}, 200),
        (
            {
                'stickslip_jobs{state="paused"}': 1,
                'stickslip_tasks{stage="render",state="pending"}': 900,
            },
            0,
        ),
        (
            {
                'stickslip_jobs{state="running"}': 1,
                'stickslip_tasks{stage="render",state="pending"}': 900,
                'stickslip_tasks{stage="render",state="running"}': 8,
                'stickslip_tasks{stage="simulate",state="succeeded"}': 50,
            },
            908,
        ),
    ],
)
def test_as_many_workers_are_asked_for_as_the_queue_is_long(
    series: dict[str, int], expected: int, tmp_path: Path
) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed: apt-get install prometheus")
    both = [
        {
            "series": name.replace("{", f'{{namespace="{NAMESPACE}",pod="{pod}",'),
            "values": str(value),
        }
        for name, value in series.items()
        for pod in ("coordinator-0", "coordinator-1")  # each reports the same queue
    ]
    case = {
        "expr": expressions()[-1],
        "eval_time": "0m",
        "exp_samples": [{"labels": "{}", "value": expected}],
    }
    (tmp_path / "test.yaml").write_text(
        yaml.safe_dump({"tests": [{"input_series": both, "promql_expr_test": [case]}]})
    )
    done = subprocess.run(
        [promtool, "test", "rules", tmp_path / "test.yaml"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
