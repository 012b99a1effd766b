"""The commands `stickslip-train info` and `stickslip-train coco`."""

from collections import Counter
from pathlib import Path
from typing import Annotated, cast

import typer
from rich.console import Console
from rich.table import Table
from stickslip_schemas.spec.arrays import SPLITS

from stickslip_training.cli.errors import DatasetArgument, errors_told
from stickslip_training.data.coco import export_coco
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.version import Split


def info(
    dataset: DatasetArgument,
    verify: Annotated[bool, typer.Option("--verify", help="check the SHA-256 of every file first")] = False,
) -> None:
    """Say what is in a dataset."""
    with errors_told(), DatasetReader(dataset, verify=verify) as reader:
        console = Console()
        manifest = reader.manifest
        facts = Table.grid(padding=(0, 2))
        facts.add_row("dataset", f"{manifest.dataset}, version {manifest.version}, {reader.kind}")
        facts.add_row("spec", f"{manifest.spec_digest}")
        facts.add_row("certificate", manifest.certificate or "none: the physics of this build is not vouched for")
        counts = ", ".join(f"{manifest.split_counts.get(split, 0)} {split}" for split in SPLITS)
        facts.add_row("samples", f"{manifest.valid_count} of {manifest.sample_count} valid: {counts}")
        reasons = Counter(str(rejection.reason) for rejection in reader.rejections())
        told = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        facts.add_row("acceptance", f"{manifest.acceptance_rate:.1%}" + (f"; rejected: {told}" if told else ""))
        files = list(reader.files())
        size = _megabytes(sum(file.size for file in files))
        facts.add_row("files", f"{len(files)}, {size}" + (", verified" if verify else ""))
        console.print(facts)
        sizes: Counter[str] = Counter()
        for file in files:
            sizes[file.path.split("/")[0]] += file.size
        arrays = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("array", "type", "shape", "raw", "on disk", "what"):
            arrays.add_column(title, justify="right" if title in ("raw", "on disk") else "left")
        for array in reader.arrays.values():
            arrays.add_row(
                array.name,
                array.dtype,
                " × ".join(map(str, (len(reader), *array.shape))),
                _megabytes(len(reader) * array.sample_bytes),
                _megabytes(sizes[array.name]),
                array.description,
            )
        console.print(arrays)


def coco(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="directory for images/ and annotations.json")],
    every: Annotated[int, typer.Option(min=1, help="frames: the first and then every n-th of a clip")] = 1,
    split: Annotated[str | None, typer.Option(help="train, validation or test; by default all")] = None,
) -> None:
    """Write frames and segments of cloth in COCO's format; the spec must ask for `ground_truth: [segmentation]`."""
    if split is not None and split not in SPLITS:
        raise typer.BadParameter(f"must be one of {', '.join(SPLITS)}; got {split!r}", param_hint="--split")
    with errors_told(), DatasetReader(dataset) as reader:
        images, annotations = export_coco(reader, out, every=every, split=cast(Split | None, split))
        Console().print(f"{images} images, {annotations} segments in {out}")


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count / 1e3:,.1f} kB"
