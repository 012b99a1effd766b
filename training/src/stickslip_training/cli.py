"""The command `stickslip-train`."""

import importlib.util
import json
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table
from stickslip_schemas.samples import SPLITS

from stickslip_training.errors import DatasetError
from stickslip_training.reader import DatasetReader
from stickslip_training.reconstruct_command import reconstruct

if TYPE_CHECKING:
    from stickslip_training.train_curvature import MethodReport, TrainingReport

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Read stickslip datasets and train on them.")
app.command()(reconstruct)

DatasetArgument = Annotated[
    str, typer.Argument(metavar="DATASET", help="directory or URL of a dataset version, .../versions/1")
]

_SECONDS_BETWEEN_LINES = 5.0  # epochs of a small dataset take less


@app.command()
def info(
    dataset: DatasetArgument,
    verify: Annotated[bool, typer.Option("--verify", help="check the SHA-256 of every file first")] = False,
) -> None:
    """Say what is in a dataset."""
    with _errors_told(), DatasetReader(dataset, verify=verify) as reader:
        console = Console()
        manifest = reader.manifest
        facts = Table.grid(padding=(0, 2))
        facts.add_row("dataset", f"{manifest.dataset}, version {manifest.version}, {reader.kind}")
        facts.add_row("spec", f"{manifest.spec_digest}")
        facts.add_row("certificate", manifest.certificate or "none: the physics of this build is not vouched for")
        counts = ", ".join(f"{manifest.split_counts.get(split, 0)} {split}" for split in SPLITS)
        facts.add_row("samples", f"{manifest.valid_count} of {manifest.sample_count} valid: {counts}")
        reasons = Counter(str(rejection.reason) for rejection in manifest.rejections)
        told = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        facts.add_row("acceptance", f"{manifest.acceptance_rate:.1%}" + (f"; rejected: {told}" if told else ""))
        facts.add_row("files", f"{len(manifest.files)}, {_megabytes(manifest.size)}" + (", verified" if verify else ""))
        console.print(facts)
        sizes: Counter[str] = Counter()
        for file in manifest.files:
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


@app.command()
def curvature(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="directory for the model, the report and the picture")],
    minutes: Annotated[float | None, typer.Option(help="time for training [min]; 1 if --epochs is not given")] = None,
    epochs: Annotated[int | None, typer.Option(help="passes over the training rods, instead of a time")] = None,
    noise: Annotated[float, typer.Option(help="noise on every coordinate, standard deviation over L")] = 0.005,
    seed: Annotated[int, typer.Option()] = 0,
    batch_size: Annotated[int, typer.Option()] = 16,
    threads: Annotated[int, typer.Option(help="of torch")] = 2,
    device: Annotated[str, typer.Option(help="of torch: cpu, cuda")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="go on from the checkpoint in --out")] = False,
) -> None:
    """Train the network that estimates curvature from a noisy centreline, and compare it with no learning."""
    from stickslip_training.train_curvature import CurvatureTraining, EpochReport, train_curvature

    console = Console()
    told = -math.inf

    def tell(epoch: EpochReport) -> None:
        nonlocal told
        if epoch.seconds < told + _SECONDS_BETWEEN_LINES:
            return
        told = epoch.seconds
        validation = "" if epoch.validation_loss is None else f", validation {epoch.validation_loss:.3f}"
        console.print(f"epoch {epoch.epoch}: loss {epoch.train_loss:.3f}{validation} rad, {epoch.seconds:.0f} s")

    with _errors_told():
        config = CurvatureTraining(
            dataset=dataset,
            out=out,
            minutes=1.0 if minutes is None and epochs is None else minutes,
            epochs=epochs,
            noise=noise,
            seed=seed,
            batch_size=batch_size,
            threads=threads,
            device=device,
        )
        report = train_curvature(config, resume=resume, on_epoch=tell)
        console.print(_results(report))
        for note in report.notes:
            console.print(f"Note: {note}")
        written = ["report.json", "model.pt", "checkpoint.pt"]
        if importlib.util.find_spec("matplotlib") is None:
            console.print("No picture: pip install 'stickslip-training[plots]' for one.")
        else:
            from stickslip_training.plots import plot_curvature

            plot_curvature(config, report, out / "curvature.png")
            written.append("curvature.png")
        console.print(f"{out}: {', '.join(written)}", soft_wrap=True)


