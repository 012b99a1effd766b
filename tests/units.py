"""A stand-in for `systemctl` in a sandbox: starts and stops the processes of unit files.

    python units.py enable --now NAME | stop NAME | daemon-reload

It reads the units in /etc/systemd/system as systemd does: user, environment, files of it, and the
command with `%H`, `${NAME}` and `$NAME`. It confines nothing; `systemd-analyze verify` checks the
other keys (test_deploy.py).
"""

import os
import pwd
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

UNITS = Path("/etc/systemd/system")
RUN = Path("/run/units")


def settings_of(unit: Path) -> dict[str, list[str]]:
    """Return the values of each key of the section Service, in their order."""
    settings: dict[str, list[str]] = {}
    section = ""
    for line in unit.read_text().splitlines():
        if line.startswith("["):
            section = line
        elif section == "[Service]" and "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            settings.setdefault(key, []).append(value)
    return settings


def environment_of(settings: dict[str, list[str]]) -> dict[str, str]:
    """Return the environment of a unit: that of systemd, its own, and that of its files."""
    user = pwd.getpwnam(settings["User"][0])
    variables = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": user.pw_dir, "USER": user.pw_name}
    lines = list(settings.get("Environment", []))
    for name in settings.get("EnvironmentFile", []):
        path = Path(name.removeprefix("-"))
        if path.exists() or not name.startswith("-"):
            lines += path.read_text().splitlines()
    for line in lines:
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            variables[key] = value
    return variables


def command_of(settings: dict[str, list[str]], environment: dict[str, str]) -> list[str]:
    """Return the command of a unit, word by word."""
    words: list[str] = []
    for word in shlex.split(settings["ExecStart"][0].replace("%H", socket.gethostname())):
        if re.fullmatch(r"\$\w+", word):  # a variable by itself becomes its words
            words += environment[word[1:]].split()
        else:
            words.append(re.sub(r"\$\{(\w+)\}", lambda match: environment[match[1]], word))
    return words


def start(name: str) -> None:
    settings = settings_of(UNITS / f"{name}.service")
    environment = environment_of(settings)
    user = pwd.getpwnam(settings["User"][0])
    RUN.mkdir(exist_ok=True)
    for directory in settings.get("StateDirectory", []):
        path = Path("/var/lib", directory)
        path.mkdir(exist_ok=True)
        os.chown(path, user.pw_uid, user.pw_gid)
    with (RUN / f"{name}.log").open("ab") as log:
        process = subprocess.Popen(
            command_of(settings, environment),
            env=environment,
            cwd="/",
            user=user.pw_uid,
            group=user.pw_gid,
            extra_groups=[],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    (RUN / f"{name}.pid").write_text(str(process.pid))
    for line in settings.get("ExecStartPost", []):
        command = shlex.split(line)
        subprocess.run(command, user=user.pw_uid, group=user.pw_gid, check=True, timeout=90)


def stop(name: str) -> None:
    pid = int((RUN / f"{name}.pid").read_text())
    os.kill(pid, signal.SIGTERM)
    deadline = time.monotonic() + 300
    while Path(f"/proc/{pid}/exe").exists() and time.monotonic() < deadline:
        time.sleep(0.1)


def main() -> None:
    match sys.argv[1:]:
        case ["daemon-reload"]:
            return
        case ["enable", "--now", name] | ["start", name]:
            start(name)
        case ["stop", name]:
            stop(name)
        case words:
            sys.exit(f"systemctl {' '.join(words)} is not known here")


if __name__ == "__main__":
    main()
