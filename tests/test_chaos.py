"""Kill -9 anything in the middle of jobs of rods and start again.

Every sample is there once, and every hash is right.

    STICKSLIP_KILLS=50 pytest -m slow tests/test_chaos.py -s

prints the longest gap of chosen deaths and of random ones.

The last of the tests has two coordinators and two dispatchers on one PostgreSQL database and one
bucket.
"""

import os
import random
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from harness import PATIENCE, STICKSLIP, Service, command_line, descendants, read_arrays, wait_for
from stickslip_schemas.base import Stage, sha256
from stickslip_schemas.format.manifest import MANIFEST_NAME, SEAL_NAME, SEALED_NAMES, Manifest
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.store import DirectoryStore, Store, open_store
from stickslip_services.database.opening import connect
from stickslip_services.settings import Settings
from stickslip_sim_core import solve_rods
from stickslip_testing.invariants import violations
from stickslip_testing.samples import samples
from zarr.abc.store import Store as ZarrStore
from zarr.storage import LocalStore, ObjectStore

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chaos")]

SPEC: dict[str, Any] = yaml.safe_load(
    (Path(__file__).parents[1] / "examples" / "demo-rods.yaml").read_text()
)


@pytest.fixture
def service(tmp_path: Path) -> Any:
    running = Service(tmp_path / "data", "--slots", "2")
    running.start()
    yield running
    running.stop()


def test_a_job_survives_the_death_of_every_process(service: Service) -> None:
    job = service.submit(SPEC)

    wait_for_renders(service, job, 4)
    kill(service.child("stickslip_services.app"))
    wait_for_renders(service, job, 10)
    kill(service.child("stickslip_workers dispatch"))
    wait_for_renders(service, job, 16)
    kill(render_process(service))
    wait_for_renders(service, job, 22)
    service.kill()
    service.wait_for_end()
    service.start()
    over = service.finished(job)
    assert over["state"] == "succeeded", over["message"]

    again = service.finished(service.submit(SPEC))
    assert again["dataset"] == over["dataset"]
    version = service.get(f"/v1/datasets/{over['dataset']['dataset']}")["versions"]
    assert [item["version"] for item in version] == [1]
    builds = Builds.model_validate(service.get("/v1/workers")[0]["builds"]["rod_hang"])
    service.stop()
    service.wait_for_end()
    check_ledger(Settings(data=service.data))
    check_dataset(DirectoryStore(service.data / "store"), over["dataset"], SPEC, builds)


def renders_done(service: Service, job: str) -> int:
    counts: dict[str, int] = service.get(f"/v1/jobs/{job}")["progress"]["stages"]["render"][
        "counts"
    ]
    return counts.get("succeeded", 0)


def wait_for_renders(service: Service, job: str, count: int) -> None:
    """Wait until `count` renders are done.

    The job must not be over then, or the next kill would prove nothing.
    """

    def probe() -> int | None:
        try:
            done = renders_done(service, job)
        except (
            httpx.TransportError,
            KeyError,
        ):  # the coordinator is away, or the job is not planned yet
            return None
        return done if done >= count else None

    assert wait_for(f"{count} renders", probe, 120) < 48


def render_process(service: Service) -> int:
    """Return a process that has Blender in it and is at work."""

    def probe() -> int | None:
        assert service.process is not None
        for pid in descendants(service.process.pid):
            try:
                if "/bpy/" in Path(f"/proc/{pid}/maps").read_text():
                    return pid
            except OSError:
                continue
        return None

    return wait_for("a render process", probe, 30)


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def check_ledger(settings: Settings) -> None:
    database = connect(settings)
    with database.read() as connection:
        assert violations(connection) == []
    database.close()


def files_of(store: Store, dataset: str, version: int) -> tuple[set[str], ZarrStore]:
    """Return the paths of what a version shows, and where a Zarr reader finds it."""
    if isinstance(store, DirectoryStore):
        place = store.dataset_path(dataset, version)
        return {
            str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()
        }, LocalStore(place)
    import obstore

    bucket, _, prefix = store.place.removeprefix("s3://").partition("/")
    objects = obstore.store.S3Store(bucket, prefix=f"{prefix}/datasets/{dataset}/v{version}")
    names = {item["path"] for page in obstore.list(objects) for item in page}
    return names, ObjectStore(objects, read_only=True)


def check_dataset(
    store: Store, reference: dict[str, Any], spec: dict[str, Any], builds: Builds
) -> None:
    """Every slot holds its own sample, and every byte is what the manifest says."""
    version = reference["dataset"], reference["version"]
    text = store.read_shown(*version, MANIFEST_NAME)
    assert sha256(text) == reference["manifest"]
    manifest = Manifest.model_validate_json(text)
    assert manifest.sample_keys == tuple(
        sample.key for sample in samples(job_spec_adapter.validate_python(spec), builds)
    )
    count = len(manifest.sample_keys)
    assert len(set(manifest.sample_keys)) == count
    assert manifest.valid_count == count
    files, place = files_of(store, *version)
    assert files == {file.path for file in manifest.files} | set(SEALED_NAMES) | {SEAL_NAME}
    for file in manifest.files:
        assert sha256(store.read_shown(*version, file.path)) == file.sha256
    group = read_arrays(place)
    solution = solve_rods(group["gamma"], group["phi0"], group["phi1"])
    assert np.array_equal(group["centerline"], solution.centerline.astype(np.float32))
    pictures = {views.tobytes() for views in group["views"]}
    assert len(pictures) == count


