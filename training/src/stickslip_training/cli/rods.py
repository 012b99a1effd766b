"""The commands `stickslip-train curvature` and `stickslip-train reconstruct`."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from stickslip_training.cli.shared import DatasetArgument, readable_errors, report_epochs


def curvature(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="directory for the model and the report")],
    steps: Annotated[
        int, typer.Option(help="of training; a step of 16 rods takes 0.15 CPU s")
    ] = 1000,
    noise: Annotated[
        float, typer.Option(help="noise on every coordinate, standard deviation over L")
    ] = 0.005,
    seed: Annotated[int, typer.Option()] = 0,
    batch_size: Annotated[int, typer.Option()] = 16,
    threads: Annotated[int, typer.Option(help="of torch")] = 1,
    device: Annotated[str, typer.Option(help="of torch: cpu, cuda")] = "cpu",
    resume: Annotated[
        bool, typer.Option("--resume", help="go on from the checkpoint in --out")
    ] = False,
) -> None:
    """Train the network that estimates curvature from a noisy centreline.

    The report compares the network with splines, which learn nothing.
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
        report = train_curvature(config, resume=resume, on_epoch=report_epochs(console, steps))
        console.print(_results(report))
        for note in report["notes"]:
            console.print(f"Note: {note}")
        console.print(f"{out}: report.json, model.pt, checkpoint.pt", soft_wrap=True)


def _results(report: dict[str, Any]) -> Table:
    """Return a table of the errors of all methods."""
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
        files = write_results(result, out)
    reconstruction = result.reconstruction
    console = Console()
    console.print(
        f"{reconstruction.verdict}: misfit {reconstruction.misfit:.1%}, "
        f"residual {reconstruction.residual_rms:.2f} px, radius {reconstruction.radius:.4g}"
    )
    for reason in reconstruction.reasons:
        console.print(f"Note: {reason}")
    console.print(f"{out}: {', '.join(files)}", soft_wrap=True)
