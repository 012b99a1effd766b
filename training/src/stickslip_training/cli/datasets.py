"""The commands `stickslip-train info` and `stickslip-train export`."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn
from rich.table import Table
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.installation import install_hint
from stickslip_schemas.spec.arrays import SPLITS

from stickslip_training.cli.shared import DatasetArgument, readable_errors
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export import coco, formats, lerobot
from stickslip_training.export.formats import Content, OnBytes, made_whole, to_directory


def info(
    dataset: DatasetArgument,
    verify: Annotated[
        bool, typer.Option("--verify", help="check the SHA-256 of every file first")
    ] = False,
) -> None:
    """Describe a dataset: its version, samples, files and arrays."""
    with readable_errors(), DatasetReader(dataset, verify=verify) as reader:
        # The size of an array on disk is that of all files below its folder.
        sizes = Counter[str]()
        file_count = 0
        for file in reader.files():
            sizes[file.path.split("/")[0]] += file.size
            file_count += 1
        files = f"{file_count}, {decimal(sizes.total())}" + (", verified" if verify else "")
        console = Console()
        console.print(_facts(reader, files))
        console.print(_arrays(reader, sizes))


def _facts(reader: DatasetReader, files: str) -> Table:
    """Return a table of the facts about a version."""
    manifest = reader.manifest
    facts = Table.grid(padding=(0, 2))
    facts.add_row("dataset", f"{manifest.dataset}, version {manifest.version}, {reader.kind}")
    facts.add_row("spec", f"{manifest.spec_digest}")
    no_certificate = "none: the physics of this build is not vouched for"
    facts.add_row("certificate", manifest.certificate or no_certificate)

    splits = ", ".join(f"{manifest.split_counts.get(split, 0)} {split}" for split in SPLITS)
    facts.add_row("samples", f"{manifest.valid_count} of {manifest.sample_count} valid: {splits}")

    # Rounded down: 100 % means that no sample was rejected.
    acceptance = f"{math.floor(1000 * manifest.acceptance_rate) / 10:.1f}%"
    reasons = Counter(str(rejection.reason) for rejection in reader.rejections())
    if reasons:
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        acceptance += f"; rejected: {counts}"
    facts.add_row("acceptance", acceptance)
    facts.add_row("files", files)
    return facts


def _arrays(reader: DatasetReader, sizes: Counter[str]) -> Table:
    """Return a table of the arrays of a version; `sizes` are sizes on disk [bytes]."""
    arrays = Table(box=None, pad_edge=False, header_style="bold")
    for title in ("array", "type", "shape", "raw", "on disk"):
        is_size = title in ("raw", "on disk")
        arrays.add_column(title, justify="right" if is_size else "left", overflow="fold")
    arrays.add_column("description", overflow="fold")
    for array in reader.arrays.values():
        arrays.add_row(
            array.name,
            array.dtype,
            " × ".join(map(str, (len(reader), *array.shape))),
            decimal(len(reader) * array.sample_bytes),
            decimal(sizes[array.name]),
            array.description,
        )
    return arrays


Writer = Callable[[Content, Path, OnBytes], None]


@dataclass(frozen=True)
class Format:
    """A format of `export`."""

    write: Writer
    packages: tuple[str, ...] = ()
    """Packages that it needs, besides this distribution's."""
    is_file: bool = False
    """One file, and not a directory."""


FORMATS = {
    "--hdf5": Format(formats.write_hdf5, ("h5py",), is_file=True),
    "--webdataset": Format(formats.write_webdataset),
    "--huggingface": Format(formats.write_huggingface, ("datasets", "pyarrow")),
    "--coco": Format(coco.write, ("PIL",)),
    "--lerobot": Format(lerobot.write, ("av", "pandas", "pyarrow")),
    "--obj": Format(formats.write_obj),
}
"""By option."""


def export(
    dataset: DatasetArgument,
    to_hdf5: Annotated[
        Path | None, typer.Option("--hdf5", metavar="FILE", help="one HDF5 file")
    ] = None,
    to_webdataset: Annotated[
        Path | None, typer.Option("--webdataset", metavar="DIR", help="tar files for WebDataset")
    ] = None,
    to_huggingface: Annotated[
        Path | None,
        typer.Option(
            "--huggingface", metavar="DIR", help="Parquet files for Hugging Face datasets"
        ),
    ] = None,
    to_coco: Annotated[
        Path | None,
        typer.Option("--coco", metavar="DIR", help="frames with masks and boxes for COCO tools"),
    ] = None,
    to_lerobot: Annotated[
        Path | None,
        typer.Option(
            "--lerobot", metavar="DIR", help="episodes of scenes with holders for LeRobot"
        ),
    ] = None,
    to_obj: Annotated[
        Path | None, typer.Option("--obj", metavar="DIR", help="meshes of cloth, an instant each")
    ] = None,
    arrays: Annotated[
        str | None, typer.Option(help="arrays to export, with commas between; labels always come")
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="train, validation or test; without, all")
    ] = None,
    where: Annotated[
        list[str] | None, typer.Option(help="a condition on a label, as in 'mu<0.5'; may repeat")
    ] = None,
) -> None:
    """Write a dataset in a format that other libraries read. Nothing is overwritten."""
    targets = {
        "--hdf5": to_hdf5,
        "--webdataset": to_webdataset,
        "--huggingface": to_huggingface,
        "--coco": to_coco,
        "--lerobot": to_lerobot,
        "--obj": to_obj,
    }
    with readable_errors():
        option, target = _only_target(targets)
        _check_packages(option)
        selection = Selection.of_options(arrays, split, where)
        with DatasetReader(dataset) as reader:
            content = Content(reader, selection)
            with _progress(content) as on_bytes:
                if FORMATS[option].is_file:
                    with made_whole(target) as scratch:
                        FORMATS[option].write(content, scratch, on_bytes)
                else:
                    to_directory(content, target, on_bytes, FORMATS[option].write)
        line = f"{content.name} is in {target}: {len(content.slots)} samples"
        skipped = len(reader) - len(content.slots)
        if skipped:
            line += f"; {skipped} rejected or not chosen"
        Console(soft_wrap=True, highlight=False).print(line, markup=False)


def _only_target(targets: dict[str, Path | None]) -> tuple[str, Path]:
    """Return the option that is given, and its path; raise ValueError if it is not exactly one."""
    chosen = [(option, path) for option, path in targets.items() if path is not None]
    if len(chosen) != 1:
        options = ", ".join(option for option, _ in chosen) or "none"
        raise ValueError(f"an export needs one of {', '.join(targets)}, and has {options}")
    return chosen[0]


def _check_packages(option: str) -> None:
    """Raise ImportError, with the command to install them, if packages of a format are missing."""
    missing = [name for name in FORMATS[option].packages if find_spec(name) is None]
    if missing:
        raise ImportError(
            f"{option} needs {', '.join(missing)}, which is not installed: "
            + install_hint("stickslip-training", "export")
        )


@contextmanager
def _progress(content: Content) -> Iterator[OnBytes]:
    """Show a bar if the standard error is a terminal."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=32), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        row = bar.add_task("export", total=len(content.slots) * content.sample_bytes)
        yield lambda count: bar.advance(row, count)
