"""Coordinators and two workers: kill -9 any of them, again and again.

One coordinator on SQLite and a directory, then two on one PostgreSQL database and one bucket that
fails at times.

The workers only pretend to simulate and to render, but lease, publish and report as dispatchers do.
tests/test_chaos.py does the same with real ones, and takes hours where this takes minutes.

STICKSLIP_KILLS=100 pytest -m slow services/tests/test_nodes.py -s
"""

import os
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner
from sqlalchemy import select
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.store import open_store
from stickslip_services.catalog.versions import damaged_files
from stickslip_services.cli import app
from stickslip_services.database.opening import connect
from stickslip_services.database.tables import dataset_versions
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import rods
from stickslip_testing.nodes import COORDINATOR, WORKER, Node, free_port, is_ready
from stickslip_testing.servers import wait_until

KILLS = int(os.environ.get("STICKSLIP_KILLS", "12"))
PATIENCE = 300.0
"""How long an answer or progress may take [s]: both coordinators may be starting, on a busy
machine.
"""
SAMPLES = 60
"""Samples of each of the jobs that run while processes are killed."""
FAULTS = {"503": 0.02, "late": 0.01, "lost answer": 0.01}
"""Shares of all requests to the bucket."""


@pytest.fixture(params=["sqlite", "postgresql"])
def settings(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Settings:
    if request.param == "sqlite":
        return Settings.chosen(data=tmp_path / "a", durable=False)
    bucket = request.getfixturevalue("bucket")
    request.getfixturevalue("s3").inject_faults(1, FAULTS)
    monkeypatch.setenv("STICKSLIP_DATABASE", request.getfixturevalue("postgresql").clean())
    return Settings.chosen(data=tmp_path / "a", store=bucket, durable=False)


@pytest.fixture
def urls(settings: Settings) -> list[str]:
    return [f"http://127.0.0.1:{free_port()}" for _ in range(1 if settings.database is None else 2)]


@pytest.fixture
def nodes(settings: Settings, urls: list[str]) -> Iterator[list[Node]]:
    place = settings.data.parent
    started = []
    for name, url in zip("ab", urls, strict=False):
        words = [
            "--data",
            str(place / name),
            "--port",
            url.rsplit(":", 1)[1],
            "--store",
            settings.store_place,
        ]
        started.append(Node(f"coordinator {name}", COORDINATOR, words, place / f"{name}.log"))
    try:
        for name, url in zip("ab", urls * 2, strict=False):
            wait_until(lambda url=url: is_ready(url), seconds=PATIENCE)  # type: ignore[misc]
            of = name if len(urls) == 2 else "a"
            words = [
                f"worker-{name}",
                (place / of / "worker-key").read_text().strip(),
                settings.store_place,
                url,
            ]
            started.append(Node(f"worker {name}", WORKER, words, place / f"worker-{name}.log"))
        yield started
    finally:
        for node in started:
            node.kill()


def asked(urls: list[str], ask: Callable[[str], httpx.Response]) -> httpx.Response:
    """Return the answer of the first coordinator that is there."""
    end, last = time.monotonic() + PATIENCE, "nothing"
    while time.monotonic() < end:
        for url in random.sample(urls, len(urls)):
            try:
                answer = ask(url)
            except httpx.TransportError as error:
                last = repr(error)
                continue
            if answer.status_code < 500:
                answer.raise_for_status()
                return answer
            last = answer.text
        time.sleep(0.05)
    raise AssertionError(f"no coordinator answers; the last one said {last}")


@pytest.mark.slow
@pytest.mark.timeout(900 + 120 * KILLS)
def test_every_sample_once_whoever_is_killed(
    settings: Settings, urls: list[str], nodes: list[Node], capsys: pytest.CaptureFixture[str]
) -> None:
    random.seed(int(os.environ.get("STICKSLIP_SEED", "0")))
    began = time.monotonic()
    jobs: list[str] = []
    kills: Counter[str] = Counter()

    def job(name: str) -> dict[str, object]:
        return dict(
            asked(
                urls, lambda url: httpx.get(f"{url}/v1/jobs/{name}", trust_env=False, timeout=60)
            ).json()
        )

    def done() -> int:
        """Return how many tasks there are results of; keep a job at work."""
        if not jobs or job(jobs[-1])["finished_at"] is not None:
            spec = rods(
                gamma=tuple(float(number) for number in range(1, SAMPLES + 1)),
                phi1=(1.0 + len(jobs),),
            )
            spec["samples_per_shard"] = 10
            headers = {"Idempotency-Key": f"job {len(jobs)}"}  # it may be killed before it answers
            answer = asked(
                urls,
                lambda url: httpx.post(
                    f"{url}/v1/jobs", json=spec, headers=headers, trust_env=False, timeout=60
                ),
            )
            jobs.append(answer.json()["id"])
        text = asked(
            urls, lambda url: httpx.get(f"{url}/metrics", trust_env=False, timeout=60)
        ).text
        lines = [line for line in text.splitlines() if line.startswith("stickslip_tasks{")]
        return sum(int(float(line.split()[-1])) for line in lines if 'state="succeeded"' in line)

    longest = 0.0
    before = done()
    wait_until(lambda: done() > before, seconds=PATIENCE)
    for _ in range(KILLS):
        time.sleep(random.uniform(0.0, 1.0))
        victim = random.choice(nodes)
        victim.kill()
        kills[victim.name] += 1
        time.sleep(random.choice([0.0, 0.5]))
        victim.start()
        before, begin = done(), time.monotonic()
        wait_until(lambda before=before: done() > before, seconds=PATIENCE)  # type: ignore[misc]
        longest = max(longest, time.monotonic() - begin)
    wait_until(lambda: all(job(name)["finished_at"] is not None for name in jobs), seconds=PATIENCE)
    assert [job(name)["state"] for name in jobs] == ["succeeded"] * len(jobs)
    for node in nodes:
        node.kill()

    database, store = connect(settings), open_store(settings.store_place)
    words = [
        "gc",
        "--older-than",
        "0",
        "--data",
        str(settings.data),
        "--store",
        settings.store_place,
    ]
    assert (
        CliRunner().invoke(app, [*words, "--delete"]).exit_code == 0
    )  # what calls that were killed had written
    assert CliRunner().invoke(app, words).output.startswith("0 files")
    with database.read() as connection:
        assert violations(connection) == []
        versions = connection.execute(select(dataset_versions)).all()
    database.close()
    assert len(versions) == len(jobs)
    for version in versions:
        manifest = Manifest.model_validate_json(store.read(version.manifest))
        assert len(set(manifest.sample_keys)) == manifest.valid_count == SAMPLES
        assert damaged_files(store, version.manifest, version.group_digest) == {}
    with capsys.disabled():
        print(f"\n{KILLS} kills ({dict(kills)}) in {(time.monotonic() - began) / 60:.1f} min")
        print(
            f"{len(jobs)} jobs, each of {len(jobs) * SAMPLES} samples once; "
            f"longest wait {longest:.1f} s"
        )
