"""Commands for real rods: measure threads, yarns and wires in photographs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from stickslip_services.cli.common import FILE, CommandGroup, amount, json_option, shows_errors
from stickslip_services.cli.output import print_json, print_table, say
from stickslip_services.errors import CommandError
from stickslip_services.local import making


def pixels(count: int) -> Callable[[str], list[float]]:
    """Return the type of an option that is a number of coordinates of pixels."""

    def read(text: str) -> list[float]:
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) != count:
            raise click.BadParameter(f"must be {count} numbers with commas, and is {text!r}")
        return values

    return read


@click.group(cls=CommandGroup)
def rods() -> None:
    """Measure real threads, yarns and wires."""


@rods.command()
@click.argument("photographs", metavar="FILES...", nargs=-1, required=True, type=FILE)
@click.option(
    "--ledge",
    "ledges",
    metavar="X,Y",
    type=pixels(2),
    multiple=True,
    required=True,
    help="pixel at which the thread leaves the ledge; once for all photographs, or for each",
)
@click.option(
    "--ruler",
    "rulers",
    metavar="X,Y,X,Y",
    type=pixels(4),
    multiple=True,
    help="two pixels on a ruler; without it, the marks of a ruler are searched",
)
@click.option(
    "--ruler-mm",
    type=amount("millimetres", 1),
    default="100",
    help="distance of the two pixels of --ruler",
)
@click.option(
    "--mark-mm",
    type=amount("millimetres", 0.1),
    default="1",
    help="distance of the finest marks of the ruler",
)
@click.option("--pixels-per-mm", type=amount("pixels", 0.1), help="the scale, if you know it")
@click.option(
    "--side",
    type=click.Choice(["right", "left"]),
    default="right",
    help="side of the ledge on which the thread hangs",
)
@click.option(
    "--level", metavar="X,Y,X,Y", type=pixels(4), help="two pixels of a level line, if askew"
)
@click.option(
    "--clamp-angle",
    type=amount("degrees", -90, 90),
    help="angle upwards at the ledge, if you know it; fitted otherwise",
)
@click.option("--out", type=FILE, default="bending", help="directory for the pictures")
@json_option
@shows_errors
def measure(
    photographs: tuple[Path, ...],
    ledges: tuple[list[float], ...],
    rulers: tuple[list[float], ...],
    as_json: bool,
    **options: object,
) -> None:
    """Measure the bending length and natural bend of a thread that hangs over a ledge.

    Several photographs are of the same yarn: they get a joint bending length, too. Lay a ruler into
    the plane of the thread, before a plain background, and look at both squarely.
    """
    count = len(photographs)
    answer = making.measure_photographs(
        {
            "photographs": [str(path) for path in photographs],
            "ledges": _for_each(ledges, count, "--ledge"),
            "rulers": _for_each(rulers, count, "--ruler") if rulers else None,
            "ruler_mm": options["ruler_mm"],
            "mark_mm": options["mark_mm"],
            "pixels_per_mm": options["pixels_per_mm"],
            "side": options["side"],
            "level": options["level"],
            "clamp_degrees": options["clamp_angle"],
            "out": str(options["out"]),
        }
    )
    if as_json:
        print_json(answer)
    else:
        _print(answer)


def _for_each(values: tuple[list[float], ...], count: int, option: str) -> list[list[float]]:
    """Return a value for each photograph; a single one is that of all."""
    if len(values) not in (1, count):
        raise CommandError(
            f"{option}: must be given once, or once for each of {count} photographs, and is given "
            f"{len(values)} times"
        )
    return list(values) * count if len(values) == 1 else list(values)


def _print(answer: dict[str, Any]) -> None:
    rows = []
    for photograph in answer["photographs"]:
        cells = [
            f"{photograph[value]:.1f} +- {photograph[error]:.1f}"
            for value, error in (
                ("bending_length_mm", "bending_length_error_mm"),
                ("natural_bend_per_m", "natural_bend_error_per_m"),
                ("clamp_degrees", "clamp_error_degrees"),
            )
        ]
        name = Path(photograph["photograph"]).name
        rows.append((name, f"{photograph['length_mm']:.1f}", *cells))
    heads = ("photograph", "length mm", "bending length mm", "natural bend /m", "clamp degrees")
    print_table(heads, rows)
    for photograph in answer["photographs"]:
        if photograph["trades_bend_for_weight"]:
            say(
                f"{photograph['photograph']}: a stiffer thread of another natural bend would hang "
                "alike; let a longer piece hang"
            )
    joint = answer["joint"]
    if joint is not None:
        say(
            f"one yarn: bending length {joint['bending_length']:.1f} +- {joint['error']:.1f} mm; "
            f"the photographs scatter by {joint['scatter']:.1f} mm"
        )
    say(f"pictures: {', '.join(photograph['picture'] for photograph in answer['photographs'])}")
