"""Pages of datasets: the list, one version, and its samples."""

import json
from functools import lru_cache
from importlib.util import find_spec
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import RedirectResponse
from stickslip_schemas.documents.responses import Dataset, DatasetVersion
from stickslip_schemas.format.pictures import png
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.store import Store

from stickslip_services.api.files import matches
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.catalog.datasets import find_dataset, find_version, list_datasets, read_contents
from stickslip_services.database.paging import PageRequest
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.browsing import coloured, histograms, losses, sample_view, sliders, thumbs
from stickslip_services.pages.films import mp4
from stickslip_services.pages.motion import motion
from stickslip_services.pages.rendering import html_page, spec_text
from stickslip_services.pages.sample_data import SampleData
from stickslip_services.queue.context import Context

router = APIRouter()

Version = Annotated[int, Path(ge=1, lt=2**31)]


@router.get("/datasets")
def get_datasets(context: ContextDep) -> Response:
    """Show the datasets."""
    with context.database.read() as connection:
        datasets = list_datasets(connection, PageRequest(100, None)).items
    return html_page("datasets.html", here="datasets", datasets=datasets)


@router.get("/datasets/{dataset}")
def get_dataset(dataset: str, context: ContextDep) -> Response:
    """Redirect to the newest version of a dataset."""
    with context.database.read() as connection:
        versions = find_dataset(connection, dataset).versions
    if not versions:
        raise NotFoundError(f"dataset {dataset} has no version yet")
    return RedirectResponse(f"/datasets/{dataset}/v{versions[-1].version}")


@router.get("/datasets/{dataset}/v{version}")
def get_version(request: Request, dataset: str, version: Version, context: ContextDep) -> Response:
    """Show a version."""
    found, committed, data = _open(context, dataset, version)
    values = thumbs(data, request.query_params, 0) | losses(data)
    return html_page(
        "dataset.html",
        here="datasets",
        dataset=found,
        version=committed,
        manifest=data.manifest,
        sliders=sliders(data.manifest.spec),
        histograms=histograms(data),
        splits=SPLITS,
        file_count=None if data.manifest.sections else len(data.manifest.files) + 3,
        card="README.md" if data.contents.file("README.md") else None,
        picture="preview.webp" if data.contents.file("preview.webp") else None,
        url=context.settings.url,
        **values,
    )


@router.get("/ui/datasets/{dataset}/v{version}/thumbs")
def get_thumbs(
    request: Request,
    dataset: str,
    version: Version,
    context: ContextDep,
    start: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> Response:
    """Show the samples within the sliders."""
    found, committed, data = _open(context, dataset, version)
    page = html_page("thumbs.html", dataset=found, version=committed, **thumbs(data, request.query_params, start))
    if not start:
        page.headers["HX-Replace-Url"] = f"/datasets/{found.id}/v{version}?{request.url.query}"
    return page


def _open(context: Context, dataset: str, version: int) -> tuple[Dataset, DatasetVersion, SampleData]:
    with context.database.read() as connection:
        found, committed = find_dataset(connection, dataset), find_version(connection, dataset, version)
    return found, committed, _sample_data(context.store, committed.manifest)


@lru_cache(maxsize=8)
def _sample_data(store: Store, manifest: str) -> SampleData:
    return SampleData(store, read_contents(store, manifest))


@router.get("/datasets/{dataset}/v{version}/samples/{slot}")
def get_sample(
    dataset: str, version: Version, slot: int, context: ContextDep, beside: Annotated[str, Query(max_length=20)] = ""
) -> Response:
    """Show the pictures, curves, shapes and labels of a sample, or of two samples side by side."""
    found, committed, data = _open(context, dataset, version)
    last = data.manifest.sample_count - 1
    slots = [slot, *([int(beside)] if beside.isdecimal() else [])]
    if not all(0 <= each <= last for each in slots):
        raise NotFoundError(f"version {version} of {dataset} has slots 0 to {last}, not {', '.join(map(str, slots))}")
    rejections = {each: rejection for each in slots if (rejection := data.rejection(each))}
    return html_page(
        "sample.html",
        here="datasets",
        dataset=found,
        version=committed,
        slot=slot,
        last_slot=last,
        rejections=rejections.values(),
        shown=[sample_view(data, each) for each in slots if each not in rejections],
        has_mp4=find_spec("av") is not None,
    )


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}.mp4")
def get_film(
    dataset: str, version: Version, slot: Annotated[int, Path(ge=0)], array: str, context: ContextDep
) -> Response:
    """Return a clip, or its ground truth, as MP4 with 10 frames a second."""
    _, _, data = _open(context, dataset, version)
    values = _value(data, array, slot)
    if data.arrays[array].dimensions[:3] != ("frame", "y", "x"):
        raise NotFoundError(f"{array[:50]} is no clip")
    frames = [coloured(data.arrays[array], values, index) for index in range(len(values))]
    return Response(mp4(frames), media_type="video/mp4")


@router.get("/ui/datasets/{dataset}/v{version}/spec.yaml")
def get_spec(dataset: str, version: Version, context: ContextDep) -> Response:
    """Return the spec of a version as YAML."""
    _, _, data = _open(context, dataset, version)
    return Response(spec_text(data.manifest.spec), media_type="application/yaml")


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}/{index}.png")
def get_picture(
    dataset: str,
    version: Version,
    slot: Annotated[int, Path(ge=0)],
    array: str,
    index: Annotated[int, Path(ge=0)],
    request: Request,
    context: ContextDep,
    step: Annotated[int, Query(ge=1, le=8)] = 1,
) -> Response:
    """Return a picture or a frame of ground truth of a sample as PNG; `step` takes every `step`-th pixel."""
    _, committed, data = _open(context, dataset, version)
    tag = f'"{committed.manifest[:32]}-{slot}-{index}-{step}"'
    headers = {"Cache-Control": "private, max-age=86400", "ETag": tag}
    if matches(request.headers.get("if-none-match"), tag):
        return Response(status_code=304, headers=headers)
    values = _value(data, array, slot)
    if data.arrays[array].dimensions[1:3] != ("y", "x") or index >= len(values):
        raise NotFoundError(f"{array[:50]} has no picture {index}")
    content = png(coloured(data.arrays[array], values, index)[::step, ::step])
    return Response(content, media_type="image/png", headers=headers)


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/motion.json")
def get_motion(dataset: str, version: Version, slot: Annotated[int, Path(ge=0)], context: ContextDep) -> Response:
    """Return what the view of a sample in three dimensions draws, as JSON."""
    _, _, data = _open(context, dataset, version)
    try:
        if slot >= data.manifest.sample_count:
            raise KeyError(slot)
        document = motion(data, slot)
    except KeyError as error:
        raise NotFoundError(f"version {version} of {dataset} has no shape of a sample {slot}") from error
    return Response(json.dumps(document), media_type="application/json")


def _value(data: SampleData, array: str, slot: int) -> Any:
    if array not in data.arrays or slot >= data.manifest.sample_count:
        raise NotFoundError(f"the dataset has no {array[:50]!r} of sample {slot}")
    try:
        return data.read(array, slot)
    except KeyError as error:
        raise NotFoundError(f"sample {slot} has no {array[:50]!r}") from error
