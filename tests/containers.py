"""The part of `docker compose` that a guide needs, without Docker: it runs inside a sandbox.

    python containers.py compose build | up --detach | ps | down | exec --no-TTY SERVICE WORD ...

It reads `compose.yaml` of the current directory with `.env`, and the Dockerfiles that it names.
Each container has its own network, host name, processes and mounts, with the command, environment,
user, volumes, tmpfs and health check that the files state, also without capabilities and on a
read-only root. Images are not built: programs are those of the sandbox, and two images of others
have stand-ins, PostgreSQL of this machine and moto for MinIO.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

STATE = Path("/run/containers")
"""Volumes, and a file with the pids of each container."""
NETWORK = "10.77.0"
CHECKOUT = Path(__file__).parents[1]
USER = "10001"
"""User of the images of this repository, which their Dockerfiles make."""

_POSTGRES = """set -e
bin=$(ls -d /usr/lib/postgresql/*/bin | tail -1)
data=/var/lib/postgresql/data
chown postgres $data; chmod 700 $data
as() { setpriv --reuid postgres --regid postgres --init-groups "$@"; }
echo "$POSTGRES_PASSWORD" > /tmp/password; chmod 644 /tmp/password
as $bin/initdb --encoding=UTF8 --auth=scram-sha-256 --username="$POSTGRES_USER" \\
  --pwfile=/tmp/password $data
echo 'host all all all scram-sha-256' >> $data/pg_hba.conf
as $bin/pg_ctl -D $data -o '-c listen_addresses= -k /tmp' -w start
PGPASSWORD=$POSTGRES_PASSWORD $bin/createdb -h /tmp -U "$POSTGRES_USER" "$POSTGRES_USER"
as $bin/pg_ctl -D $data -m fast -w stop
exec setpriv --reuid postgres --regid postgres --init-groups \\
  $bin/postgres -D $data -c 'listen_addresses=*' -k /tmp
"""
_MINIO = """import os, pathlib, sys, time
import boto3
from moto.server import ThreadedMotoServer
ThreadedMotoServer(ip_address="0.0.0.0", port=9000, verbose=False).start()
s3 = boto3.client(
    "s3",
    endpoint_url="http://127.0.0.1:9000",
    region_name="us-east-1",
    aws_access_key_id=os.environ["MINIO_ROOT_USER"],
    aws_secret_access_key=os.environ["MINIO_ROOT_PASSWORD"],
)
for folder in pathlib.Path(sys.argv[2]).iterdir():
    s3.create_bucket(Bucket=folder.name)
pathlib.Path("/tmp/ready").touch()
while True:
    time.sleep(60)
"""
_STAND_INS = {
    "minio": f"#!/bin/sh\nexec {sys.executable} -c '{_MINIO}' \"$@\"\n",
    "mc": "#!/bin/sh\ntest -e /tmp/ready\n",
    "pg_isready": "#!/bin/sh\nexec $(ls /usr/lib/postgresql/*/bin/pg_isready) -h 127.0.0.1 $@\n",
}

_ENTER = """set -eu
until ip link show eth0 > /dev/null 2>&1; do sleep 0.05; done
ip link set lo up
ip address add "$ADDRESS/24" dev eth0
ip link set eth0 up
hostname "$NAME"
/bin/mount -t proc proc /proc
eval "$MOUNTS"
cd /
exec $AS env -i $ENVIRONMENT "$@"
"""


@dataclass
class Image:
    """What an image states for its containers."""

    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    health: dict[str, Any] | None = None


def interpolate(value: Any, variables: dict[str, str]) -> Any:
    """Return a part of a compose file with `${NAME:-DEFAULT}` and `${NAME:?ERROR}` replaced."""
    match value:
        case dict():
            return {key: interpolate(inner, variables) for key, inner in value.items()}
        case list():
            return [interpolate(inner, variables) for inner in value]
        case str():
            return _interpolated(value, variables)
    return value


def _interpolated(text: str, variables: dict[str, str]) -> str:
    def value_of(reference: "re.Match[str]") -> str:
        name, rule, rest = reference.groups()
        value = variables.get(name, "")
        if not value and rule == ":?":
            raise SystemExit(f"{name}: {rest}")
        return value or (rest if rule == ":-" else "")

    text = text.replace("$$", "\0")
    # The innermost first: a default may have variables.
    count = 1
    while count:
        text, count = re.subn(r"\$\{(\w+)(:[-?])?([^${}]*)\}", value_of, text)
    return text.replace("\0", "$")


