"""The coordinator as an ASGI application."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool

from stickslip_services import __version__, problems
from stickslip_services.clock import Clock, steady_clock
from stickslip_services.metrics import Metrics
from stickslip_services.middleware import BodyLimitMiddleware, RequestIdMiddleware, TimingMiddleware
from stickslip_services.openapi import describe
from stickslip_services.operations import Coordinator
from stickslip_services.routes import certificates, datasets, health, jobs, tasks, worker_api
from stickslip_services.settings import Settings

logger = logging.getLogger(__name__)


def make_app(settings: Settings, *, clock: Clock | None = None) -> FastAPI:
    """Return the application; the database is opened when it starts."""
    coordinator = Coordinator(settings, clock or steady_clock())
    metrics = Metrics(coordinator)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(coordinator.start)
        sweeper = asyncio.create_task(_sweep_for_ever(coordinator))
        yield
        sweeper.cancel()
        with suppress(asyncio.CancelledError):
            await sweeper
        coordinator.close()

    app = FastAPI(
        title="stickslip",
        version=__version__,
        description="Physically verified synthetic datasets of slender things.",
        lifespan=lifespan,
        docs_url="/docs",
        redoc_url=None,
        openapi_url="/openapi.json",
    )
    app.state.coordinator = coordinator
    app.state.metrics = metrics
    for module in (jobs, datasets, certificates, tasks, worker_api, health):
        app.include_router(module.router)
    problems.install(app)
    app.openapi = lambda: describe(app)  # type: ignore[method-assign]
    app.add_middleware(BodyLimitMiddleware, limit=settings.body_limit)
    app.add_middleware(RequestIdMiddleware)
    app.add_middleware(TimingMiddleware, observe=metrics.observe)
    return app


async def _sweep_for_ever(coordinator: Coordinator) -> None:
    while True:
        await asyncio.sleep(coordinator.settings.sweep_seconds)
        try:
            await run_in_threadpool(coordinator.sweep)
        except Exception:  # a full disk, say: the next sweep may find it otherwise
            logger.exception("the sweep failed")
