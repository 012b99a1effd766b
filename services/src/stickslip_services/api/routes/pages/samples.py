"""The page of a sample, or of two samples beside each other, and the pictures that it loads."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from stickslip_schemas.format.pictures import png

from stickslip_services.api.artifacts import matches
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.api.routes.pages.opened import (
    PICTURE_SECONDS,
    Opened,
    OpenedDep,
    open_version,
    value_of,
)
from stickslip_services.catalog.versions import list_datasets
from stickslip_services.database.database import PageRequest
from stickslip_services.errors import NotFoundError
from stickslip_services.pages.choosing import MAX_INDEX_DIGITS
from stickslip_services.pages.comparing import common_layers, label_rows, overlaid, timeline
from stickslip_services.pages.motion import motion
from stickslip_services.pages.pictures import Range, coloured, mp4, range_of
from stickslip_services.pages.rendering import html_page
from stickslip_services.pages.sample_page import sample_view
from stickslip_services.pages.samples import Array, SampleData
from stickslip_services.queue.context import Context

router = APIRouter(include_in_schema=False)

SHOWN_DATASETS = 50
"""Newest datasets that a sample can be compared with by choosing one."""

Slot = Annotated[int, Path(ge=0)]
Step = Annotated[int, Query(ge=1, le=32)]
OtherVersion = Annotated[str, Query(max_length=100)]
"""`DATASET:vN`: the version that the sample beside another one is of; empty: the same version."""


@dataclass(frozen=True, slots=True)
class Neighbour:
    """The sample beside another one, with which it shares a scale."""

    data: SampleData
    slot: int
    tag: str
    """Names it in an ETag."""


def _neighbour(
    opened: OpenedDep,
    context: ContextDep,
    beside: Annotated[int | None, Query(ge=0)] = None,
    of: OtherVersion = "",
) -> Neighbour | None:
    if beside is None:
        return None
    other = _other(opened, of, context)
    return Neighbour(other.data, beside, f"{other.version.manifest[:32]}-{beside}")


NeighbourDep = Annotated[Neighbour | None, Depends(_neighbour)]


@dataclass(frozen=True, slots=True)
class ShownSample:
    """A sample of a page that shows one or two."""

    opened: Opened
    slot: int

    @property
    def path(self) -> str:
        """The address of its version, below the roots of pages and of the API."""
        return f"/datasets/{self.opened.dataset.id}/v{self.opened.version.version}"

    def check(self) -> None:
        """Raise NotFoundError if the version has no such slot."""
        last = self.opened.data.manifest.sample_count - 1
        if not 0 <= self.slot <= last:
            name = f"version {self.opened.version.version} of {self.opened.dataset.id}"
            raise NotFoundError(f"{name} has slots 0 to {last}, not {self.slot}")

    def view(self, compared: Sequence["ShownSample"]) -> dict[str, Any]:
        """Return what the page shows of it, beside the other one of `compared`."""
        versions = {sample.path for sample in compared}
        query = ""
        for other in compared:
            if other is not self:
                query = f"?beside={other.slot}"
                query += "" if other.path == self.path else f"&of={other.place}"
        title = f"sample {self.slot}"
        if len(versions) > 1:
            dataset = self.opened.dataset
            title += f" of {dataset.name or dataset.id}, version {self.opened.version.version}"
        return {
            **sample_view(self.opened.data, self.slot),
            "title": title,
            "path": self.path,
            "query": query,
            "files": f"/datasets/{self.opened.dataset.id}/versions/"
            f"{self.opened.version.version}/files",
        }

    @property
    def place(self) -> str:
        """Its version, as queries name it."""
        return f"{self.opened.dataset.id}:v{self.opened.version.version}"


@router.get("/datasets/{dataset}/v{version}/samples/{slot}")
def get_sample(
    opened: OpenedDep,
    context: ContextDep,
    slot: int,
    beside: Annotated[str, Query(max_length=20)] = "",
    of: OtherVersion = "",
) -> Response:
    """Show the pictures, curves, shapes and labels of a sample, or of two samples side by side."""
    compared = [ShownSample(opened, slot)]
    if beside.isdecimal():
        compared.append(ShownSample(_other(opened, of, context), int(beside)))
    for sample in compared:
        sample.check()
    # A rejected sample has labels of its rejection, and no arrays.
    rejections = [sample.opened.data.rejection(sample.slot) for sample in compared]
    valid = [sample for sample, lost in zip(compared, rejections, strict=True) if lost is None]
    views = [sample.view(valid) for sample in valid]
    return html_page(
        "sample.html",
        here="datasets",
        dataset=opened.dataset,
        version=opened.version,
        jobs=opened.jobs,
        slot=slot,
        last_slot=opened.data.manifest.sample_count - 1,
        beside=beside,
        of=of,
        others=_other_versions(context, opened, of),
        rejections=[rejection for rejection in rejections if rejection is not None],
        views=views,
        time=timeline(views) if views else None,
        layers=common_layers(views),
        labels=label_rows(views),
        plots=overlaid(views) if views else [],
        has_mp4=find_spec("av") is not None,
    )


def _other(opened: Opened, of: str, context: Context) -> Opened:
    """Return the version that a query names as `DATASET:vN`; the given one for an empty text.

    Raise NotFoundError.
    """
    if not of:
        return opened
    dataset, _, number = of.partition(":v")
    if not (number.isdecimal() and len(number) <= MAX_INDEX_DIGITS):
        raise NotFoundError(f"there is no version {of!r}: write DATASET:vNUMBER")
    return open_version(dataset, int(number), context)


def _other_versions(context: Context, opened: Opened, of: str) -> list[tuple[str, str]]:
    """Return versions to compare with, each with its name: the newest of the newest datasets.

    The chosen one is among them.
    """
    with context.database.read() as connection:
        page = list_datasets(connection, PageRequest(SHOWN_DATASETS, None), "", newest_first=True)
    names: dict[str, str] = {}
    for dataset in page.items:
        if dataset.versions:
            number = dataset.versions[-1].version
            names[f"{dataset.id}:v{number}"] = f"{dataset.name or dataset.id}, version {number}"
    names.pop(f"{opened.dataset.id}:v{opened.version.version}", None)
    if of:
        names.setdefault(of, of)
    return list(names.items())


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}.mp4")
def get_film(opened: OpenedDep, neighbour: NeighbourDep, slot: Slot, array: str) -> Response:
    """Return a clip, or its ground truth, as MP4 with 10 frames a second.

    Numbers have one scale with those of the sample `beside` it, of the version `of`.
    """
    # The browser plays the film; without PyAV the page shows its frames.
    data = opened.data
    values = value_of(data, array, slot)
    if data.arrays[array].dimensions[:3] != ("frame", "y", "x"):
        raise NotFoundError(f"{array[:50]} is no clip")
    scale = _scale(values, array, neighbour)
    film = mp4(coloured(data.arrays[array], values, range(len(values)), scale))
    headers = {"Cache-Control": f"private, max-age={PICTURE_SECONDS}"}
    return Response(film, media_type="video/mp4", headers=headers)


def _scale(values: Array, array: str, neighbour: Neighbour | None) -> Range | None:
    """Return the range of an array over two samples; None if there is one sample, or no number."""
    is_number = values.dtype.kind == "f"
    if neighbour is None or not is_number:
        return None
    beside = value_of(neighbour.data, array, neighbour.slot)
    ranges = [range_of(values), range_of(beside)]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/{array}/{index}.png")
def get_picture(
    opened: OpenedDep,
    neighbour: NeighbourDep,
    slot: Slot,
    array: str,
    index: Annotated[int, Path(ge=0)],
    request: Request,
    step: Step = 1,
) -> Response:
    """Return a picture or a frame of ground truth of a sample as PNG.

    `step` takes every `step`-th pixel.
    """
    data = opened.data
    # Without the name of the array, which is in the address.
    scaled_with = neighbour.tag if neighbour else ""
    tag = f'"{opened.version.manifest[:32]}-{slot}-{index}-{step}-{scaled_with}"'
    headers = {"Cache-Control": f"private, max-age={PICTURE_SECONDS}", "ETag": tag}
    if matches(request.headers.get("if-none-match"), tag):
        return Response(status_code=304, headers=headers)
    values = value_of(data, array, slot)
    if data.arrays[array].dimensions[1:3] != ("y", "x") or index >= len(values):
        raise NotFoundError(f"{array[:50]} has no picture {index}")
    scale = _scale(values, array, neighbour)
    (picture,) = coloured(data.arrays[array], values, [index], scale)
    content = png(picture[::step, ::step])
    return Response(content, media_type="image/png", headers=headers)


@router.get("/ui/datasets/{dataset}/v{version}/samples/{slot}/motion.json")
def get_motion(opened: OpenedDep, slot: Slot) -> Response:
    """Return what the view of a sample in three dimensions draws, as JSON."""
    try:
        if slot >= opened.data.manifest.sample_count:
            raise KeyError(slot)
        document = motion(opened.data, slot)
    except KeyError as error:
        name = f"version {opened.version.version} of {opened.dataset.id}"
        raise NotFoundError(f"{name} has no shape of a sample {slot}") from error
    return Response(json.dumps(document, allow_nan=False), media_type="application/json")
