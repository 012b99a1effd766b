"""The commands `stickslip-train film ...`: friction of a real cloth from a film of a phone."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from stickslip_training.cli.shared import readable_errors

NO_ANSWER = 3
"""Exit status of `measure` if the cloth does not slide."""
MEASURE = "measure"


class _MeasuresByDefault(TyperGroup):
    """A group in which `film FILM` means `film measure FILM`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command `measure` before what names no command and is no option."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = [MEASURE, *args]
        return super().parse_args(ctx, args)


film = typer.Typer(
    cls=_MeasuresByDefault,
    no_args_is_help=True,
    help="Measure the friction of a real cloth in a film: `film FILM`, or `film marker OUT.pdf`.",
)


@film.command()
def marker(
    out: Annotated[Path, typer.Argument(metavar="OUT.pdf", help="the sheet, A4 at true size")],
) -> None:
    """Write the sheet of markers that a film needs, for a printer."""
    from stickslip_training.film.sheet import write_sheet

    with readable_errors():
        write_sheet(out)
    Console().print(
        f'{out}: print it at "actual size", and check the bar of 100 mm', soft_wrap=True
    )


@film.command()
def measure(
    path: Annotated[Path, typer.Argument(metavar="FILM", help="a film of a phone")],
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="OUT", help="write the answer; - prints it")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="draw the frame at slip, the tilt and both answers"),
    ] = None,
    focal: Annotated[
        float | None,
        typer.Option(min=1.0, help="focal length [px], if you know it; the boards tell it"),
    ] = None,
    level_error: Annotated[
        float, typer.Option(min=0.0, max=10.0, help="standard deviation of the table's slope [deg]")
    ] = 0.3,
    drag: Annotated[
        float | None,
        typer.Option(min=0.0, help="when the holders stand at their start [s]; found if not given"),
    ] = None,
) -> None:
    """Measure static mu by the tilt at which the cloth slides, and mu of the drag by the network.

    If the cloth does not slide, the exit status is 3.
    """
    with readable_errors():
        from stickslip_training.film.answer import answer_of, lines_of
        from stickslip_training.film.drag import read_drag
        from stickslip_training.film.measuring import measure_film
        from stickslip_training.film.picture import write_picture

        measured = measure_film(path, focal=focal, level_sd=level_error)
        read = read_drag(measured, drag)
        if picture is not None:
            write_picture(picture, measured, read)
        text = json.dumps(answer_of(measured, read), indent=1, allow_nan=False)
        if as_json is not None and str(as_json) != "-":
            as_json.parent.mkdir(parents=True, exist_ok=True)
            as_json.write_text(text + "\n", encoding="utf-8")
    if str(as_json) == "-":
        typer.echo(text)
    else:
        for line in lines_of(measured, read):
            typer.echo(line)
    if measured.slip is None:
        raise typer.Exit(NO_ANSWER)
