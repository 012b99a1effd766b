"""Pages for people: the dashboard at `/`. They are not part of the API and change whenever that helps."""

import asyncio
import json
import pathlib
from collections.abc import AsyncIterator, Iterator, Mapping
from functools import lru_cache
from itertools import islice
from typing import Annotated, Any

import numpy as np
import yaml
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import RedirectResponse, StreamingResponse
from sqlalchemy import Connection
from stickslip_schemas.base.states import JobState, TaskState
from stickslip_schemas.documents.certificate import Certificate, Numbers, ProtocolReport
from stickslip_schemas.documents.responses import Dataset, DatasetVersion, JobDetail
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.points import grid
from stickslip_schemas.spec.jobs import SPLITS, JobSpec
from stickslip_schemas.store import Store

from stickslip_services.api.problems import ProblemError
from stickslip_services.api.routes.common import coordinator_of
from stickslip_services.catalog.certificates import find_certificate, list_certificates
from stickslip_services.catalog.datasets import find_dataset, find_version, list_datasets, read_contents
from stickslip_services.clock import as_datetime
from stickslip_services.database.paging import PageRequest
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.grid_map import MOST_SAMPLES, grid_maps
from stickslip_services.pages.pictures import line_plot, png
from stickslip_services.pages.rendering import render
from stickslip_services.pages.sample_data import SampleData
from stickslip_services.queue.coordinator import Coordinator
from stickslip_services.queue.jobs import (
    find_job,
    list_jobs,
    list_samples,
    newest_previews,
    stage_durations,
)
from stickslip_services.queue.retrying import failed_tasks
from stickslip_services.queue.workers import show_workers

router = APIRouter(include_in_schema=False)

CoordinatorDep = Annotated[Coordinator, Depends(coordinator_of)]
Version = Annotated[int, Path(ge=1, lt=2**31)]

SHOWN_JOBS = 30
SHOWN_THUMBS = 48
SHOWN_LOST = 50
CHANGE_SECONDS = 1.0
"""A page is told of changes at most so often [s]."""

_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def _page(template: str, **context: Any) -> Response:
    return Response(render(template, **context), media_type="text/html", headers=_POLICY)


# --- jobs -----------------------------------------------------------------------------------------------------


@router.get("/")
def get_jobs(coordinator: CoordinatorDep) -> Response:
    """Show the jobs."""
    return _page("jobs.html", here="jobs", url=coordinator.settings.url, **_jobs(coordinator))


@router.get("/ui/jobs")
def get_jobs_part(coordinator: CoordinatorDep) -> Response:
    """Show the list of jobs alone."""
    return _page("jobs_list.html", **_jobs(coordinator))


def _jobs(coordinator: Coordinator) -> dict[str, Any]:
    with coordinator.database.read() as connection:
        workers = coordinator.alive_workers(connection)
        jobs = list_jobs(connection, PageRequest(SHOWN_JOBS, None), workers).items
        pictures = {job.id: newest_previews(connection, find_job(connection, job.id).seq, 5) for job in jobs[:10]}
    return {"jobs": jobs, "pictures": pictures, "workers": len(workers), "states": JobState}


@router.get("/jobs/{job_id}")
def get_job(job_id: str, coordinator: CoordinatorDep) -> Response:
    """Show a job."""
    with coordinator.database.read() as connection:
        context = _job(coordinator, connection, job_id)
    spec: JobSpec = context["job"].spec
    document = spec.model_dump(mode="json", exclude_defaults=True) | {"kind": spec.kind}
    document["axes"] = {name: _short_form(axis) for name, axis in document["axes"].items()}
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return _page("job.html", here="jobs", spec=text, **context)


def _short_form(axis: dict[str, Any]) -> Any:
    """Return an axis as people write it: a list, or its only value."""
    if axis["type"] != "list":
        return axis
    return axis["values"][0] if len(axis["values"]) == 1 else axis["values"]


@router.get("/ui/jobs/{job_id}")
def get_job_part(job_id: str, coordinator: CoordinatorDep) -> Response:
    """Show what changes of a job."""
    with coordinator.database.read() as connection:
        return _page("job_state.html", **_job(coordinator, connection, job_id))