RAY = ("raylet/raylet", "gcs/gcs_server", "ray::DashboardAgent")


def test_ray_is_replaced_at_once_when_it_dies(service: Service) -> None:
    def session() -> str | None:
        """Return the session of a dispatcher to which Ray answers: it registers before."""
        workers = service.get("/v1/workers")
        ready = [
            worker["id"]
            for worker in workers
            if worker["alive"] and worker["condition"]["state"] == "ready"
        ]
        return ready[0] if ready else None

    assert service.process is not None
    before = wait_for("a worker", session, 60)
    for part in RAY:
        kill(next(pid for pid in descendants(service.process.pid) if part in command_line(pid)))

        def replaced(old: str = before) -> str | None:
            new = session()
            return None if new == old else new

        before = wait_for(f"a worker after the death of {part}", replaced, 45)


RODS = 100
"""Samples of each of the jobs that run while processes are killed."""

LONGEST_GAP = 30.0
"""How long a job may stand still after a death [s] on a quiet machine."""

VICTIMS = {
    "coordinator": ("-m stickslip_services.app",),
    "dispatcher": ("-m stickslip_workers dispatch",),
    "ray start": ("-m stickslip_workers head",),
    "stage or render process": (
        "ray::IDLE",
        *(f"ray::{stage.value}" for stage in Stage),
    ),  # named after its task
    "raylet": ("raylet/raylet",),
    "gcs": ("gcs/gcs_server",),
    "dashboard agent": ("ray::DashboardAgent",),
    "runtime environment agent": ("ray::RuntimeEnvAgent",),
    "supervisor": (),
    "all": (),
}
"""What to kill: one of the processes with one of these in their command lines."""


def many_rods(number: int) -> dict[str, Any]:
    """Return the spec of the job of this number: no two have a sample in common."""
    axes = {
        "gamma": {"type": "linspace", "start": 100 + number, "stop": 1100 + number, "num": RODS}
    }
    return {
        "kind": "rod_hang",
        "axes": axes | {"phi0": 1.0, "phi1": 6.0},
        "views": "rod-4",
        "quality": "draft",
        "samples_per_shard": 50,
        "seed": number,
    }


class Watch:
    """Keeps one job at work and notes how long nothing is finished.

    The services take turns to be asked.
    """

    def __init__(self, *services: Service) -> None:
        self._services = services
        self._turns = 0
        self.jobs: list[str] = []
        self.done = 0
        self.since = time.monotonic()
        self.longest = 0.0

    def look(self) -> bool:
        """Submit a job where the last one is over.

        Return whether there was progress since the last look.
        """
        self._turns += 1
        service = self._services[self._turns % len(self._services)]
        try:
            if not self.jobs or service.get(f"/v1/jobs/{self.jobs[-1]}")["finished_at"] is not None:
                self.jobs.append(service.submit(many_rods(len(self.jobs))))
            text = httpx.get(f"{service.url}/metrics", timeout=30).text
        except httpx.TransportError:
            return False
        lines = [line for line in text.splitlines() if line.startswith("stickslip_tasks{")]
        done = sum(int(float(line.split()[-1])) for line in lines if 'state="succeeded"' in line)
        if done <= self.done:
            return False
        now = time.monotonic()
        self.longest = max(self.longest, now - self.since)
        self.done, self.since = done, now
        return True

    def wait_for_progress(self) -> float:
        """Return after how many seconds something was finished."""
        begin = time.monotonic()
        wait_for("progress", lambda: True if self.look() else None, 300)
        return time.monotonic() - begin


def kill_some(service: Service, victim: str) -> None:
    """Kill what a victim names; what nobody starts again by itself is started again."""
    assert service.process is not None
    if victim in ("supervisor", "all"):
        children = descendants(service.process.pid) if victim == "all" else []
        service.kill()
        for pid in children:
            try:
                kill(pid)
            except ProcessLookupError:
                continue
        service.start()
        return
    lines = {pid: command_line(pid) for pid in descendants(service.process.pid)}
    pids = [pid for pid, line in lines.items() if any(words in line for words in VICTIMS[victim])]
    if pids:
        kill(random.choice(pids))


KILLS = int(os.environ.get("STICKSLIP_KILLS", "3"))


