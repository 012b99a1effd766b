"""Build both images without a registry and without Docker, and make a dataset with what is in them.

    STICKSLIP_BUILD_OPTIONS="--volume=/etc/pip.conf:/etc/pip.conf:ro" pytest -m slow
    tests/test_images.py -s

It needs root, buildah and debootstrap. The base image, which is Docker Hub's
python:3.11-slim-bookworm elsewhere, is made by debootstrap from the first mirror of Debian that apt
knows. Options of `buildah build` may follow in the variable, such as the places of a mirror of
PyPI; nothing of them stays in an image. Programs run as the images' user on a root file system that
is read-only, as deploy/ runs them. It takes a quarter of an hour, and 12 GB in
STICKSLIP_BUILD_PLACE (/var/tmp).
"""

import json
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from harness import wait_for
from stickslip_schemas.kinds import KINDS

ROOT = Path(__file__).parents[1]
PLACE = Path(os.environ.get("STICKSLIP_BUILD_PLACE", "/var/tmp"))
OPTIONS = shlex.split(os.environ.get("STICKSLIP_BUILD_OPTIONS", ""))
BASE = "python:3.11-slim-bookworm"
LIMITS = {"coordinator": 400e6, "worker": 3e9}
"""The most that an image may take, its base included [bytes]."""
USER = 10001
PORT = 8799

# What Docker Hub's image has that Debian's packages give, too; headers of Python are for the
# worker's build.
PACKAGES = {
    "coordinator": "python3-venv python-is-python3",
    "worker": "python3-venv python-is-python3 python3-dev",
}
BASE_FILE = """
FROM scratch
COPY . /
RUN apt-get update \\
 && apt-get install --yes --no-install-recommends {packages} \\
 && rm -rf /var/lib/apt/lists/* /var/cache/apt/* \\
 && rm -rf /usr/share/doc/* /usr/share/locale/* /usr/share/man/*
"""

# Arguments: the root, the data directory, and the command. Ray needs shared memory and pseudo
# terminals of /dev.
SANDBOX = """
set -eu
root=$1 data=$2 && shift 2
mount --bind "$root" "$root"
mount --options remount,bind,ro "$root"
mount --types proc proc "$root/proc"
mount --rbind /dev "$root/dev"
for place in tmp home/stickslip; do
  mount --types tmpfs --options mode=1777 tmpfs "$root/$place"
done
mount --bind "$data" "$root/data"
cd "$root"
exec chroot --userspec=10001:10001 "$root" "$@"
"""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def run(*command: str | Path) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, (command, done.stdout[-3000:], done.stderr[-3000:])
    return done.stdout.strip()


class Images:
    """Images in a storage of their own."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._trees: dict[str, Path] = {}

    def buildah(self, command: str, *words: str | Path) -> str:
        storage = ["--root", str(self._place / "storage"), "--runroot", str(self._place / "run")]
        return run("nice", "buildah", *storage, command, *words)

    def tree(self, name: str) -> Path:
        """Return where the files of an image are; build it when it is asked for first."""
        if name not in self._trees:
            self._make(name)
            self._trees[name] = Path(
                self.buildah("mount", self.buildah("from", "--pull-never", name))
            )
        return self._trees[name]

    def _make(self, name: str) -> None:
        """Build an image of deploy/images, on a base that has nothing of this machine."""
        tree = self._place / "debian"
        if not tree.exists():
            mirror = run("apt-get", "indextargets", "--format", "$(REPO_URI)").split()[0]
            run(
                "nice",
                "debootstrap",
                "--variant=minbase",
                "--include=ca-certificates",
                "bookworm",
                tree,
                mirror,
            )
            (tree / "etc/apt/sources.list").unlink()
            for rest in ("var/cache/apt/archives", "var/lib/apt/lists"):
                shutil.rmtree(tree / rest)
        file = self._place / "Dockerfile"
        file.write_text(BASE_FILE.format(packages=PACKAGES[name]))
        self._build(file, tree, BASE, "--squash")
        self._build(ROOT / "deploy" / "images" / f"{name}.Dockerfile", ROOT, name)

    def _build(self, file: Path, context: Path, tag: str, *options: str) -> None:
        mounted = ("/etc/apt/sources.list.d", "/etc/apt/apt.conf.d", "/etc/ssl/certs")
        volumes = [f"--volume={path}:{path}:ro" for path in mounted if Path(path).exists()]
        options = ("--isolation=chroot", "--pull-never", *options, *volumes, *OPTIONS)
        self.buildah("build", *options, "--file", file, "--tag", tag, context)

    def size(self, name: str) -> int:
        """Return how large the files of an image are, as `docker images` counts [bytes]."""
        result = run(
            "du",
            "--summarize",
            "--apparent-size",
            "--block-size=1",
            "--one-file-system",
            self.tree(name),
        )
        return int(result.split()[0])

    def config(self, name: str) -> dict[str, Any]:
        """Return what is set for containers of an image."""
        self.tree(name)
        document: dict[str, Any] = json.loads(self.buildah("inspect", "--type=image", name))[
            "OCIv1"
        ]["config"]
        return document

    def command(self, name: str, data: Path, words: list[str]) -> list[str]:
        """Return the command that runs `words` in an image; without any, its entry point."""
        isolated = [
            "unshare",
            "--mount",
            "--pid",
            "--ipc",
            "--fork",
            "--kill-child",
            "sh",
            "-c",
            SANDBOX,
            "sandbox",
        ]
        environment = [*self.config(name)["Env"], "HOME=/home/stickslip"]
        return [
            *isolated,
            str(self.tree(name)),
            str(data),
            "env",
            "--ignore-environment",
            *environment,
            *words,
        ]

    def entry(self, name: str, *words: str) -> list[str]:
        """Return the entry point of an image, with arguments."""
        return [*self.config(name)["Entrypoint"], *words]

    def tidy(self) -> None:
        subprocess.run(
            [
                "buildah",
                "--root",
                self._place / "storage",
                "--runroot",
                self._place / "run",
                "rm",
                "--all",
            ]
        )
        subprocess.run(["umount", "--quiet", self._place / "storage" / "overlay"])
        shutil.rmtree(self._place)


@pytest.fixture(scope="module")
def images() -> Iterator[Images]:
    if os.geteuid() != 0:
        pytest.skip("images are built in a chroot, which needs root")
    for program in ("buildah", "debootstrap", "apt-get"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed: apt-get install buildah debootstrap")
    place = PLACE / f"stickslip-images-{os.getpid()}"
    place.mkdir()
    built = Images(place)
    try:
        yield built
    finally:
        built.tidy()


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A volume that both images may write to."""
    for path in (tmp_path, *list(tmp_path.parents)[:2]):
        path.chmod(0o755)  # pytest keeps others out
    volume = tmp_path / "data"
    volume.mkdir()
    os.chown(volume, USER, USER)
    return volume


