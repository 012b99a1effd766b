"""A day in the life, in minutes: everything at once, and kills all the time.

Then an audit of the books.

    python benchmarks/soak.py [--minutes 30] [--every 20] [--seed 0] [--postgresql]

Users submit, cancel, pause, resume, pull and scrub; bits flip in the store; disks are full; every
`--every` seconds something is killed, frozen, or started with a clock that is up to an hour off.
With `--postgresql` there are two coordinators on a PostgreSQL database and a bucket that fails at
times, where no bits flip and no disk is full. Workers pretend (`stickslip_testing.worker`);
tests/test_chaos.py kills real ones. Coordinators live on in the last two fifths, so that their
memory and file handles can be compared.
"""

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

from stickslip_schemas.format.manifest import Contents, Manifest
from stickslip_schemas.store import open_store
from stickslip_services.catalog.versions import damaged_files
from stickslip_services.client import Client, ClientError, ProblemError, pull, verify
from stickslip_services.client.errors import DamagedError
from stickslip_services.database.opening import connect
from stickslip_services.database.tables import dataset_versions
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.nodes import WORKER, Node, free_port, is_ready
from stickslip_testing.samples import samples
from stickslip_testing.servers import wait_until
from stickslip_testing.worker import BUILDS

COORDINATOR = """
import random, sys, time
now, step = time.time, random.uniform(-3600, 3600)
time.time = lambda: now() + step
from stickslip_services.app import main
sys.exit(main())
"""
OPEN_JOBS = 6
FAULTS = {"503": 0.02, "late": 0.01, "lost answer": 0.01}
PATIENCE = 300.0


WARM_UP = 60.0
"""Until caches, threads and connections are as many as they become [s]."""
MOST_GROWTH = 1.05
MORE_HANDLES = 8
"""Requests of this script and of workers that are open by chance when it looks."""


class Use(NamedTuple):
    """What a process uses at a time [s]: memory [MiB] and file handles."""

    at: float
    memory: float
    handles: int


