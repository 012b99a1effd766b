"""Coordinators and workers in processes of their own, which tests kill. The workers only pretend to work."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import httpx
from stickslip_services.local.process import listen

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


class Node:
    """A process that is started again when it has been killed."""

    def __init__(self, name: str, words: list[str], log: Path) -> None:
        self.name = name
        self._words = words
        self._log = log
        self.start()

    def start(self, **environment: str) -> None:
        """Start it, with variables of its environment beside those of this process."""
        variables = os.environ | environment
        with self._log.open("ab") as log:
            self._process = subprocess.Popen([sys.executable, *self._words], stdout=log, stderr=log, env=variables)

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def kill(self) -> None:
        """Kill it, and wait until it is gone."""
        self._process.kill()
        self._process.wait()


def free_port() -> int:
    """Return a port that nobody listens on."""
    with listen("127.0.0.1", 0) as listener:
        return int(listener.getsockname()[1])


def is_ready(url: str) -> bool:
    """Return whether a coordinator answers."""
    with suppress(httpx.TransportError):
        return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
    return False