@pytest.mark.timeout(900 + 120 * KILLS)
def test_jobs_survive_random_kills(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    count, seed = KILLS, int(os.environ.get("STICKSLIP_SEED", "0"))
    random.seed(seed)
    watch = Watch(service)
    watch.wait_for_progress()
    watch.longest = 0.0  # starting the service is no gap
    gaps: dict[str, list[float]] = {}
    worst_load = 0.0
    for number in range(count):
        deadline = time.monotonic() + random.uniform(1, 4)
        while time.monotonic() < deadline:
            watch.look()
            time.sleep(0.1)
        victim = random.choice(list(VICTIMS))
        kill_some(service, victim)
        gaps.setdefault(victim, []).append(watch.wait_for_progress())
        worst_load = max(worst_load, os.getloadavg()[0])
        with capsys.disabled():
            print(
                f"{number + 1:3} {victim:28} {gaps[victim][-1]:5.1f} s, load "
                f"{os.getloadavg()[0]:.1f}",
                flush=True,
            )
    over = [service.finished(job) for job in watch.jobs]
    assert [job["state"] for job in over] == ["succeeded"] * len(over)
    builds = Builds.model_validate(service.get("/v1/workers")[0]["builds"]["rod_hang"])
    service.stop()
    service.wait_for_end()
    check_ledger(Settings(data=service.data))
    for number, job in enumerate(over):
        check_dataset(
            DirectoryStore(service.data / "store"), job["dataset"], many_rods(number), builds
        )
    with capsys.disabled():
        print(f"{count} kills (seed {seed}): each of {len(over) * RODS} samples once")
        for victim, seconds in sorted(gaps.items()):
            print(
                f"    {victim:28} {len(seconds):3} times, {max(seconds):5.1f} s at most until "
                "something was finished"
            )
        print(
            f"    longest gap without progress {watch.longest:.1f} s, load {worst_load:.1f} at most"
        )
    assert watch.longest <= PATIENCE * LONGEST_GAP


BUCKET = "s3://lab/store"
FAULTS = {"503": 0.01, "late": 0.01, "lost answer": 0.005}
"""Shares of all requests to the bucket."""


@pytest.fixture
def nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Service, Service]]:
    """Two nodes, each a coordinator and a dispatcher, on one PostgreSQL database and one bucket
    that fails at times.
    """
    pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
    pytest.importorskip("moto", reason="moto is not installed: make setup-dev")
    pytest.importorskip("psycopg", reason="psycopg is not installed: make setup-dev")
    from stickslip_testing.postgresql import find_programs, postgresql_server
    from stickslip_testing.s3 import make_bucket, s3_proxy, variables

    programs = find_programs()
    if programs is None:
        pytest.skip("the PostgreSQL server is not installed: apt-get install postgresql")
    with postgresql_server(programs) as server, s3_proxy() as proxy:
        make_bucket(proxy, "lab")
        proxy.inject_faults(1, FAULTS)
        for name, value in (variables(proxy) | {"STICKSLIP_DATABASE": server.empty()}).items():
            monkeypatch.setenv(name, value)
        both = tuple(
            Service(tmp_path / name, "--store", BUCKET, "--name", name, "--slots", "1")
            for name in ("a", "b")
        )
        try:
            for node in both:
                node.start()
            yield both[0], both[1]
        finally:
            for node in both:
                node.stop()


@pytest.mark.timeout(1200 + 180 * KILLS)
def test_two_nodes_on_one_database_and_one_bucket_survive_random_kills(
    nodes: tuple[Service, Service], capsys: pytest.CaptureFixture[str]
) -> None:
    random.seed(int(os.environ.get("STICKSLIP_SEED", "0")))
    watch = Watch(*nodes)
    watch.wait_for_progress()
    watch.longest = 0.0
    for number in range(KILLS):
        deadline = time.monotonic() + random.uniform(1, 4)
        while time.monotonic() < deadline:
            watch.look()
            time.sleep(0.1)
        node, victim = random.choice(nodes), random.choice(list(VICTIMS))
        kill_some(node, victim)
        wait = watch.wait_for_progress()
        with capsys.disabled():
            print(
                f"{number + 1:3} {node.data.name} {victim:28} {wait:5.1f} s, load "
                f"{os.getloadavg()[0]:.1f}",
                flush=True,
            )
    over = [nodes[0].finished(job, timeout=600) for job in watch.jobs]
    assert [job["state"] for job in over] == ["succeeded"] * len(over)
    known = [
        worker["builds"] for worker in nodes[1].get("/v1/workers")
    ]  # one that has just begun has told none
    builds = Builds.model_validate(next(of for of in known if of)["rod_hang"])
    for node in nodes:
        node.stop()
        node.wait_for_end()
    settings = Settings.chosen(data=nodes[0].data, store=BUCKET)
    check_ledger(settings)

    count = collected(
        settings, "--delete"
    )  # what calls that were killed had written: another batch, another name
    assert collected(settings) == 0
    store = open_store(BUCKET)
    for number, job in enumerate(over):
        check_dataset(store, job["dataset"], many_rods(number), builds)
    with capsys.disabled():
        print(
            f"{KILLS} kills: each of {len(over) * RODS} samples once; {count} files of killed "
            "calls collected"
        )
        print(f"    longest gap without progress {watch.longest:.1f} s")


def collected(settings: Settings, *options: str) -> int:
    """Return how many files `stickslip gc` found."""
    place = ["--data", str(settings.data), "--store", settings.store_place]
    words = [str(STICKSLIP), "gc", "--older-than", "0", *place, *options]
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    count = re.match(r"(\d+) files", result.stdout)
    assert count is not None
    return int(count[1])
