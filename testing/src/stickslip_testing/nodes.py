"""Coordinators and workers in processes of their own, which tests kill.

The workers only pretend to work.
"""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import httpx
from stickslip_services.local.supervisor import listen

COORDINATOR = "import sys; from stickslip_services.app import main; sys.exit(main())"
WORKER = """
# NAME KEY STORE URL
import sys, time
import httpx
from stickslip_schemas.store import open_store
from stickslip_testing.worker import PretendWorker
from stickslip_testing.servers import HttpApi

name, key, place, url = sys.argv[1:]
store = open_store(place)
while True:
    try:
        worker = PretendWorker(HttpApi(url, key), store, name=name, whole=False).register()
        while True:
            leases = worker.lease(simulate=4, render=4, pack=1, publish=1)
            worker.start(*leases)
            for lease in leases:
                worker.finish(lease)
            time.sleep(0 if leases else 0.1)
    except httpx.HTTPError:
        time.sleep(0.1)
"""


NURSERY = """
# Each line of JSON on standard input starts a process: code, arguments, log, environment.
# Prints its number.
import importlib, json, os, random, signal, sys
import stickslip_services.app, stickslip_testing.servers, stickslip_testing.worker, zarr

for name in ("obstore", "stickslip_services.database.postgresql"):
    try:
        importlib.import_module(name)
    except ImportError:  # then nothing uses it
        pass
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody has to wait for those that end
for line in sys.stdin:
    code, arguments, log, environment = json.loads(line)
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        file = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        for number, other in enumerate((os.open(os.devnull, os.O_RDONLY), file, file)):
            os.dup2(other, number)
        os.environ.clear()
        os.environ |= environment
        sys.argv = ["-c", *arguments]
        random.seed()
        exec(code, {"__name__": "__main__"})
        os._exit(0)
    print(pid, flush=True)
"""


@cache
def _nursery() -> "subprocess.Popen[str]":
    """Return the process that starts others.

    It has imported what they need, which takes 2 s of CPU time each time.
    """
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", NURSERY], text=True, **pipes)  # type: ignore[call-overload,no-any-return]


class Node:
    """A process that is started again when it has been killed."""

    def __init__(self, name: str, code: str, arguments: list[str], log: Path) -> None:
        self.name = name
        self._start = code, arguments, str(log)
        self.start()

    def start(self, **environment: str) -> None:
        """Start it, with variables of its environment beside those of this process."""
        nursery = _nursery()
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        print(json.dumps([*self._start, os.environ | environment]), file=nursery.stdin, flush=True)
        self.pid = int(nursery.stdout.readline())

    def kill(self) -> None:
        """Kill it, and wait until it is gone."""
        with suppress(ProcessLookupError):
            while True:
                os.kill(self.pid, signal.SIGKILL)
                time.sleep(0.01)


def free_port() -> int:
    """Return a port that nobody listens on."""
    with listen("127.0.0.1", 0) as listener:
        return int(listener.getsockname()[1])


def is_ready(url: str) -> bool:
    """Return whether a coordinator answers."""
    with suppress(httpx.TransportError):
        return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
    return False
