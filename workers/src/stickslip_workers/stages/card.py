"""The dataset card, `README.md` of a dataset version, and its preview.

The card is for people who find only the directory. The preview has some samples in one picture.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from stickslip_schemas.format.codecs import decode_sample
from stickslip_schemas.format.manifest import Manifest, layout
from stickslip_schemas.format.pictures import labelled, moving, sheet
from stickslip_schemas.spec.arrays import ArrayLayout, shown_frames
from stickslip_schemas.spec.axes import AnyAxis, ListAxis
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.reality import Reality, Subject, measured_fabrics, reality

CARD_NAME = "README.md"
PREVIEW_NAME = "preview.webp"
SHOWN_VALUES = 12
"""The most values of an axis that the card lists."""

SHOWN_SAMPLES = 12
"""The most samples in the preview."""

FRAMES = 20
"""The most instants in the preview."""

_COLUMNS = 4
_SIDE = 120
"""Side of a picture in the preview [px]."""


def card(manifest: Manifest) -> bytes:
    """Return the card of a version.

    It describes the contents of the version and their making, and how to read, check and cite it.
    """
    spec = manifest.spec
    name = f"{manifest.dataset}:v{manifest.version}"
    document = spec.model_dump(mode="json", exclude_defaults=True) | {"kind": spec.kind}
    arrays = layout(spec)
    example = next((array for array in arrays if array.per_sample), arrays[0])
    where = (
        ", the most of them in its sections, `manifest/0.json` and so on"
        if manifest.sections
        else ""
    )
    sections = [
        f"# {spec.name or manifest.dataset}",
        f"{(type(spec).__doc__ or spec.kind).strip().splitlines()[0]}",
        f"Dataset `{name}`, made by stickslip: {manifest.sample_count} samples, "
        f"{manifest.valid_count} of them valid.",
        *(
            [f"![Some of the samples]({PREVIEW_NAME})"]
            if PREVIEW_NAME in {file.path for file in manifest.files}
            else []
        ),
        "## Parameters",
        f"The samples are the {_COMBINED[spec.combine]} of these axes.",
        _table(
            ("axis", "values", "unit and meaning"),
            [_axis_row(spec, *item) for item in spec.named_axes.items()],
        ),
        "## Splits",
        _table(
            ("split", "valid samples"),
            [(split, str(n)) for split, n in manifest.split_counts.items()],
        ),
        "All renders of one simulation are in the same split.",
        "## Arrays",
        "The first dimension of every array is `sample`; its index is the slot of the sample.",
        _table(
            ("array", "shape of a sample", "type", "meaning"),
            [_array_row(array) for array in arrays],
        ),
        "## Rejected samples",
        _rejected(manifest),
        "## How it was made",
        _table(("part", "build (SHA-256 of its code)"), list(manifest.builds.model_dump().items())),
        _certificate(manifest),
        *_pictures(manifest),
        *_against_measurements(spec.subject),
        f"The spec, whose digest is `{manifest.spec_digest}`:",
        f"```json\n{json.dumps(document, indent=2)}\n```",
        "## How to read it",
        "Any Zarr v3 reader opens this directory:",
        '```python\nimport zarr\n\ngroup = zarr.open_group(".", mode="r")\n'
        f'valid = group["valid"][:]\nsample = group["{example.name}"][int(valid.argmax())]\n```',
        "Read `valid` first: a rejected sample keeps its slot and holds fill values. The reader of "
        "stickslip checks every file against `manifest.json` and raises an error where one is "
        "missing or damaged:",
        "```python\nfrom stickslip_training.data.samples import Samples\n\n"
        'train = Samples(".", "train")\n```',
        "## How to check it",
        "`sha256sum --check manifest.sha256` checks the manifest, which lists the SHA-256 of every "
        f"other file{where}. `stickslip verify .` checks all files.",
        "## How to cite it",
        f"Write `{name}` and the SHA-256 of `manifest.json`, which stands in `manifest.sha256`.",
    ]
    return ("\n\n".join(sections) + "\n").encode()


_COMBINED = {"product": "product (every combination)", "zip": "rows (the axes go together)"}


def _axis_row(spec: Any, name: str, axis: AnyAxis) -> tuple[str, str, str]:
    described = {array.name: array.description for array in layout(spec)}
    return f"`{name}`", _values(axis), described.get(name, "")


def _values(axis: AnyAxis) -> str:
    if not isinstance(axis, ListAxis):
        low, high = (axis.start, axis.stop) if axis.type == "linspace" else (axis.low, axis.high)
        return f"{axis.num} from {low:g} to {high:g} ({axis.type})"
    text = ", ".join(str(value) for value in axis.values[:SHOWN_VALUES])
    return text if axis.num <= SHOWN_VALUES else f"{text} and {axis.num - SHOWN_VALUES} more"


def _array_row(array: Any) -> tuple[str, str, str, str]:
    shape = (
        ", ".join(
            f"{name} {size}" for name, size in zip(array.dimensions, array.shape, strict=True)
        )
        or "one value"
    )
    codes = f"; codes: {', '.join(f'{code} {name}' for code, name in enumerate(array.categories))}"
    meaning = array.description + (codes if array.categories else "")
    return f"`{array.name}`", shape, array.dtype, meaning


def _rejected(manifest: Manifest) -> str:
    if not manifest.rejection_counts:
        return "None: every sample of the grid is valid."
    reasons = Counter(manifest.rejection_counts)
    return _table(
        ("reason", "samples"), [(reason, str(count)) for reason, count in reasons.most_common()]
    )


def _certificate(manifest: Manifest) -> str:
    if manifest.certificate is None:
        return "No certificate vouches for the physics of this build and preset."
    preset = manifest.spec.certified_preset
    return (
        f"The certificate `{manifest.certificate}` vouches for this build and the preset "
        f"`{preset}`."
    )


def _against_measurements(subject: Subject | None) -> list[str]:
    """Return the comparison of the model with measurements, and what it leaves out."""
    if subject is None:
        return []
    facts = reality()
    missing = [(item.missing, item.size) for item in facts.missing_of(subject)]
    return [
        f"### Against measurements, of {facts.date}",
        "The certificate compares the solver with formulas. These facts compare the model with "
        "real things; no run of the service measures them.",
        *_COMPARED[subject](facts),
        "### What the model leaves out",
        _table(("missing", "size"), missing),
    ]


def _compared_cloth(facts: Reality) -> list[str]:
    rows = [
        (
            f"`{name}`",
            f"{fabric.bending_length[0]:g}, {fabric.bending_length[1]:g}",
            f"{fabric.drape:.0f}",
        )
        for name, fabric in measured_fabrics().items()
    ]
    bands = [f"{band.name} {band.low:g} to {band.high:g} ({band.source})" for band in facts.bands]
    return [
        "A label `mu` is the mu of this model. A built-in fabric is one specimen.",
        _table(("fabric", "bending length, warp and weft [mm]", "drape [%]"), rows),
        f"Drape: {facts.drape_source}. Published drape coefficients [%]: {'; '.join(bands)}.",
    ]


def _compared_rods(facts: Reality) -> list[str]:
    rows = [(f"{fit.length:g}", f"{fit.bending_length:g} +- {fit.error:g}") for fit in facts.yarn]
    return [
        _table(("overhang of a yarn [mm]", "fitted bending length [mm]"), rows),
        f"Source: {facts.yarn_source}; {facts.yarn_meaning}.",
    ]


_COMPARED: Mapping[Subject, Callable[[Reality], list[str]]] = MappingProxyType(
    {"cloth": _compared_cloth, "rods": _compared_rods}
)


def _pictures(manifest: Manifest) -> list[str]:
    pictures = manifest.pictures
    if pictures is None:
        return []
    text = f"The pictures have the quality `{pictures.quality}`."
    if pictures.device != "cpu":
        text += f" They were rendered on a GPU ({pictures.device})."
    if pictures.psnr:
        numbers = []
        for region, psnr in pictures.psnr.items():
            deviation = f"with a deviation of {psnr.deviation:.1f}"
            numbers.append(f"{region} {psnr.median:.1f} ({psnr.worst:.1f}) {deviation}")
        regions = "; ".join(numbers)
        text += f" PSNR of its clips [dB], the median, and in brackets what 99 % exceed: {regions}."
    if pictures.frame_share is not None:
        text += f" The cloth fills {100 * pictures.frame_share:.1f} % of a frame, in the mean."
    return [text]


def _table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header)]
    for row in rows:
        # A bar in a cell would end the cell.
        lines.append(tuple(cell.replace("|", "\\|") for cell in row))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def pictured(spec: JobSpec) -> ArrayLayout | None:
    """Return the array that shows a dataset of `spec` best, or None if it has no pictures."""
    pictured_arrays = (
        array
        for array in layout(spec)
        if array.per_sample and array.dimensions[-3:] == ("y", "x", "rgb")
    )
    return next(pictured_arrays, None)


def preview(
    spec: JobSpec, array: ArrayLayout, valid: Sequence[int], chunk: Callable[[int], bytes]
) -> bytes | None:
    """Return a WebP of valid slots, evenly spread, with the values of their axes.

    Return None without a valid slot. `chunk` returns the encoded chunk of a slot. A clip moves. A
    sample of several views shows the first view.
    """
    if not valid:
        return None
    slots = [valid[place] for place in shown_frames(min(SHOWN_SAMPLES, len(valid)), len(valid))]
    points = {slot: point for slot, point in enumerate(spec.grid()) if slot in slots}
    tiles = []
    for slot in slots:
        pictures = np.empty(array.shape, dtype=np.uint8)
        decode_sample(array, chunk(slot), pictures)
        part = spec.picture_part(points[slot])
        if part is not None:
            pictures = pictures[:, : part[1], : part[0]]
        count = min(FRAMES, len(pictures)) if array.is_clip else 1
        varied = {
            name: value for name, value in points[slot].items() if spec.named_axes[name].num > 1
        }
        tiles.append(
            labelled(pictures[list(shown_frames(count, len(pictures)))], text_of(varied), _SIDE)
        )
    return moving(sheet(tiles, _COLUMNS), quality=50)


def text_of(values: Mapping[str, object]) -> str:
    """Return the values of axes as a label of a picture."""
    return " ".join(
        f"{value:.3g}" if isinstance(value, float) else str(value) for value in values.values()
    )
