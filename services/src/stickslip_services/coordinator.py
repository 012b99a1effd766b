"""Run the coordinator.

    python -m stickslip_services.coordinator --data DIR --port N

The port is bound before anything else is done, so that `--port 0` can say which one it got: the line
`listening on http://...` on standard output is the sign that requests are answered.
"""

import argparse
import logging
import socket
import sys
from pathlib import Path

import uvicorn
from pydantic import ValidationError

from stickslip_services.app import make_app
from stickslip_services.logs import configure_logging
from stickslip_services.settings import DEFAULT_PORT, Settings
from stickslip_services.sockets import listen

logger = logging.getLogger(__name__)

GRACE_SECONDS = 3
"""How long open requests (event streams) may go on after a signal to stop [s]."""


class _Server(uvicorn.Server):
    """Says on standard output where it listens, once it does."""

    def __init__(self, config: uvicorn.Config, url: str) -> None:
        super().__init__(config)
        self._url = url

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            sys.stdout.write(f"listening on {self._url}\n")
            sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Run until a signal comes; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m stickslip_services.coordinator", description="The coordinator.")
    parser.add_argument("--data", type=Path, help="directory of the database and the store")
    parser.add_argument("--store", type=Path, dest="store_path", help="root of the store (DATA/store)")
    parser.add_argument("--host", help="address to listen on (127.0.0.1)")
    parser.add_argument("--port", type=int, help=f"port to listen on ({DEFAULT_PORT}; 0: any that is free)")
    parser.add_argument("--fd", type=int, help="listen on this inherited socket instead")
    chosen = {name: value for name, value in vars(parser.parse_args(arguments)).items() if value is not None}
    descriptor = chosen.pop("fd", None)
    try:
        settings = Settings(**chosen)
    except ValidationError as error:
        sys.stderr.write("".join(f"error: {item['msg'].removeprefix('Value error, ')}\n" for item in error.errors()))
        return 2
    configure_logging()
    try:
        listener = listen(settings.host, settings.port) if descriptor is None else socket.socket(fileno=descriptor)
    except OSError as error:
        sys.stderr.write(f"error: cannot listen on {settings.host}:{settings.port}: {error.strerror}\n")
        return 2
    settings = settings.model_copy(update={"port": listener.getsockname()[1]})
    config = uvicorn.Config(
        make_app(settings), log_config=None, access_log=False, timeout_graceful_shutdown=GRACE_SECONDS, lifespan="on"
    )
    server = _Server(config, settings.url)
    server.run(sockets=[listener])
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main())