def _job(coordinator: Coordinator, connection: Connection, job_id: str) -> dict[str, Any]:
    seq = int(find_job(connection, job_id).seq)
    job: JobDetail = coordinator.show(connection, seq)
    rejected = list_samples(connection, seq, PageRequest(SHOWN_LOST, None), TaskState.rejected).items
    return {
        "job": job,
        "durations": stage_durations(connection, seq),
        "elapsed": _elapsed(job, coordinator),
        "previews": newest_previews(connection, seq, 24),
        "rejected": rejected,
        "failed": failed_tasks(connection, seq, coordinator.settings, SHOWN_LOST),
        "states": JobState,
        "url": coordinator.settings.url,
    }


def _elapsed(job: JobDetail, coordinator: Coordinator) -> float | None:
    if job.started_at is None:
        return None
    end = coordinator.clock() if job.finished_at is None else job.finished_at.timestamp()
    return end - job.started_at.timestamp()


@router.get("/ui/jobs/{job_id}/map")
def get_job_map(job_id: str, coordinator: CoordinatorDep) -> Response:
    """Show the grid of a job as maps that fill."""
    with coordinator.database.read() as connection:
        row = find_job(connection, job_id)
        spec = job_spec_adapter.validate_json(row.spec)
        if spec.sample_count > MOST_SAMPLES:
            return _page("map.html", maps=None, count=spec.sample_count)
        samples = list_samples(connection, row.seq, PageRequest(MOST_SAMPLES, None), None).items
    if len(samples) < spec.sample_count:
        return _page("map.html", maps=[], count=spec.sample_count)
    return _page("map.html", maps=grid_maps(spec, [sample.state for sample in samples]), count=spec.sample_count)


@router.post("/ui/jobs/{job_id}/{verb}")
def change_job(job_id: str, verb: str, coordinator: CoordinatorDep) -> Response:
    """Pause, resume or cancel a job, or submit its spec again; answer with where to go."""
    if verb == "resubmit":
        with coordinator.database.read() as connection:
            spec = job_spec_adapter.validate_json(find_job(connection, job_id).spec)
        made = coordinator.submit(spec, None)
        assert isinstance(made, JobDetail)  # there is no key, and so no replay
        job_id = made.id
    elif verb in ("pause", "resume", "cancel"):
        {"pause": coordinator.pause, "resume": coordinator.resume, "cancel": coordinator.cancel}[verb](job_id)
    else:
        raise NotFoundError(f"a job has no verb {verb[:50]!r}")
    return Response(status_code=204, headers={"HX-Redirect": f"/jobs/{job_id}"})


@router.get("/ui/changes")
def get_changes(coordinator: CoordinatorDep) -> StreamingResponse:
    """Tell a page that something has changed, at most once a second; nothing is read for it."""
    return StreamingResponse(
        _changes(coordinator), headers={"Cache-Control": "no-store"}, media_type="text/event-stream"
    )


async def _changes(coordinator: Coordinator) -> AsyncIterator[bytes]:
    yield b"retry: 2000\n\n"
    told = -1  # the first message comes at once: something may have changed since the page was made
    while True:
        await coordinator.bell.wait(told, 15.0)
        rung = coordinator.bell.rung
        yield b": still here\n\n" if rung == told else b"event: change\ndata: {}\n\n"
        told = rung
        await asyncio.sleep(CHANGE_SECONDS)


# --- datasets -------------------------------------------------------------------------------------------------


@router.get("/datasets")
def get_datasets(coordinator: CoordinatorDep) -> Response:
    """Show the datasets."""
    with coordinator.database.read() as connection:
        datasets = list_datasets(connection, PageRequest(100, None)).items
    return _page("datasets.html", here="datasets", datasets=datasets)


@router.get("/datasets/{dataset}")
def get_dataset(dataset: str, coordinator: CoordinatorDep) -> Response:
    """Go to the newest version of a dataset."""
    with coordinator.database.read() as connection:
        versions = find_dataset(connection, dataset).versions
    if not versions:
        raise NotFoundError(f"dataset {dataset} has no version yet")
    return RedirectResponse(f"/datasets/{dataset}/v{versions[-1].version}")


@router.get("/datasets/{dataset}/v{version}")
def get_version(request: Request, dataset: str, version: Version, coordinator: CoordinatorDep) -> Response:
    """Show a version."""
    found, committed, data = _open(coordinator, dataset, version)
    context = _thumbs(data, request.query_params, 0)
    return _page(
        "dataset.html",
        here="datasets",
        dataset=found,
        version=committed,
        manifest=data.manifest,
        sliders=_sliders(data.manifest.spec),
        histograms=_histograms(data),
        splits=SPLITS,
        file_count=None if data.manifest.sections else len(data.manifest.files) + 3,
        card=_listed(data, "README.md"),
        picture=_listed(data, "preview.webp"),
        url=coordinator.settings.url,
        **context,
    )