def image_of(service: dict[str, Any]) -> Image:
    """Return what the image of a service states; those of others have stand-ins."""
    if "build" not in service:
        is_database = service["image"].startswith("postgres:")
        return Image(["bash", "-c", _POSTGRES] if is_database else [])
    text = (Path("/opt/stickslip") / service["build"]["dockerfile"]).read_text()
    image = Image()
    last_stage = text.rpartition("\nFROM ")[2].replace("\\\n", " ")
    for line in last_stage.splitlines():
        word, _, rest = line.partition(" ")
        match word:
            case "ENV":
                for item in shlex.split(rest):
                    name, _, value = item.partition("=")
                    image.environment[name] = value.replace("$PATH", os.environ["PATH"])
            case "ENTRYPOINT":
                image.entrypoint = json.loads(rest)
            case "CMD":
                image.command = json.loads(rest)
            case "HEALTHCHECK":
                command = json.loads(rest.partition("CMD ")[2])
                image.health = {"test": ["CMD", *command], "interval": "1s", "retries": 60}
    return image


def mounts_of(service: dict[str, Any]) -> str:
    """Return the shell lines that mount what a container sees."""
    lines = []
    for volume in service.get("volumes", []):
        source, target, *options = volume.split(":")
        place = STATE / "volumes" / source
        if not place.exists():
            place.mkdir(parents=True)
            # A new volume belongs to the user of the image.
            os.chown(place, int(service.get("user", 0)), -1)
        lines.append(f"mkdir -p {target}; /bin/mount --bind {place} {target}")
        lines += [f"/bin/mount -o remount,bind,{option} {target}" for option in options]
    for item in service.get("tmpfs", ["/tmp"]):
        target, _, options = item.partition(":")
        lines.append(f"/bin/mount -t tmpfs -o {options or 'noexec'},mode=1777 tmpfs {target}")
        # The programs are those of the checkout, also where a new file system hides it.
        if CHECKOUT.is_relative_to(target):
            lines.append(f"mkdir -p {CHECKOUT}; /bin/mount --bind /opt/stickslip {CHECKOUT}")
    if "shm_size" in service:
        lines.append(
            f"/bin/mount -t tmpfs -o size={service['shm_size'].removesuffix('b')} shm /dev/shm"
        )
    # A container does not see the volumes of others.
    lines.append(f"/bin/mount -t tmpfs tmpfs {STATE}")
    if service.get("read_only"):
        lines += ["/bin/mount -o remount,bind,ro /", "/bin/mount -o remount,bind,ro /opt/stickslip"]
    return "\n".join(lines)


def privileges_of(service: dict[str, Any]) -> list[str]:
    """Return the command that gives up what a container does not have."""
    user = service.get("user")
    if user is None:
        return []
    words = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups"]
    if service.get("cap_drop") == ["ALL"]:
        words += ["--bounding-set=-all", "--inh-caps=-all"]
    if "no-new-privileges:true" in service.get("security_opt", []):
        words.append("--no-new-privs")
    return words


@dataclass
class Container:
    """A container that runs, with the process and the privileges of commands in it."""

    name: str
    service: str
    outer: int
    """Process of `unshare`."""
    environment: dict[str, str]
    privileges: list[str]

    @property
    def inner(self) -> int:
        """Its first process."""
        try:
            children = Path(f"/proc/{self.outer}/task/{self.outer}/children").read_text().split()
        except FileNotFoundError:  # the outer process has ended, too
            children = []
        if not children:
            raise SystemExit(f"{self.name} has ended:\n{self.log}")
        return int(children[0])

    @property
    def log(self) -> str:
        """The end of its output."""
        return STATE.joinpath("logs", self.name).read_text(errors="replace")[-3000:]

    def run(self, words: list[str], **options: Any) -> "subprocess.CompletedProcess[bytes]":
        """Run a command in it, as `docker exec` does."""
        enter = ["nsenter", f"--target={self.inner}", "--mount", "--net", "--uts", "--pid"]
        variables = [f"{name}={value}" for name, value in self.environment.items()]
        # Namespaces of a chroot: the root of the first process is that of the container.
        place = [f"--root=/proc/{self.inner}/root", f"--wd=/proc/{self.inner}/root"]
        command = [*enter, *place, *self.privileges, "env", "-i", *variables, *words]
        return subprocess.run(command, **options)


