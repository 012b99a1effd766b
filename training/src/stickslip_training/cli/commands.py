"""The commands `stickslip-train info`, `export`, `curvature` and `reconstruct`, and what all
commands share.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn
from rich.table import Table
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.installation import install_hint
from stickslip_schemas.spec.arrays import SPLITS

from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.sources import DatasetError
from stickslip_training.export import formats, lerobot
from stickslip_training.export.formats import Content, OnBytes, made_whole, to_directory

if TYPE_CHECKING:
    from stickslip_training.engine.fit import EpochReport

_SECONDS_BETWEEN_LINES = 5.0  # epochs of a small dataset take less

DatasetArgument = Annotated[
    str,
    typer.Argument(metavar="DATASET", help="directory or URL of a dataset version, .../versions/1"),
]


@contextmanager
def readable_errors() -> Iterator[None]:
    """Turn what a user can do something about into one line and the exit status 1."""
    try:
        yield
    except (DatasetError, ValueError, OSError, ImportError) as error:
        Console(stderr=True).print(
            f"stickslip-train: {error}", style="red", soft_wrap=True, markup=False
        )
        raise typer.Exit(1) from error


def shows_epochs(console: Console, steps: int) -> "Callable[[EpochReport], None]":
    """Return what prints a line about an epoch, unless the last line was just printed."""
    shown_at = -math.inf

    def show(epoch: "EpochReport") -> None:
        nonlocal shown_at
        if epoch.seconds < shown_at + _SECONDS_BETWEEN_LINES:
            return
        shown_at = epoch.seconds
        validation = (
            "" if epoch.validation_loss is None else f", validation {epoch.validation_loss:.3f}"
        )
        console.print(
            f"step {epoch.step} of {steps}: loss {epoch.train_loss:.3f}{validation}, {epoch.seconds:.0f} s"
        )

    return show


# --- datasets
# -------------------------------------------------------------------------------------------------


def info(
    dataset: DatasetArgument,
    verify: Annotated[
        bool, typer.Option("--verify", help="check the SHA-256 of every file first")
    ] = False,
) -> None:
    """Say what is in a dataset."""
    with readable_errors(), DatasetReader(dataset, verify=verify) as reader:
        console = Console()
        manifest = reader.manifest
        facts = Table.grid(padding=(0, 2))
        facts.add_row("dataset", f"{manifest.dataset}, version {manifest.version}, {reader.kind}")
        facts.add_row("spec", f"{manifest.spec_digest}")
        facts.add_row(
            "certificate",
            manifest.certificate or "none: the physics of this build is not vouched for",
        )
        counts = ", ".join(f"{manifest.split_counts.get(split, 0)} {split}" for split in SPLITS)
        facts.add_row(
            "samples", f"{manifest.valid_count} of {manifest.sample_count} valid: {counts}"
        )
        reasons = Counter(str(rejection.reason) for rejection in reader.rejections())
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        facts.add_row(
            "acceptance",
            f"{manifest.acceptance_rate:.1%}" + (f"; rejected: {counts}" if counts else ""),
        )
        files, sizes = list(reader.files()), Counter[str]()
        for file in files:
            sizes[file.path.split("/")[0]] += file.size
        facts.add_row(
            "files", f"{len(files)}, {decimal(sizes.total())}" + (", verified" if verify else "")
        )
        console.print(facts)
        arrays = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("array", "type", "shape", "raw", "on disk", "what"):
            arrays.add_column(title, justify="right" if title in ("raw", "on disk") else "left")
        for array in reader.arrays.values():
            arrays.add_row(
                array.name,
                array.dtype,
                " × ".join(map(str, (len(reader), *array.shape))),
                decimal(len(reader) * array.sample_bytes),
                decimal(sizes[array.name]),
                array.description,
            )
        console.print(arrays)


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
        str | None, typer.Option(help="arrays to take, with commas between; labels always come")
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
        "--lerobot": to_lerobot,
        "--obj": to_obj,
    }
    with readable_errors():
        given = {option: path for option, path in targets.items() if path is not None}
        if len(given) != 1:
            raise ValueError(
                f"an export needs one of {', '.join(targets)}, and has {', '.join(given) or 'none'}"
            )
        [(option, target)] = given.items()
        if missing := [name for name in _NEEDED.get(option, []) if find_spec(name) is None]:
            raise ImportError(
                f"{option} needs {', '.join(missing)}, which is not installed: "
                + install_hint("stickslip-training", "export")
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
_NEEDED = {
    "--hdf5": ["h5py"],
    "--huggingface": ["datasets", "pyarrow"],
    "--lerobot": ["av", "pandas", "pyarrow"],
}


@contextmanager
def _progress(content: Content) -> Iterator[OnBytes]:
    """Show a bar on the terminal, if there is one."""
    console = Console(stderr=True)
    columns = (BarColumn(bar_width=32), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        row = bar.add_task("export", total=len(content.slots) * content.sample_bytes)
        yield lambda count: bar.advance(row, count)


# --- rods
# -----------------------------------------------------------------------------------------------------


def curvature(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="directory for the model and the report")],
    steps: Annotated[
        int, typer.Option(help="of training; 1000 of 16 rods take 70 CPU seconds")
    ] = 1000,
    noise: Annotated[
        float, typer.Option(help="noise on every coordinate, standard deviation over L")
    ] = 0.005,
    seed: Annotated[int, typer.Option()] = 0,
    batch_size: Annotated[int, typer.Option()] = 16,
    threads: Annotated[int, typer.Option(help="of torch")] = 2,
    device: Annotated[str, typer.Option(help="of torch: cpu, cuda")] = "cpu",
    resume: Annotated[
        bool, typer.Option("--resume", help="go on from the checkpoint in --out")
    ] = False,
) -> None:
    """Train the network that estimates curvature from a noisy centreline, and compare it with no
    learning.
    """
    from stickslip_training.rods.curvature import CurvatureTraining, train_curvature

    console = Console()
    with readable_errors():
        config = CurvatureTraining(
            dataset=dataset,
            out=out,
            steps=steps,
            noise=noise,
            seed=seed,
            batch_size=batch_size,
            threads=threads,
            device=device,
        )
        report = train_curvature(config, resume=resume, on_epoch=shows_epochs(console, steps))
        console.print(_results(report))
        for note in report["notes"]:
            console.print(f"Note: {note}")
        console.print(f"{out}: report.json, model.pt, checkpoint.pt", soft_wrap=True)


def _results(report: dict[str, Any]) -> Table:
    rods = report["rods"]
    table = Table(
        title=f"|κ| of {rods['test']} test rods at {report['config']['noise']:.2%} noise",
        caption=f"The network's loss over all three strains is {report['test_loss']:.3f} rad. "
        f"It was trained for {report['seconds']:.0f} s on {rods['train']} rods.",
        caption_justify="left",
    )
    table.add_column("method")
    for title in ("RMS of |κ| L", "error, median", "error, 90 %", "ms a rod"):
        table.add_column(title, justify="right", no_wrap=True)
    for method in report["methods"]:
        table.add_row(
            method["method"],
            f"{method['rms']:,.2f} rad",
            f"{method['relative_median']:,.1%}",
            f"{method['relative_p90']:,.1%}",
            f"{1e3 * method['seconds_per_rod']:,.2f}",
        )
    return table


def reconstruct(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="one picture for each camera, named as the camera"),
    ],
    calibration: Annotated[Path, typer.Option(help="cameras as in the rigs of stickslip-schemas")],
    out: Annotated[
        Path, typer.Option(help="directory for the centreline, the overlay and the report")
    ],
    length: Annotated[float, typer.Option(help="of the rod, in the unit of the calibration")] = 1.0,
    clamp: Annotated[
        tuple[float, float, float], typer.Option(help="where the rod leaves its clamp")
    ] = (0, 0, 0),
    direction: Annotated[
        tuple[float, float, float], typer.Option(help="of the rod in its clamp")
    ] = (0, 0, -1),
    radius: Annotated[float | None, typer.Option(help="of the rod; found if not given")] = None,
    rig: Annotated[
        str | None, typer.Option(help="which rig of the calibration, if it has several")
    ] = None,
    points: Annotated[
        int, typer.Option(help="of the centreline, at uniform arc length", min=2)
    ] = 150,
) -> None:
    """Reconstruct the centreline of a hanging rod from photographs by calibrated cameras."""
    from stickslip_training.reconstruction.photographs import reconstruct_folder, write_results

    with readable_errors():
        result = reconstruct_folder(
            folder,
            calibration,
            length=length,
            clamp=clamp,
            direction=direction,
            rig=rig,
            points=points,
            radius=radius,
        )
        written = write_results(result, out)
    found, console = result.reconstruction, Console()
    console.print(
        f"{found.verdict}: misfit {found.misfit:.1%}, residual {found.residual_rms:.2f} px, radius {found.radius:.4g}"
    )
    for reason in found.reasons:
        console.print(f"Note: {reason}")
    console.print(f"{out}: {', '.join(written)}", soft_wrap=True)
