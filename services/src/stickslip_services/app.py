"""The coordinator: its ASGI application, its background services, and the process that serves them.

    python -m stickslip_services.app --data DIR --port N
    python -m stickslip_services.app --openapi > docs/openapi.json

The port is bound first, so that `--port 0` can print the port that it got. The line `listening on
http://...` on standard output means that requests are answered.
"""

import asyncio
import gc
import json
import logging
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import uvicorn
from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.staticfiles import StaticFiles
from stickslip_schemas.logs import configure_logging

from stickslip_services import __version__
from stickslip_services.access.keys import KeyRing, sealer, secret_in
from stickslip_services.access.webhooks import WebhookDelivery
from stickslip_services.api import middleware, problems, protocol
from stickslip_services.api.openapi import describe
from stickslip_services.api.routes import catalog, health, jobs, workers
from stickslip_services.api.routes.health import Metrics
from stickslip_services.api.routes.pages import datasets as dataset_pages
from stickslip_services.api.routes.pages import jobs as job_pages
from stickslip_services.api.routes.pages import samples as sample_pages
from stickslip_services.api.routes.pages import submit as submit_pages
from stickslip_services.api.sse import Feeds
from stickslip_services.catalog.inspector import MAX_PROCESSES
from stickslip_services.client.errors import ClientError
from stickslip_services.client.signing import sign
from stickslip_services.database.database import Clock, Role
from stickslip_services.database.opening import check as check_database
from stickslip_services.database.opening import opened
from stickslip_services.errors import CommandError
from stickslip_services.local.supervisor import limit_arenas, listen, locked
from stickslip_services.pages.rendering import STATIC
from stickslip_services.queue import background
from stickslip_services.queue.context import Context
from stickslip_services.queue.heartbeat import renew_leases
from stickslip_services.settings import SERVER, Settings, options

logger = logging.getLogger(__name__)

CTRL_C_STATUS = 130
"""Exit status after Ctrl-C, as of a shell: 128 + SIGINT."""

COLLECT_AFTER = 50_000
"""New objects after which garbage is collected. A plan has a million small objects without cycles:
collecting after 2,000, as Python does, takes a fifth of its time.
"""

GRACE_SECONDS = 3
"""Time that open requests (event streams) have to end after a signal [s]."""


async def _repeat(run_once: Callable[[], object], seconds: float) -> None:
    """Call a function in a thread, again and again, with pauses of `seconds` [s].

    Log its errors, and go on.
    """
    while True:
        await asyncio.sleep(seconds)
        try:
            await run_in_threadpool(run_once)
        except Exception:  # for example a full disk
            logger.exception("a background service failed")


def make_app(settings: Settings, *, clock: Clock | None = None) -> FastAPI:
    """Return the application; the database is migrated when it starts."""
    context = Context.open(settings, clock)
    metrics = Metrics(context)
    sealing = sealer(settings)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(background.start, context)
        delivery = WebhookDelivery(context.database, context.clock, sealing)
        services = background.services(context)
        services.append(background.Service(delivery.run, settings.sweep_seconds))
        running = [asyncio.create_task(_repeat(*service)) for service in services]
        running.append(asyncio.create_task(context.database.listen(context.notifier.notify)))
        yield
        delivery.stop()
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        context.close()

    app = FastAPI(
        title="stickslip",
        version=__version__,
        description="Physically verified synthetic datasets of slender things.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/openapi.json",
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    app.state.context = context
    app.state.metrics = metrics
    app.state.feeds = Feeds(context)
    app.state.renewals = workers.Batcher(partial(renew_leases, context))
    app.state.upload_turns = asyncio.Semaphore(MAX_PROCESSES)
    app.state.worker_key = secret_in(settings.worker_key_path)
    # The routes of the workers come first: they are asked for most, and a request is compared with
    # one after the other.
    pages = (job_pages, dataset_pages, sample_pages, submit_pages)
    modules = (workers, jobs, catalog, health, *pages)
    app.state.routes = [route for module in modules for route in module.router.routes]
    app.router.routes += app.state.routes
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    problems.install(app)
    app.openapi = lambda: describe(app)  # type: ignore[method-assign]
    app.add_middleware(
        middleware.KeyMiddleware, ring=KeyRing(context.database), required=settings.keys_required
    )
    app.add_middleware(
        middleware.OriginMiddleware, allowed_hosts=(*settings.allowed_hosts, settings.host)
    )
    app.add_middleware(middleware.RequestMiddleware, observe=metrics.observe)
    app.add_middleware(middleware.AddressMiddleware, root_path=settings.root_path)
    return app


def openapi_text() -> str:
    """Return the OpenAPI document in its committed form."""
    with TemporaryDirectory() as data:
        document = make_app(Settings(data=Path(data), database=None)).openapi()
    return json.dumps(document, indent=2, sort_keys=True) + "\n"


class _Server(uvicorn.Server):
    """Prints the URL on standard output as soon as it listens."""

    def __init__(self, config: uvicorn.Config, url: str) -> None:
        super().__init__(config)
        self._url = url

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        # Modules and application stay: collecting garbage among them would stop all requests for
        # 50 ms each time.
        gc.freeze()
        gc.set_threshold(COLLECT_AFTER)
        if self.started:
            sys.stdout.write(f"listening on {self._url}\n")
            sys.stdout.flush()


@click.command()
@click.option("--openapi", is_flag=True, help="print the OpenAPI document and end")
@click.option("--migrate", is_flag=True, help="bring the database up to date, and end")
@click.option("--fd", type=int, help="listen on this inherited socket instead")
@options(*SERVER)
def _coordinator(settings: Settings, openapi: bool, migrate: bool, fd: int | None) -> int:
    """Run a coordinator until a signal arrives."""
    if openapi:
        sys.stdout.write(openapi_text())
        return 0
    if settings.signing_key is not None:
        # A key that cannot sign is found now, and not when the first version is published.
        sign(b"", settings.signing_key)
    configure_logging()
    logging.getLogger("alembic").setLevel(logging.WARNING)
    limit_arenas()
    check_database(settings, Role.visitor if migrate else Role.coordinator, with_store=True)
    if migrate:
        with opened(settings, Role.visitor):
            return 0
    # `stickslip up` hands down its socket and its lock. Alone, the coordinator keeps others off its
    # data itself.
    with locked(settings.data) if fd is None else nullcontext():
        if fd is None:
            listener = listen(settings.host, settings.port)
        else:
            listener = socket.socket(fileno=fd)
        return _serve(settings, listener)


def main(arguments: list[str] | None = None) -> int:
    """Run the command, and return its exit status."""
    try:
        return int(
            _coordinator.main(arguments, "python -m stickslip_services.app", standalone_mode=False)
        )
    except click.ClickException as error:
        error.show()
    except (ClientError, CommandError) as error:
        sys.stderr.write(f"error: {error}\n")
    return 2


def _serve(settings: Settings, listener: socket.socket) -> int:
    """Answer requests until a signal arrives; return the exit status."""
    settings = settings.model_copy(update={"port": listener.getsockname()[1]})
    config = uvicorn.Config(
        make_app(settings),
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=GRACE_SECONDS,
        lifespan="on",
        proxy_headers=False,
        http=protocol.PatientProtocol,
        ssl_certfile=settings.tls_certificate,
        ssl_keyfile=settings.tls_key,
    )
    protocol.allow_many_files()
    # Event streams hold their connections for hours.
    server = _Server(config, settings.url)
    try:
        server.run(sockets=[listener])
    # uvicorn raises the signal again when it has stopped; Ctrl-C is no error.
    except KeyboardInterrupt:
        return CTRL_C_STATUS
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main())