def start(service_name: str, service: dict[str, Any], number: int, address: str) -> Container:
    """Start a container of a service."""
    image = image_of(service)
    name = f"{service_name}-{number}"
    environment = {
        "PATH": os.environ["PATH"],
        "HOSTNAME": name,
        "HOME": "/home/stickslip" if "user" in service else "/root",
        **image.environment,
        **service.get("environment", {}),
    }
    entrypoint = service.get("entrypoint", image.entrypoint)
    # An entrypoint of the file takes the place of that of the image, and of its command.
    default = [] if "entrypoint" in service else image.command
    command = [*entrypoint, *service.get("command", default)]
    privileges = privileges_of(service)
    variables = [f"{key}={value}" for key, value in environment.items()]
    script = _ENTER.replace("$AS", shlex.join(privileges)).replace(
        "$ENVIRONMENT", shlex.join(variables)
    )
    apart = ["unshare", "--net", "--mount", "--uts", "--ipc", "--pid", "--fork", "--kill-child"]
    STATE.joinpath("logs").mkdir(parents=True, exist_ok=True)
    with STATE.joinpath("logs", name).open("wb") as log:
        process = subprocess.Popen(
            [*apart, "bash", "-c", script, name, *command],
            env={
                **os.environ,
                "ADDRESS": address,
                "NAME": name,
                "MOUNTS": mounts_of(service),
            },
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    _plug_in(process.pid, name)
    return Container(name, service_name, process.pid, environment, privileges)


def _plug_in(pid: int, name: str) -> None:
    """Give a process a cable to the bridge of all containers."""
    network = Path("/proc/self/ns/net").stat().st_ino
    while Path(f"/proc/{pid}/ns/net").stat().st_ino == network:
        time.sleep(0.01)
    cable = f"v{name}"[:15]
    peer = ["peer", "name", "eth0", "netns", str(pid)]
    subprocess.run(["ip", "link", "add", cable, "type", "veth", *peer], check=True)
    subprocess.run(["ip", "link", "set", cable, "up", "master", "br0"], check=True)


def wait_until_healthy(container: Container, health: dict[str, Any]) -> None:
    """Run a health check as often as it states, until it succeeds."""
    words = health["test"]
    assert words[0] == "CMD"
    for _ in range(int(health["retries"])):
        time.sleep(float(str(health["interval"]).removesuffix("s")))
        if container.run(words[1:], capture_output=True).returncode == 0:
            print(f"{container.name}: healthy", flush=True)
            return
    raise SystemExit(f"{container.name} is not healthy:\n{container.log}")


def up(services: dict[str, Any]) -> None:
    """Start all containers, each when those that it depends on are healthy."""
    for name, text in _STAND_INS.items():
        path = Path("/stand-ins") / name
        path.write_text(text)
        path.chmod(0o755)
    subprocess.run(["useradd", "--uid", USER, "--create-home", "stickslip"], check=False)
    subprocess.run(["ip", "link", "add", "br0", "type", "bridge"], check=True)
    subprocess.run(["ip", "address", "add", f"{NETWORK}.1/24", "dev", "br0"], check=True)
    subprocess.run(["ip", "link", "set", "br0", "up"], check=True)
    addresses = {name: f"{NETWORK}.{10 * (1 + k)}" for k, name in enumerate(services)}
    with Path("/etc/hosts").open("a") as hosts:
        hosts.writelines(f"{address} {name}\n" for name, address in addresses.items())
    containers: list[Container] = []
    for name, service in services.items():
        for other, condition in service.get("depends_on", {}).items():
            assert condition["condition"] == "service_healthy"
            health = services[other].get("healthcheck") or image_of(services[other]).health
            (container,) = (c for c in containers if c.service == other)
            assert health is not None, other
            wait_until_healthy(container, health)
        for number in range(service.get("deploy", {}).get("replicas", 1)):
            host = int(addresses[name].rpartition(".")[2]) + number
            containers.append(start(name, service, number + 1, f"{NETWORK}.{host}"))
    table = [vars(container) for container in containers]
    STATE.joinpath("containers.json").write_text(json.dumps(table))


def down(containers: list[Container], services: dict[str, Any]) -> None:
    """End the containers as Docker does: SIGTERM, and SIGKILL after the grace of each."""
    for container in reversed(containers):
        grace = float(services[container.service].get("stop_grace_period", "10s").removesuffix("s"))
        os.kill(container.inner, signal.SIGTERM)
        deadline = time.monotonic() + grace
        while Path(f"/proc/{container.outer}/task").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        ended = not _is_running(container.outer)
        print(f"{container.name}: {'ended' if ended else 'killed'}", flush=True)
        if not ended:
            os.kill(container.outer, signal.SIGKILL)


def _is_running(pid: int) -> bool:
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return text.rpartition(")")[2].split()[0] != "Z"


def main() -> int:
    """Do what a command of `docker compose` asks for."""
    _, compose, verb, *words = sys.argv
    assert compose == "compose", compose
    lines = [line.partition("=") for line in Path(".env").read_text().splitlines()]
    variables = {**{name: value for name, _, value in lines}, **os.environ}
    document = interpolate(yaml.safe_load(Path("compose.yaml").read_text()), variables)
    services = document["services"]
    table = STATE / "containers.json"
    containers = []
    if table.exists():
        containers = [Container(**entry) for entry in json.loads(table.read_text())]
    match verb:
        case "build":
            print("images are not built here")
        case "up":
            assert words == ["--detach"], words
            up(services)
        case "ps":
            for container in containers:
                print(container.name, "running" if _is_running(container.outer) else "ended")
        case "exec":
            option, service, *command = words
            assert option == "--no-TTY", words
            chosen = next(c for c in containers if c.service == service)
            return chosen.run(command).returncode
        case "down":
            down(containers, services)
        case _:
            raise SystemExit(f"{verb} has no stand-in")
    return 0


if __name__ == "__main__":
    sys.exit(main())
