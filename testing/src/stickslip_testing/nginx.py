"""nginx in front of a service, where it is installed."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from stickslip_testing.servers import wait_until

_CONFIGURATION = """
daemon off;
{user}
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{}}
http {{
  access_log off;
  {temporary}
  {http}
  server {{
    listen 127.0.0.1:{port};
    location = /nginx-is-up {{ return 200; }}
    {server}
  }}
}}
"""


@contextmanager
def nginx(folder: Path, *, server: str, http: str = "") -> Iterator[str]:
    """Run nginx with its files in a folder; yield its address, and skip the test without nginx.

    `server` and `http` are lines of these two blocks of its configuration.
    """
    program = shutil.which("nginx", path="/usr/sbin:/usr/bin:/usr/local/sbin")
    if program is None:
        pytest.skip("nginx is not installed: apt-get install nginx")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    # Its usual folders are those of root.
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = " ".join(f"{kind}_temp_path {folder}/{kind};" for kind in kinds)
    configuration = folder / "nginx.conf"
    configuration.write_text(
        _CONFIGURATION.format(
            folder=folder,
            port=port,
            server=server,
            http=http,
            temporary=temporary,
            # As root, its workers would be of a user that may not enter the folders of tests.
            user="user root;" if os.getuid() == 0 else "",
        )
    )
    process = subprocess.Popen([program, "-c", str(configuration), "-e", "stderr"])
    address = f"http://127.0.0.1:{port}"
    try:
        wait_until(lambda: _is_answering(f"{address}/nginx-is-up"))
        yield address
    finally:
        process.terminate()
        process.wait(20)


def _is_answering(url: str) -> bool:
    try:
        return httpx.get(url, trust_env=False).status_code == 200
    except httpx.TransportError:
        return False
