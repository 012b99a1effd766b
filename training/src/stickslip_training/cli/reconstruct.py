"""The command `stickslip-train reconstruct`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from stickslip_training.cli.errors import errors_told


def reconstruct(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="one picture for each camera, named as the camera")],
    calibration: Annotated[Path, typer.Option(help="cameras as in the rigs of stickslip-schemas")],
    out: Annotated[Path, typer.Option(help="directory for the centreline, the overlay and the report")],
    length: Annotated[float, typer.Option(help="of the rod, in the unit of the calibration")] = 1.0,
    clamp: Annotated[tuple[float, float, float], typer.Option(help="where the rod leaves its clamp")] = (0, 0, 0),
    direction: Annotated[tuple[float, float, float], typer.Option(help="of the rod in its clamp")] = (0, 0, -1),
    radius: Annotated[float | None, typer.Option(help="of the rod; found if not given")] = None,
    rig: Annotated[str | None, typer.Option(help="which rig of the calibration, if it has several")] = None,
    points: Annotated[int, typer.Option(help="of the centreline, at uniform arc length", min=2)] = 150,
) -> None:
    """Reconstruct the centreline of a hanging rod from photographs by calibrated cameras."""
    # Heavy, and not needed by the other commands.
    from stickslip_training.reconstruction.photographs import reconstruct_folder, write_results

    with errors_told():
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
