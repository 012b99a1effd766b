"""The commands `stickslip-train info` and `export`."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn
from rich.table import Table
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.spec.arrays import SPLITS

from stickslip_training.cli.errors import DatasetArgument, readable_errors
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export import formats, lerobot
from stickslip_training.export.content import Content, OnBytes, made_whole, to_directory


def info(
    dataset: DatasetArgument,
    verify: Annotated[bool, typer.Option("--verify", help="check the SHA-256 of every file first")] = False,
) -> None:
    """Say what is in a dataset."""
    with readable_errors(), DatasetReader(dataset, verify=verify) as reader:
        console = Console()
        manifest = reader.manifest
        facts = Table.grid(padding=(0, 2))
        facts.add_row("dataset", f"{manifest.dataset}, version {manifest.version}, {reader.kind}")
        facts.add_row("spec", f"{manifest.spec_digest}")
        facts.add_row("certificate", manifest.certificate or "none: the physics of this build is not vouched for")
        counts = ", ".join(f"{manifest.split_counts.get(split, 0)} {split}" for split in SPLITS)
        facts.add_row("samples", f"{manifest.valid_count} of {manifest.sample_count} valid: {counts}")
        reasons = Counter(str(rejection.reason) for rejection in reader.rejections())
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        facts.add_row("acceptance", f"{manifest.acceptance_rate:.1%}" + (f"; rejected: {counts}" if counts else ""))
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


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count / 1e3:,.1f} kB"


def export(
    dataset: DatasetArgument,
    to_hdf5: Annotated[Path | None, typer.Option("--hdf5", metavar="FILE", help="one HDF5 file")] = None,
    to_webdataset: Annotated[
        Path | None, typer.Option("--webdataset", metavar="DIR", help="tar files for WebDataset")
    ] = None,
    to_huggingface: Annotated[
        Path | None, typer.Option("--huggingface", metavar="DIR", help="Parquet files for Hugging Face datasets")
    ] = None,
    to_lerobot: Annotated[
        Path | None, typer.Option("--lerobot", metavar="DIR", help="episodes of scenes with holders for LeRobot")
    ] = None,
    to_obj: Annotated[
        Path | None, typer.Option("--obj", metavar="DIR", help="meshes of cloth, an instant each")
    ] = None,
    arrays: Annotated[str | None, typer.Option(help="arrays to take, with commas between; labels always come")] = None,
    split: Annotated[str | None, typer.Option(help="train, validation or test; without, all")] = None,
    where: Annotated[list[str] | None, typer.Option(help="a condition on a label, as in 'mu<0.5'; may repeat")] = None,
) -> None:
    """Write a dataset in a format that other libraries read. Nothing is overwritten."""
    targets = {
        "--hdf5": to_hdf5,
        "--webdataset": to_webdataset,
        "--huggingface": to_huggingface,
        "--lerobot": to_lerobot,
        "--obj": to_obj,
    }
    with readable_errors():
        given = {option: path for option, path in targets.items() if path is not None}
        if len(given) != 1:
            raise ValueError(f"an export needs one of {', '.join(targets)}, and has {', '.join(given) or 'none'}")
        [(option, target)] = given.items()
        if missing := [name for name in _NEEDED.get(option, []) if find_spec(name) is None]:
            raise ImportError(
                f"{option} needs {', '.join(missing)}, which is not installed: pip install 'stickslip-training[export]'"
            )
        selection = Selection.of_options(arrays, split, where)
        with DatasetReader(dataset) as reader:
            content = Content(reader, selection)
            with _progress(content) as on_bytes:
                if option == "--hdf5":
                    with made_whole(target) as scratch:
                        formats.write_hdf5(content, scratch, on_bytes)
                else:
                    to_directory(content, target, on_bytes, _DIRECTORIES[option])
        skipped = len(reader) - len(content.slots)
        Console(soft_wrap=True, highlight=False).print(
            f"{content.name} is in {target}: {len(content.slots)} samples"
            + (f"; {skipped} rejected or not chosen" if skipped else ""),
            markup=False,
        )


_DIRECTORIES = {
    "--webdataset": formats.write_webdataset,
    "--huggingface": formats.write_huggingface,
    "--lerobot": lerobot.write,
    "--obj": formats.write_obj,
}
_NEEDED = {"--hdf5": ["h5py"], "--huggingface": ["datasets", "pyarrow"], "--lerobot": ["av", "pandas", "pyarrow"]}


@contextmanager
def _progress(content: Content) -> Iterator[OnBytes]:
    """Show a bar on the terminal, if there is one."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=32), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        row = bar.add_task("export", total=len(content.slots) * content.sample_bytes)
        yield lambda count: bar.advance(row, count)
