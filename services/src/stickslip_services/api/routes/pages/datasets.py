"""Pages of datasets (the list, one version, its samples), of scenes, and of certificates."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse, StreamingResponse
from pydantic import BaseModel, Field
from sqlalchemy import Connection
from stickslip_schemas.documents.certificate import Certificate, Numbers, ProtocolReport
from stickslip_schemas.format.pictures import png
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.reality import measured_fabrics, reality

from stickslip_services.addresses import link
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.api.routes.pages.opened import PICTURE_SECONDS, OpenedDep, value_of
from stickslip_services.catalog.inputs import find_certificate, list_certificates
from stickslip_services.catalog.scenes import known_scenes
from stickslip_services.catalog.versions import find_dataset, list_datasets
from stickslip_services.database.database import PageRequest
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.browsing import histograms, losses, picture_array, shards, thumbs
from stickslip_services.pages.choosing import CONDITIONS, OPERATORS, choose, sliders, sortable
from stickslip_services.pages.pictures import coloured
from stickslip_services.pages.rendering import html_page, plot, scene_text, spec_text, table
from stickslip_services.pages.zipping import MAX_ZIPPED, zipped
from stickslip_services.queue.context import Context
from stickslip_services.queue.workers import alive_workers

router = APIRouter(include_in_schema=False)

SHOWN_DATASETS = 50
SHOWN_CERTIFICATES = 200
SHOWN_CURVES = 6
"""Curves of a protocol that its page shows."""

COVER_SIDE = 56
"""Least shorter side of the picture of a dataset in the list [px]."""

_NO_PICTURE = png(np.full((2, 2, 3), 127, np.uint8))
"""A grey picture for a dataset without one."""


class DatasetFilter(BaseModel):
    """What the form of the list asks for; all of it stands in the address of the page."""

    search: str = Field("", max_length=100)
    order: Literal["newest", "oldest"] = "newest"
    after: int | None = Field(None, ge=0, lt=10**18)


DatasetFilterDep = Annotated[DatasetFilter, Query()]


@router.get("/datasets")
def get_datasets(context: ContextDep, chosen: DatasetFilterDep) -> Response:
    """Show a page of the datasets that fit the form."""
    with context.database.read() as connection:
        page = list_datasets(
            connection,
            PageRequest(SHOWN_DATASETS, chosen.after),
            chosen.search,
            newest_first=chosen.order == "newest",
        )
    query = chosen.model_dump(mode="json", exclude_defaults=True)
    return html_page(
        "datasets.html",
        here="datasets",
        datasets=page.items,
        chosen=chosen,
        query=query,
        more=page.next_page_token and urlencode(query | {"after": page.next_page_token}),
    )


@router.get("/ui/datasets/{dataset}/v{version}/cover.png")
def get_cover(opened: OpenedDep) -> Response:
    """Return a small picture of the first valid sample; a grey one if there is none."""
    data = opened.data
    headers = {"Cache-Control": f"private, max-age={PICTURE_SECONDS}"}
    name = picture_array(data)
    valid = np.flatnonzero(data.label("valid"))
    if name is None or not valid.size:
        return Response(_NO_PICTURE, media_type="image/png", headers=headers)
    values = value_of(data, name, int(valid[0]))
    (picture,) = coloured(data.arrays[name], values, [len(values) // 2])
    step = max(1, min(picture.shape[:2]) // COVER_SIDE)
    return Response(png(picture[::step, ::step]), media_type="image/png", headers=headers)


@router.get("/datasets/{dataset}")
def get_dataset(dataset: str, context: ContextDep) -> Response:
    """Redirect to the newest version of a dataset."""
    with context.database.read() as connection:
        versions = find_dataset(connection, dataset).versions
    if not versions:
        raise NotFoundError(f"dataset {dataset} has no version yet")
    return RedirectResponse(link(f"/datasets/{dataset}/v{versions[-1].version}"))


@router.get("/datasets/{dataset}/v{version}")
def get_version(request: Request, opened: OpenedDep) -> Response:
    """Show a version: its spec, its samples within the filters of the query, and its labels."""
    data = opened.data
    values = thumbs(data, request.query_params, 0) | losses(data)
    return html_page(
        "dataset.html",
        here="datasets",
        dataset=opened.dataset,
        version=opened.version,
        manifest=data.manifest,
        jobs=opened.jobs,
        sliders=sliders(data.manifest.spec),
        histograms=histograms(data),
        labels=sortable(data),
        operators=OPERATORS,
        conditions=range(CONDITIONS),
        shards=shards(data),
        max_zipped=MAX_ZIPPED,
        splits=SPLITS,
        file_count=None if data.manifest.sections else len(data.manifest.files) + 3,
        card="README.md" if data.contents.file("README.md") else None,
        picture="preview.webp" if data.contents.file("preview.webp") else None,
        is_continued=False,
        **values,
    )


@router.get("/ui/datasets/{dataset}/v{version}/thumbs")
def get_thumbs(
    request: Request,
    opened: OpenedDep,
    start: Annotated[int, Query(ge=0, lt=2**31)] = 0,
    part: Literal["all", "more"] = "all",
) -> Response:
    """Show the samples within the filters of the query, from one of them on."""
    values = thumbs(opened.data, request.query_params, start)
    page = html_page(
        "thumbs.html",
        dataset=opened.dataset,
        version=opened.version,
        is_continued=part == "more",
        max_zipped=MAX_ZIPPED,
        **values,
    )
    if part != "more":
        # The address of the page shows the filters, so that it can be sent to somebody.
        page.headers["HX-Replace-Url"] = link(
            f"/datasets/{opened.dataset.id}/v{opened.version.version}?{request.url.query}"
        )
    return page


@router.get("/ui/datasets/{dataset}/v{version}/selection.zip")
def get_selection(request: Request, opened: OpenedDep) -> Response:
    """Return the samples within the filters of the query as a zip file."""
    slots = choose(opened.data, request.query_params).slots
    if len(slots) > MAX_ZIPPED:
        raise NotFoundError(
            f"a zip file has at most {MAX_ZIPPED} samples, and the filters choose {len(slots)}: "
            "use the command that the page shows"
        )
    name = f"{opened.dataset.name or opened.dataset.id}-v{opened.version.version}.zip"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return StreamingResponse(zipped(opened.data, slots), 200, headers, "application/zip")


@router.get("/ui/datasets/{dataset}/v{version}/spec.yaml")
def get_spec(opened: OpenedDep) -> Response:
    """Return the spec of a version as YAML."""
    return Response(spec_text(opened.data.manifest.spec), media_type="application/yaml")


@router.get("/scenes")
def get_scenes(context: ContextDep) -> Response:
    """Show the scenes that the coordinator knows."""
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
    return html_page(
        "scene.html",
        here="scenes",
        known=known,
        scene=known.scene,
        text=scene_text(known.scene),
    )


@router.get("/certificates")
def get_certificates(context: ContextDep) -> Response:
    """Show the newest certificates."""
    with context.database.read() as connection:
        entries = list_certificates(connection, PageRequest(SHOWN_CERTIFICATES, None)).items
        builds = _builds(context, connection)
    return html_page("certificates.html", here="certificates", entries=entries, builds=builds)


@router.get("/certificates/{digest}")
def get_certificate(digest: str, context: ContextDep) -> Response:
    """Show a certificate: what each protocol has measured, and its curves."""
    with context.database.read() as connection:
        stored = find_certificate(connection, digest)
        builds = _builds(context, connection)
    certificate = Certificate.model_validate_json(context.store.read(stored.artifact))
    plots = {protocol.protocol: list(_curves(protocol)) for protocol in certificate.protocols}
    return html_page(
        "certificate.html",
        here="certificates",
        certificate=certificate,
        digest=digest,
        builds=builds,
        plots=plots,
        reality=reality(),
        fabrics=measured_fabrics(),
    )


def _builds(context: Context, connection: Connection) -> set[str]:
    return {
        builds.sim_core
        for worker in alive_workers(context, connection)
        for builds in worker.builds.values()
    }


def _curves(protocol: ProtocolReport) -> Iterator[dict[str, Any]]:
    """Yield the plots of a protocol: measured points, and the curve that they should be on."""
    for curve in protocol.curves[:SHOWN_CURVES]:
        # A certificate of an earlier build has the curve at the measured points only.
        master = (curve.x, curve.master)
        if curve.dense_x:
            master = (curve.dense_x, curve.dense_master)
        parameters = ", ".join(f"{key} = {value:g}" for key, value in curve.parameters.items())
        yield plot(
            _known_points("master curve", *master),
            _known_points("measured", curve.x, curve.measured, is_dots=True),
            x_name=protocol.x,
            y_name=f"{protocol.y} ({parameters})" if parameters else protocol.y,
            is_log=True,
        )


def _known_points(name: str, x: Numbers, y: Numbers, *, is_dots: bool = False) -> dict[str, Any]:
    """Return the points of a curve that have both coordinates, by ascending x."""
    points = sorted(
        (x_value, y_value)
        for x_value, y_value in zip(x, y, strict=True)
        if x_value is not None and y_value is not None
    )
    values = {name: [y_value for _, y_value in points]}
    return table([x_value for x_value, _ in points], values, is_dots=is_dots)