def _listed(data: SampleData, path: str) -> str | None:
    """Return the path of a file of a version, None where it has none of that name."""
    return None if data.contents.file(path) is None else path


@router.get("/ui/datasets/{dataset}/v{version}/thumbs")
def get_thumbs(
    request: Request,
    dataset: str,
    version: Version,
    coordinator: CoordinatorDep,
    start: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> Response:
    """Show the samples that the sliders leave."""
    found, committed, data = _open(coordinator, dataset, version)
    return _page("thumbs.html", dataset=found, version=committed, **_thumbs(data, request.query_params, start))


def _open(coordinator: Coordinator, dataset: str, version: int) -> tuple[Dataset, DatasetVersion, SampleData]:
    with coordinator.database.read() as connection:
        found, committed = find_dataset(connection, dataset), find_version(connection, dataset, version)
    return found, committed, _sample_data(coordinator.store, committed.manifest)


@lru_cache(maxsize=8)
def _sample_data(store: Store, manifest: str) -> SampleData:
    return SampleData(store, read_contents(store, manifest))


def _sliders(spec: JobSpec) -> list[dict[str, Any]]:
    """Return the axes with more than one value: their names and, by place, their values."""
    columns: dict[str, set[Any]] = {name: set() for name in spec.named_axes}
    for point in islice(grid(spec), MOST_SAMPLES):
        for name, value in point.items():
            columns[name].add(value)
    return [{"name": name, "values": sorted(values)} for name, values in columns.items() if len(values) > 1]


def _thumbs(data: SampleData, query: Mapping[str, str], start: int) -> dict[str, Any]:
    """Return the samples whose axes lie between the sliders (`NAME.from`, `NAME.to`: places among the values)."""
    wanted: dict[str, set[Any]] = {}
    for axis in _sliders(data.manifest.spec):
        values = axis["values"]
        places = [query.get(f"{axis['name']}.{end}", "") for end in ("from", "to")]
        first, last = (int(place) if place.isdecimal() and len(place) < 9 else None for place in places)
        wanted[axis["name"]] = set(values[first or 0 : len(values) if last is None else last + 1])
    lost = data.rejections(MOST_SAMPLES)
    chosen = [
        (slot, point)
        for slot, point in enumerate(islice(grid(data.manifest.spec), MOST_SAMPLES))
        if all(point[name] in values for name, values in wanted.items())
    ]
    shown = chosen[start : start + SHOWN_THUMBS]
    keep = {name: value for name, value in query.items() if name != "start"}
    return {
        "thumbs": [(slot, point, lost.get(slot)) for slot, point in shown],
        "chosen": len(chosen),
        "next_start": start + SHOWN_THUMBS if start + SHOWN_THUMBS < len(chosen) else None,
        "kept_query": keep,
        "varying": {axis["name"] for axis in _sliders(data.manifest.spec)},
        "pictured": _pictured(data),
        "picture_index": _telling_picture(data),
    }


def _pictured(data: SampleData) -> str | None:
    """Return the array that holds pictures."""
    return next((name for name, array in data.arrays.items() if array.dimensions[-3:] == ("y", "x", "rgb")), None)


def _telling_picture(data: SampleData) -> int:
    """Return which picture stands for a sample: the middle of a clip, the first of several views."""
    name = _pictured(data)
    array = None if name is None else data.arrays[name]
    return array.shape[0] // 2 if array is not None and array.dimensions[0] == "frame" else 0


def _histograms(data: SampleData) -> list[dict[str, Any]]:
    """Return the distributions of the labels that are not axes, over the valid samples."""
    valid = data.label("valid").astype(bool)
    shown = []
    for name, array in data.arrays.items():
        is_axis = name in data.manifest.spec.named_axes
        is_number = not (array.dtype == "bool" or name in ("split", "valid") or name.endswith("_seed"))
        if array.shape or is_axis or array.per_sample or not is_number:
            continue
        values = np.asarray(data.label(name), dtype=float)
        values = values[np.isfinite(values) & valid]
        if array.categories or values.size < 2 or values.min() == values.max():
            continue
        counts, bounds = np.histogram(values, bins=min(20, max(5, values.size // 4)))
        top = max(int(counts.max()), 1)
        bars = [(int(count), 100 * count / top, bounds[i], bounds[i + 1]) for i, count in enumerate(counts)]
        shown.append({"name": name, "text": array.description, "bars": bars})
    return shown


# --- samples --------------------------------------------------------------------------------------------------


@router.get("/datasets/{dataset}/v{version}/samples/{slot}")
def get_sample(dataset: str, version: Version, slot: int, coordinator: CoordinatorDep) -> Response:
    """Show a sample: its pictures, curves, shape and labels."""
    found, committed, data = _open(coordinator, dataset, version)
    manifest = data.manifest
    if not 0 <= slot < manifest.sample_count:
        raise NotFoundError(f"version {version} of {dataset} has slots 0 to {manifest.sample_count - 1}, not {slot}")
    rejection = data.rejection(slot)
    return _page(
        "sample.html",
        here="datasets",
        dataset=found,
        version=committed,
        slot=slot,
        last_slot=manifest.sample_count - 1,
        rejection=rejection,
        **({"pictures": [], "plots": [], "shapes": [], "labels": {}} if rejection else _sample(data, slot)),
    )


def _sample(data: SampleData, slot: int) -> dict[str, Any]:
    pictures, plots, shapes = [], [], []
    labels: dict[str, tuple[object, str]] = {}
    for name, array in data.arrays.items():
        dimensions = array.dimensions
        if dimensions[-3:] == ("y", "x", "rgb"):
            pictures.append({"name": name, "count": array.shape[0], "is_clip": dimensions[0] == "frame"})
        elif dimensions[-1:] == ("xyz",) and len(array.shape) in (2, 3) and dimensions[-2] in ("point", "vertex"):
            shapes.append({"name": name, "steps": array.shape[0] if len(array.shape) == 3 else 1})
        elif dimensions[:1] in (("point",), ("instant",)) and len(array.shape) == 2 and array.shape[1] <= 4:
            plots.append(_plot(data, name, slot))
        elif len(array.shape) <= 1 and name != "sample_key" and (not array.shape or array.shape[0] <= 8):
            labels[name] = (data.named(array, data.read(name, slot)), array.description)
    axes = [name for name in data.manifest.spec.named_axes if name in labels]
    labels = {name: labels[name] for name in (*axes, *(name for name in labels if name not in axes))}
    return {"pictures": pictures, "plots": plots, "shapes": shapes, "labels": labels}


_COMPONENTS = {"strain": ("twist", "bend 1", "bend 2"), "xyz": ("x", "y", "z")}


def _plot(data: SampleData, name: str, slot: int) -> str:
    array = data.arrays[name]
    values = np.asarray(data.read(name, slot), dtype=float)
    parts = _COMPONENTS.get(array.dimensions[1], tuple(str(i) for i in range(array.shape[1])))
    rate = array.attributes.get("instants_per_second")
    x, x_name = np.linspace(0, 1, len(values)), "arc length over L"
    if rate is not None:
        x, x_name = np.arange(len(values)) / rate, "time [s]"
    curves = {part: list(zip(x.tolist(), values[:, i].tolist(), strict=True)) for i, part in enumerate(parts)}
    return line_plot(curves, x_name=x_name, y_name=f"{name}: {array.description}")


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}/{index}.png")
def get_picture(
    dataset: str,
    version: Version,
    slot: Annotated[int, Path(ge=0)],
    array: str,
    index: Annotated[int, Path(ge=0)],
    coordinator: CoordinatorDep,
    step: Annotated[int, Query(ge=1, le=8)] = 1,
) -> Response:
    """Return one picture of a sample; with `step`, every so many pixels."""
    _, _, data = _open(coordinator, dataset, version)
    values = _value(data, array, slot)
    if values.ndim != 4 or index >= len(values):
        raise NotFoundError(f"{array} has no picture {index}")
    content = png(np.ascontiguousarray(values[index][::step, ::step]))
    return Response(content, media_type="image/png", headers={"Cache-Control": "private, max-age=86400"})


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}.json")
def get_values(
    dataset: str, version: Version, slot: Annotated[int, Path(ge=0)], array: str, coordinator: CoordinatorDep
) -> Response:
    """Return the points of a shape by step, (step, point, xyz), and the triangles where there are any."""
    _, _, data = _open(coordinator, dataset, version)
    values = np.asarray(_value(data, array, slot), dtype=np.float32)
    steps = values if values.ndim == 3 else values[None]
    chosen = np.linspace(0, len(steps) - 1, min(len(steps), 60)).astype(int)
    document: dict[str, Any] = {"points": np.round(steps[chosen], 4).tolist(), "steps": chosen.tolist()}
    triangles = next((name for name, other in data.arrays.items() if "triangle" in other.dimensions), None)
    if triangles is not None and data.arrays[array].dimensions[-2] == "vertex":
        document["triangles"] = data.read(triangles, slot).tolist()
    return Response(json.dumps(document), media_type="application/json")


def _value(data: SampleData, array: str, slot: int) -> Any:
    if array not in data.arrays or slot >= data.manifest.sample_count:
        raise NotFoundError(f"the dataset has no {array[:50]!r} of sample {slot}")
    try:
        return data.read(array, slot)
    except KeyError as error:
        raise NotFoundError(f"sample {slot} has no {array[:50]!r}") from error


# --- certificates and workers ---------------------------------------------------------------------------------


@router.get("/certificates")
def get_certificates(coordinator: CoordinatorDep) -> Response:
    """Show the certificates."""
    with coordinator.database.read() as connection:
        entries = list_certificates(connection, PageRequest(200, None)).items
        builds = _builds(coordinator, connection)
    return _page("certificates.html", here="certificates", entries=entries, builds=builds)


@router.get("/certificates/{digest}")
def get_certificate(digest: str, coordinator: CoordinatorDep) -> Response:
    """Show a certificate: a row for each protocol."""
    with coordinator.database.read() as connection:
        stored = find_certificate(connection, digest)
        builds = _builds(coordinator, connection)
    certificate = Certificate.model_validate_json(coordinator.store.read(stored.artifact))
    plots = {protocol.protocol: list(_curves(protocol)) for protocol in certificate.protocols}
    return _page(
        "certificate.html", here="certificates", certificate=certificate, digest=digest, builds=builds, plots=plots
    )


def _builds(coordinator: Coordinator, connection: Connection) -> set[str]:
    return {builds.sim_core for worker in coordinator.alive_workers(connection) for builds in worker.builds.values()}


def _curves(protocol: ProtocolReport) -> Iterator[str]:
    for curve in protocol.curves[:6]:
        dense = curve.dense_x, curve.dense_master
        line = dense if curve.dense_x else (curve.x, curve.master)  # of a certificate without dense curves
        name = ", ".join(f"{key} = {value:g}" for key, value in curve.parameters.items())
        yield line_plot(
            {"master curve": _known(*line)},
            dots={"measured": _known(curve.x, curve.measured)},
            x_name=protocol.x,
            y_name=f"{protocol.y}{f' ({name})' if name else ''}",
            is_log=True,
        )


def _known(x: Numbers, y: Numbers) -> list[tuple[float, float]]:
    return sorted((a, b) for a, b in zip(x, y, strict=True) if a is not None and b is not None)


@router.get("/workers")
def get_workers(coordinator: CoordinatorDep) -> Response:
    """Show the workers."""
    return _page("workers.html", here="workers", **_workers(coordinator))


@router.get("/ui/workers")
def get_workers_part(coordinator: CoordinatorDep) -> Response:
    """Show the list of workers alone."""
    return _page("workers_list.html", **_workers(coordinator))


def _workers(coordinator: Coordinator) -> dict[str, Any]:
    with coordinator.database.read() as connection:
        workers = show_workers(connection, alive_since=coordinator.alive_since, frames=coordinator.frames)
        certified = {
            entry.sim_core: entry
            for entry in reversed(list_certificates(connection, PageRequest(200, None)).items)
            if entry.extent == "full" and entry.passed
        }
    disk = coordinator.store.room()
    now = as_datetime(coordinator.clock())
    return {"workers": workers, "certified": certified, "disk": disk, "memory": _memory(), "now": now}


def _memory() -> dict[str, int] | None:
    """Return bytes of memory of this machine, `MemTotal` and `MemAvailable`; None where Linux does not tell."""
    try:
        lines = [line.split() for line in pathlib.Path("/proc/meminfo").read_text().splitlines()]
    except OSError:
        return None
    told = {line[0].rstrip(":"): 1024 * int(line[1]) for line in lines}
    return told if {"MemTotal", "MemAvailable"} <= told.keys() else None


@router.get("/docs")
def get_docs(request: Request) -> Response:
    """Show the interface; everything that it needs is here."""
    return _page("docs.html", here="docs", api=request.app.openapi())


def not_found_page(error: ProblemError) -> Response:
    """Return the page of an error."""
    return Response(render("error.html", here="", detail=error.detail), error.status, _POLICY, "text/html")