@app.command("local-global")
def local_global(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="directory for the network and the report")],
    steps: Annotated[int, typer.Option(help="of training; 1000 take 40 CPU seconds")] = 12_000,
    noise: Annotated[tuple[float, float], typer.Option(help="least and largest white noise, over L")] = (2e-4, 1e-2),
    reconstruction: Annotated[
        Path | None,
        typer.Option(help="npz of `benchmarks/reconstruction.py --save`: a fifth of the rods get its noise"),
    ] = None,
    judged_at: Annotated[float, typer.Option(help="white noise on the test rods, over L")] = 0.005,
    seed: Annotated[int, typer.Option()] = 0,
    threads: Annotated[int, typer.Option(help="of torch")] = 1,
) -> None:
    """Train the network that pools local and global features, with fresh noise at every step."""
    from stickslip_training.local_global_training import (
        LocalGlobalTraining,
        StepReport,
        save_local_global,
        train_local_global,
    )
    from stickslip_training.noise import ReconstructionNoise
    from stickslip_training.train_curvature import CurvatureTraining, evaluate, load_splits

    console = Console()

    def tell(report: StepReport) -> None:
        console.print(f"step {report.step}: loss {report.loss:.3f}, {report.seconds:.0f} CPU s")

    with _errors_told(), DatasetReader(dataset) as reader:
        settings = LocalGlobalTraining(steps=steps, noise=noise, seed=seed, threads=threads)
        test = CurvatureTraining(dataset=dataset, out=out, epochs=1, noise=judged_at, seed=seed)
        measured = None if reconstruction is None else ReconstructionNoise.load(reconstruction)
        rods, notes = load_splits(reader, test)
        train = rods["train"]
        net = train_local_global(train.centerline, train.strains, settings, reconstruction=measured, on_step=tell)
        methods, loss = evaluate(test, net, rods["test"])
        save_local_global(out / "local-global.pt", net, settings)
        report = {
            "settings": asdict(settings),
            "noise_of_test_rods": judged_at,
            "rods": {name: len(part) for name, part in rods.items()},
            "test_loss": loss,
            "methods": [asdict(method) for method in methods],
            "notes": notes,
        }
        (out / "report.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    console.print(_methods(f"|κ| of {len(rods['test'])} test rods at {judged_at:.2%} noise", "", methods))
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"{out}: local-global.pt, report.json", soft_wrap=True)


def _results(report: "TrainingReport") -> Table:
    return _methods(
        f"|κ| of {report.rods['test']} test rods at {report.config['noise']:.2%} noise",
        f"The network's loss over all three strains is {report.test_loss:.3f} rad. "
        f"It was trained for {report.seconds:.0f} s on {report.rods['train']} rods.",
        report.methods,
    )


def _methods(title: str, caption: str, methods: "tuple[MethodReport, ...]") -> Table:
    table = Table(title=title, caption=caption, caption_justify="left")
    table.add_column("method")
    for title in ("RMS of |κ| L", "error, median", "error, 90 %", "ms a rod"):
        table.add_column(title, justify="right", no_wrap=True)
    for method in methods:
        table.add_row(
            method.method,
            f"{method.rms:,.2f} rad",
            f"{method.relative_median:,.1%}",
            f"{method.relative_p90:,.1%}",
            f"{1e3 * method.seconds_per_rod:,.2f}",
        )
    return table


@contextmanager
def _errors_told() -> Iterator[None]:
    """Turn what a user can do something about into one line and the exit status 1."""
    try:
        yield
    except (DatasetError, ValueError) as error:
        Console(stderr=True).print(f"stickslip-train: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(1) from error


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count / 1e3:,.1f} kB"
