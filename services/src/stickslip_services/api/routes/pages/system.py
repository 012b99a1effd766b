"""Pages of scenes, of certificates, of workers, and of the HTTP interface."""

import pathlib
from collections.abc import Iterator
from typing import Any

from fastapi import APIRouter, Request, Response
from sqlalchemy import Connection, func, select
from stickslip_schemas.documents.certificate import Certificate, Numbers, ProtocolReport

from stickslip_services.api.routes.common import ContextDep
from stickslip_services.catalog.inputs import find_certificate, known_scenes, list_certificates
from stickslip_services.clock import as_datetime
from stickslip_services.database.database import PageRequest
from stickslip_services.database.tables import dataset_versions
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.rendering import html_page, plot, table
from stickslip_services.queue.context import Context
from stickslip_services.queue.workers import alive_workers, show_workers

router = APIRouter()


@router.get("/scenes")
def get_scenes(context: ContextDep) -> Response:
    with context.database.read() as connection:
        scenes = known_scenes(connection)
    return html_page("scenes.html", here="scenes", scenes=scenes)


@router.get("/scenes/{digest}")
def get_scene(digest: str, context: ContextDep) -> Response:
    """Show a scene: how it looks, its parameters, and the datasets made of it."""
    with context.database.read() as connection:
        known = known_scenes(connection).get(digest)
    if known is None:
        raise NotFoundError(f"there is no scene {digest[:64]!r}")
    return html_page("scene.html", here="scenes", known=known, scene=known.scene)


@router.get("/certificates")
def get_certificates(context: ContextDep) -> Response:
    with context.database.read() as connection:
        entries = list_certificates(connection, PageRequest(200, None)).items
        builds = _builds(context, connection)
    return html_page("certificates.html", here="certificates", entries=entries, builds=builds)


@router.get("/certificates/{digest}")
def get_certificate(digest: str, context: ContextDep) -> Response:
    with context.database.read() as connection:
        stored = find_certificate(connection, digest)
        builds = _builds(context, connection)
    certificate = Certificate.model_validate_json(context.store.read(stored.artifact))
    plots = {protocol.protocol: list(_curves(protocol)) for protocol in certificate.protocols}
    return html_page(
        "certificate.html", here="certificates", certificate=certificate, digest=digest, builds=builds, plots=plots
    )


def _builds(context: Context, connection: Connection) -> set[str]:
    return {builds.sim_core for worker in alive_workers(context, connection) for builds in worker.builds.values()}


def _curves(protocol: ProtocolReport) -> Iterator[dict[str, Any]]:
    for curve in protocol.curves[:6]:
        dense = curve.dense_x, curve.dense_master
        line = dense if curve.dense_x else (curve.x, curve.master)  # of a certificate without dense curves
        name = ", ".join(f"{key} = {value:g}" for key, value in curve.parameters.items())
        yield plot(
            _known("master curve", *line),
            _known("measured", curve.x, curve.measured, is_dots=True),
            x_name=protocol.x,
            y_name=f"{protocol.y}{f' ({name})' if name else ''}",
            is_log=True,
        )


def _known(name: str, x: Numbers, y: Numbers, *, is_dots: bool = False) -> dict[str, Any]:
    known = sorted((a, b) for a, b in zip(x, y, strict=True) if a is not None and b is not None)
    return table([a for a, _ in known], {name: [b for _, b in known]}, is_dots=is_dots)


@router.get("/workers")
def get_workers(context: ContextDep) -> Response:
    with context.database.read() as connection:
        workers = show_workers(context, connection)
        certified = {
            entry.sim_core: entry
            for entry in reversed(list_certificates(connection, PageRequest(200, None)).items)
            if entry.extent == "full" and entry.passed
        }
        own = dataset_versions.c
        read_at, damaged = connection.execute(select(func.min(own.scrubbed_at), func.sum(own.damaged))).one()
    return html_page(
        "workers.html",
        here="workers",
        workers=workers,
        certified=certified,
        scrub=None if read_at is None else (as_datetime(read_at), int(damaged)),
        now=as_datetime(context.clock()),
        disk=context.store.room(),
        memory=_memory(),
    )


def _memory() -> dict[str, int] | None:
    """Return the memory of this machine, `MemTotal` and `MemAvailable` [B]; None without Linux's /proc."""
    try:
        lines = [line.split() for line in pathlib.Path("/proc/meminfo").read_text().splitlines()]
    except OSError:
        return None
    found = {line[0].rstrip(":"): 1024 * int(line[1]) for line in lines}
    return found if {"MemTotal", "MemAvailable"} <= found.keys() else None


@router.get("/docs")
def get_docs(request: Request) -> Response:
    return html_page("docs.html", here="docs", api=request.app.openapi())
