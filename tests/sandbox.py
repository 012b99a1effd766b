"""A machine to run guides on, without containers: as root sees this one, of which nothing changes.

Its root is an overlay in memory, with a network, a host name and pids of its own. What a sandbox
cannot have is replaced by a stand-in of the same name: `sudo` changes the user, `systemctl` starts
units (units.py), NFS is a bind mount, `scp` copies on this machine, `exportfs` does nothing, and
`docker` runs the containers of a compose file (containers.py).
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

_STAND_INS = {
    "sudo": """if [ "$1" = -u ]; then
  user=$2; shift 2
  exec setpriv --reuid "$user" --regid "$user" --init-groups env HOME=/var/lib/stickslip "$@"
fi
exec "$@\"""",
    "systemctl": f'exec {sys.executable} {ROOT / "tests" / "units.py"} "$@"',
    # As `mount DIRECTORY`: the source stands in /etc/fstab.
    "mount": """read -r source _ kind _ <<< "$(grep " $1 " /etc/fstab)"
[ "$kind" = nfs ] || exit 32
exec /bin/mount --bind "${source#*:}" "$1\"""",
    "scp": """target=${!#}; target=${target#*:}
for file in "${@:1:$#-1}"; do
  [ "$file" -ef "$target/$(basename "$file")" ] || cp "$file" "$target"
done""",
    "exportfs": "exit 0",
    "docker": f'exec {sys.executable} {ROOT / "tests" / "containers.py"} "$@"',
}

_ENTER = """set -eu
mount --make-rprivate /
mount -t tmpfs tmpfs "$PLACE"
mkdir "$PLACE/upper" "$PLACE/work" "$PLACE/root"
mount -t overlay overlay -o lowerdir=/,upperdir="$PLACE/upper",workdir="$PLACE/work" "$PLACE/root"
root=$PLACE/root
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t tmpfs tmpfs "$root/run"
mkdir -p "$root/opt/stickslip" "$root/stand-ins" "$root/home/me"
# The repository may be on another file system than the root.
if [ ! -e "$root$REPOSITORY/Makefile" ]; then
  mkdir -p "$root$REPOSITORY"
  mount --bind "$REPOSITORY" "$root$REPOSITORY"
fi
mount --bind "$root$REPOSITORY" "$root/opt/stickslip"
# Other users run this interpreter and the repository, too, which may be in somebody's home.
for above in "$INTERPRETER" "$REPOSITORY"; do
  while [ "$above" != / ]; do above=$(dirname "$above"); chmod a+rx "$root$above"; done
done
cp -a "$STAND_INS"/. "$root/stand-ins"
ip link set lo up
hostname node1
echo "127.0.0.1 localhost node1 server stick.example.org" > "$root/etc/hosts"
path="/stand-ins:$REPOSITORY/.venv/bin:/usr/sbin:/usr/bin:/sbin:/bin"
exec chroot "$root" env PATH="$path" HOME=/home/me \\
  bash -euo pipefail -c "cd /opt/stickslip; $SCRIPT"
"""


def refusal(place: Path) -> str:
    """Return why this machine lets nobody make a sandbox; an empty text if it does."""
    if os.geteuid() != 0:
        return "namespaces, mounts and users need root"
    for program in ("unshare", "setpriv", "ip", "chroot"):
        if shutil.which(program) is None:
            return f"{program} is not installed: apt-get install iproute2 util-linux"
    probe = run("true", place)
    return "" if probe.returncode == 0 else f"no overlay of / here: {probe.stderr.strip()[-200:]}"


def run(script: str, place: Path, timeout: float = 900) -> "subprocess.CompletedProcess[str]":
    """Run a script in a sandbox whose files are below `place`, and end all that it started."""
    stand_ins = place / "stand-ins"
    stand_ins.mkdir(exist_ok=True)
    for name, text in _STAND_INS.items():
        (stand_ins / name).write_text(f"#!/bin/bash\n{text}\n")
        (stand_ins / name).chmod(0o755)
    (place / "machine").mkdir(exist_ok=True)
    environment = {
        **{name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ},
        "PLACE": str(place / "machine"),
        "STAND_INS": str(stand_ins),
        "REPOSITORY": str(ROOT),
        "INTERPRETER": str(Path(sys.executable).resolve()),
        "SCRIPT": script,
    }
    apart = ["unshare", "--mount", "--net", "--uts", "--ipc", "--pid", "--fork", "--kill-child"]
    return subprocess.run(
        [*apart, "bash", "-c", _ENTER],
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
    )


@pytest.fixture
def sandbox(tmp_path: Path) -> Path:
    """A place for a sandbox; skip the test where there can be none."""
    reason = refusal(tmp_path)
    if reason:
        pytest.skip(reason)
    return tmp_path
