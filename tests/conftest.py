"""Fixtures of the tests across components."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from harness import STICKSLIP, Service
from machines import BUCKET, HUB, URL, Lab, entered, ip, namespace, running
from stickslip_services.database.database import Role
from stickslip_services.database.opening import connect
from stickslip_services.settings import Settings


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A running service, shared by the tests that leave it as they found it."""
    running = Service(tmp_path_factory.mktemp("service"))
    running.start()
    yield running
    running.stop()


@pytest.fixture
def hub() -> Iterator[int]:
    """The namespace of the machine with the coordinator, which is the switch, too; the test runs
    there.
    """
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    for program in ("ip", "unshare", "nsenter"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed: apt-get install iproute2 util-linux")
    probe = subprocess.run(
        ["unshare", "--net", "--pid", "--fork", "--mount-proc", "true"], capture_output=True
    )
    if probe.returncode != 0:
        pytest.skip(f"this machine lets nobody make namespaces: {probe.stderr.decode().strip()}")
    with namespace() as pid:
        ip("link", "add", "br0", "type", "bridge", within=pid)
        ip("address", "add", f"{HUB}/24", "dev", "br0", within=pid)
        ip("link", "set", "br0", "up", within=pid)
        with entered(pid):
            yield pid


@pytest.fixture
def lab(hub: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    """The coordinator with its database and its bucket."""
    pytest.importorskip("obstore", reason="obstore is not installed: make setup-dev")
    pytest.importorskip("moto", reason="moto is not installed: make setup-dev")
    pytest.importorskip("psycopg", reason="psycopg is not installed: make setup-dev")
    from stickslip_testing.postgresql import find_programs, postgresql_server

    programs = find_programs()
    if programs is None:
        pytest.skip("the PostgreSQL server is not installed: apt-get install postgresql")
    variables = {
        "AWS_ENDPOINT_URL": f"http://{HUB}:9000",
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "STICKSLIP_LEASE_SECONDS": os.environ.get("STICKSLIP_LEASE_SECONDS", "30"),
    }
    with ExitStack() as stack:
        server = stack.enter_context(postgresql_server(programs))
        for name, value in (variables | {"STICKSLIP_DATABASE": server.empty()}).items():
            monkeypatch.setenv(name, value)
        stack.enter_context(
            running(tmp_path, "bucket", ["-m", "moto.server", "-H", HUB, "-p", "9000"], 9000)
        )
        httpx.put(f"http://{HUB}:9000/lab", trust_env=False).raise_for_status()
        words = ["-m", "stickslip_services.app", "--data", str(tmp_path), "--store", BUCKET]
        words += ["--host", HUB, "--behind-proxy"]
        stack.enter_context(running(tmp_path, "coordinator", words, 8765))
        create = [
            str(STICKSLIP),
            "keys",
            "create",
            "test",
            "--scope",
            "admin",
            "--data",
            str(tmp_path),
        ]
        key = subprocess.run(create, capture_output=True, text=True, check=True).stdout.strip()
        client = stack.enter_context(
            httpx.Client(
                base_url=URL,
                headers={"Authorization": f"Bearer {key}"},
                trust_env=False,
                timeout=60,
            )
        )
        database = connect(Settings.chosen(data=tmp_path, store=BUCKET), Role.visitor)
        stack.callback(database.close)
        yield Lab(database, client, tmp_path)