@pytest.mark.parametrize("name", LIMITS)
def test_images_are_small(images: Images, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    size = images.size(name)
    with capsys.disabled():
        print(f"\n    {name}: {size / 1e6:.0f} MB")
    assert size <= LIMITS[name]


@pytest.mark.parametrize("name", LIMITS)
def test_nobody_is_root_and_nothing_can_be_changed(images: Images, name: str, data: Path) -> None:
    assert images.config(name)["User"] == str(USER)
    script = (
        "id -u; for place in / /opt/stickslip /etc; do touch $place/x 2>&1 || true; done; "
        "touch /tmp/x /data/x"
    )
    result = run(*images.command(name, data, ["sh", "-c", script])).splitlines()
    assert result[0] == str(USER)
    assert [line.rpartition(": ")[2] for line in result[1:]] == ["Read-only file system"] * 3
    assert (data / "x").stat().st_uid == USER


def test_the_worker_says_what_it_is(images: Images, data: Path) -> None:
    document = json.loads(run(*images.command("worker", data, images.entry("worker", "describe"))))
    assert set(document["builds"]) == set(KINDS)
    written = run(*images.command("worker", data, ["cat", "/usr/share/doc/stickslip/builds.json"]))
    assert json.loads(written) == document
    blender = [
        "/opt/stickslip/.venv-blender/bin/python",
        "-c",
        "import bpy; print(bpy.app.version_string)",
    ]
    assert run(*images.command("worker", data, blender)).splitlines()[-1].startswith("5.0")


def test_the_coordinator_has_only_what_it_needs(images: Images, data: Path) -> None:
    result = run(*images.command("coordinator", data, images.entry("coordinator", "--openapi")))
    assert json.loads(result) == json.loads((ROOT / "docs" / "openapi.json").read_text())
    names = "ray", "torch", "bpy", "pip", "stickslip_workers", "stickslip_sim_core"
    asked = (
        f"from importlib.util import find_spec; print([name for name in {names} if "
        "find_spec(name)])"
    )
    assert (
        run(*images.command("coordinator", data, ["/opt/stickslip/.venv/bin/python", "-c", asked]))
        == "[]"
    )


@contextmanager
def started(
    images: Images, name: str, data: Path, *words: str
) -> Iterator["subprocess.Popen[bytes]"]:
    with (data.parent / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            images.command(name, data, images.entry(name, *words)),
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
        os.kill(int(children), signal.SIGTERM)  # the first process of its pid namespace
        process.wait(60)


def test_both_make_a_dataset(images: Images, data: Path) -> None:
    url = f"http://127.0.0.1:{PORT}"

    def job_when(path: str) -> Any:
        try:
            answer = httpx.get(url + path, trust_env=False)
        except httpx.TransportError:
            return None
        return answer.json() if answer.is_success else None

    spec = {
        "kind": "rod_hang",
        "axes": {"gamma": [300, 900], "phi0": 0.2, "phi1": [6, 12]},
        "quality": "draft",
    }
    words = [
        "dispatch",
        f"--url={url}",
        "--store=/data/store",
        "--name=image",
        "--key-file=/data/worker-key",
    ]
    with started(images, "coordinator", data, f"--port={PORT}") as coordinator:
        wait_for("the coordinator", lambda: job_when("/readyz"), 60)
        assert coordinator.poll() is None
        with started(images, "worker", data, *words, "--max-cpus=1"):
            job = httpx.post(f"{url}/v1/jobs", json=spec, trust_env=False).json()["id"]

            def over() -> Any:
                job_document = job_when(f"/v1/jobs/{job}")
                return (
                    job_document
                    if job_document is not None and job_document["finished_at"] is not None
                    else None
                )

            assert wait_for("the job", over, 300)["state"] == "succeeded"