class Soak:
    """The service, its users, and what happened."""

    def __init__(self, place: Path, settings: Settings, coordinators: int, every: float) -> None:
        self.place, self.settings, self.every = place, settings, every
        self.counts: Counter[str] = Counter()
        self.specs: dict[str, dict[str, Any]] = {}
        self.open: set[str] = set()
        self.cancelled: set[str] = set()
        self.is_rotten = False
        self.use: dict[int, list[Use]] = {}
        """What coordinators use, by process."""
        self.urls = [f"http://127.0.0.1:{free_port()}" for _ in range(coordinators)]
        self.coordinators, self.workers = [], []
        self.clients = [Client(url, patience=PATIENCE) for url in self.urls]
        for number, url in enumerate(self.urls):
            data = settings.data if number == 0 else place / f"data-{number}"
            words = [
                "--data",
                str(data),
                "--port",
                url.rpartition(":")[2],
                "--store",
                settings.store_place,
            ]
            log = place / f"coordinator-{number}.log"
            self.coordinators.append(Node(f"coordinator {number}", COORDINATOR, words, log))
        for number, url in enumerate(self.urls * (3 - coordinators)):
            wait_until(lambda url=url: is_ready(url), seconds=PATIENCE)  # type: ignore[misc]
            data = settings.data if number == 0 or coordinators == 1 else place / f"data-{number}"
            key = (data / "worker-key").read_text().strip()
            words = [f"worker-{number}", key, settings.store_place, url]
            self.workers.append(
                Node(f"worker {number}", WORKER, words, place / f"worker-{number}.log")
            )

    @property
    def client(self) -> Client:
        return random.choice(self.clients)

    def submit(self) -> None:
        if len(self.open) >= OPEN_JOBS:
            return
        first = random.randrange(1, 200)  # jobs share simulations, renders, and sometimes all
        gamma = tuple(float(number) for number in range(first, first + random.choice((3, 20, 60))))
        spec = rods(gamma=gamma, phi1=(float(random.randrange(1, 4)),), samples_per_shard=10)
        job = self.client.submit(spec, priority=random.randrange(3)).id
        self.specs[job] = spec
        self.open.add(job)

    def change(self, verb: Callable[[Client, str], object]) -> None:
        for job in random.sample(sorted(self.open), min(1, len(self.open))):
            try:
                verb(self.client, job)
            except ProblemError as error:
                if error.problem.status != 409:  # it has ended meanwhile
                    raise
            else:
                self.cancelled |= {job} if verb is Client.cancel else set()

    def look(self) -> None:
        for job in sorted(self.open):
            shown = self.client.job(job)
            if not shown.state.is_open:
                self.open.discard(job)
                self.counts[f"job {shown.state}"] += 1
                expected = {"succeeded", "cancelled"} if job in self.cancelled else {"succeeded"}
                assert shown.state in expected, (job, shown.state, shown.message)

    def pull(self) -> None:
        found = [dataset for dataset in self.client.datasets() if dataset.versions]
        if not found:
            return
        dataset = random.choice(found)
        with tempfile.TemporaryDirectory(dir=self.place) as target:
            try:
                pull(self.client, dataset.id, dataset.versions[-1].version, Path(target) / "d")
                faults = verify(Path(target) / "d")
                assert faults == [] or self.is_rotten, faults
            except (DamagedError, ProblemError):
                if not self.is_rotten:
                    raise
                self.counts["pull refused, for rot"] += 1

    def scrub(self) -> bool:
        place = ["--data", str(self.settings.data), "--store", self.settings.store_place]
        words = [sys.executable, "-m", "stickslip_services.cli", "scrub", *place, "--rate", "1000"]
        ended = subprocess.run(words, capture_output=True, text=True, check=False)
        assert ended.returncode in (0, 1), ended.stderr
        self.counts["damaged files found"] += len(ended.stdout.splitlines())
        return ended.returncode == 0

    def rot(self) -> None:
        where = random.choice(("artifacts/*/*", "datasets/*/*/**/*"))
        files = [
            path
            for path in Path(self.settings.store_place).glob(where)
            if path.is_file() and path.stat().st_size
        ]
        if files:
            path = random.choice(files)
            data = bytearray(path.read_bytes())
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
            path.write_bytes(data)  # in place: hard links see it
            self.is_rotten = True

    def strike(self, *, spares_coordinators: bool) -> None:
        victim = random.choice(
            self.workers if spares_coordinators else [*self.coordinators, *self.workers]
        )
        how = random.choice(["kill", "kill", "freeze", "full disk"])
        if how == "full disk" and (victim in self.workers or len(self.coordinators) > 1):
            how = "kill"
        self.counts[f"{how} of a {victim.name.split()[0]}"] += 1
        if how == "freeze":
            os.kill(victim.pid, signal.SIGSTOP)
            time.sleep(random.uniform(1, 5))
            os.kill(victim.pid, signal.SIGCONT)
            return
        victim.kill()
        time.sleep(random.choice([0.0, 1.0]))
        if how == "full disk":
            victim.start(STICKSLIP_MIN_FREE_BYTES=str(2**60))
            time.sleep(8)
            victim.kill()
        victim.start()

    def measure(self) -> None:
        for pid in (node.pid for node in self.coordinators):
            with suppress(OSError):
                pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
                handles = len(list(Path(f"/proc/{pid}/fd").iterdir()))
                used = Use(time.monotonic(), pages * os.sysconf("SC_PAGE_SIZE") / 2**20, handles)
                self.use.setdefault(pid, []).append(used)

    def run(self, minutes: float) -> None:
        begin = time.monotonic()
        strike_at = begin + self.every
        acts: dict[str, tuple[float, Callable[[], object]]] = {
            "submit": (4, self.submit),
            "cancel": (0.5, lambda: self.change(Client.cancel)),
            "pause": (0.5, lambda: self.change(Client.pause)),
            "resume": (2, lambda: self.change(Client.resume)),
            "pull": (1, self.pull),
            "look": (2, self.look),
            "scrub": (0.1, self.scrub),
            "bit flipped": (0.2 if len(self.coordinators) == 1 else 0, self.rot),
        }
        names, weights = list(acts), [weight for weight, _ in acts.values()]
        while (now := time.monotonic()) < begin + 60 * minutes:
            if now >= strike_at:
                self.strike(spares_coordinators=now - begin > 0.6 * 60 * minutes)
                strike_at = time.monotonic() + self.every
            name = random.choices(names, weights)[0]
            self.counts[name] += 1
            acts[name][1]()
            self.measure()
            time.sleep(random.uniform(0.0, 0.4))

    def settle(self) -> None:
        """Let all jobs end, and all rot be found and mended."""
        end = time.monotonic() + PATIENCE
        while self.open:
            assert time.monotonic() < end, (
                f"jobs do not end: {[self.client.job(job) for job in self.open]}"
            )
            for job in self.open:
                with suppress(ProblemError):
                    self.client.resume(job)
            self.look()
            time.sleep(0.5)
        while not self.scrub():
            assert time.monotonic() < end, "rot is not mended"
            wait_until(
                lambda: not any(job.state.is_open for job in self.client.jobs()), seconds=PATIENCE
            )

    def audit(self) -> Iterator[str]:
        """Yield what is wrong; call it when all processes have been killed."""
        place = [
            "--data",
            str(self.settings.data),
            "--store",
            self.settings.store_place,
            "--older-than",
            "0",
        ]
        gc = [sys.executable, "-m", "stickslip_services.cli", "gc", *place]
        collected = subprocess.run([*gc, "--delete"], capture_output=True, text=True, check=False)
        if collected.returncode != 0:
            yield f"gc: {collected.stderr}"
            return
        self.counts["orphans of killed calls"] = int(collected.stdout.split()[0])
        left = subprocess.run(gc, capture_output=True, text=True, check=True).stdout
        if not left.startswith("0 files"):
            yield f"orphans after gc: {left}"
        database, store = connect(self.settings), open_store(self.settings.store_place)
        with database.read() as connection:
            yield from violations(connection)
            versions = connection.execute(
                dataset_versions.select().where(dataset_versions.c.manifest.is_not(None))
            )
            rows = versions.all()
        database.close()
        expected = {
            tuple(sample.key for sample in samples(parsed(spec), BUILDS))
            for spec in self.specs.values()
        }
        for row in rows:
            manifest = Manifest.model_validate_json(store.read(row.manifest))
            contents = Contents(manifest, lambda file: store.read(file.sha256))
            keys = tuple(contents.sample_keys())
            self.counts["samples in datasets"] += len(keys)
            if (
                keys not in expected
                or len(set(keys)) != len(keys)
                or manifest.valid_count != len(keys)
            ):
                yield f"{row.dataset} has other samples than were ordered"
            if damaged := damaged_files(store, row.manifest, row.group_digest):
                yield f"{row.dataset}:v{row.version} is damaged: {damaged}"

    def growth(self) -> Iterator[str]:
        """Compare each coordinator's last life after its warm-up with its end; yield what grows."""
        for node in self.coordinators:
            life = self.use.get(node.pid, [])
            warm = [use for use in life if use.at - life[0].at >= WARM_UP]
            early = [use for use in warm if use.at < warm[0].at + 30]
            late = [use for use in life if use.at > life[-1].at - 30]
            if not early or early[-1].at > late[0].at:
                yield f"{node.name}: its last life is too short to tell whether its memory grows; run for longer"
                continue
            before, after = (
                statistics.median(use.memory for use in some) for some in (early, late)
            )
            handles = [statistics.median(use.handles for use in some) for some in (early, late)]
            print(
                f"{node.name}: memory {before:.1f} MiB, and {after:.1f} ({after / before - 1:+.1%}) "
                f"{(life[-1].at - early[0].at) / 60:.1f} min later; file handles {handles[0]:.0f} and {handles[1]:.0f}"
            )
            if after > MOST_GROWTH * before:
                yield f"{node.name}: its memory grows"
            if handles[1] > handles[0] + MORE_HANDLES:
                yield f"{node.name}: its file handles grow"


@contextmanager
def database_and_bucket() -> Iterator[str]:
    """Run a PostgreSQL server and a bucket, which processes find by their environment; yield the
    store.
    """
    from stickslip_testing.postgresql import find_programs, postgresql_server
    from stickslip_testing.s3 import make_bucket, s3_proxy, variables

    programs = find_programs()
    assert programs is not None, (
        "the PostgreSQL server is not installed: apt-get install postgresql"
    )
    with postgresql_server(programs) as server, s3_proxy() as proxy:
        os.environ |= variables(proxy) | {"STICKSLIP_DATABASE": server.empty()}
        make_bucket(proxy, "soak")
        proxy.some(1, FAULTS)
        yield "s3://soak/lab"


def main() -> int:
    """Run; return 1 where the books are not right, or memory or file handles grow."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=20.0, help="seconds between kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--postgresql", action="store_true")
    options = parser.parse_args()
    random.seed(options.seed)
    os.environ["STICKSLIP_LEASE_SECONDS"] = "10"
    with (
        tempfile.TemporaryDirectory() as folder,
        database_and_bucket() if options.postgresql else nullcontext() as store,
    ):
        place = Path(folder)
        settings = Settings.chosen(data=place / "data", store=store)
        soak = Soak(place, settings, 2 if options.postgresql else 1, options.every)
        try:
            soak.run(options.minutes)
            soak.settle()
        except (AssertionError, ClientError):
            print({path.name: path.read_text()[-3000:] for path in place.glob("*.log")})
            raise
        finally:
            for node in [*soak.workers, *soak.coordinators]:
                node.kill()
        faults = [*soak.audit(), *soak.growth()]
    for what, count in sorted(soak.counts.items()):
        print(f"{count:6} {what}")
    print(f"load {os.getloadavg()[0]:.1f}")
    print("\n".join(faults) or "the books are right, and nothing grows")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
