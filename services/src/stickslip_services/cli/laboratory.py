"""Commands for fabrics: list the built-in ones, and test a card in the textile laboratory."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click
from stickslip_schemas.spec.names import Material, did_you_mean
from stickslip_schemas.spec.reality import MeasuredFabric, measured_fabrics

from stickslip_services.cli.common import FILE, CommandGroup, amount, json_option, shows_errors
from stickslip_services.cli.documents import SCENE_SUFFIXES, read_card
from stickslip_services.cli.output import print_fields, print_json, print_table, say
from stickslip_services.errors import CommandError
from stickslip_services.local import making

MICRO = 1e6
"""A rigidity in N m times this is in uN m."""

card_argument = click.argument(
    "card", help="a card, YAML or JSON, or the name of a built-in fabric"
)
mu_option = click.option(
    "--mu",
    type=amount("coefficient of friction", 0.01, 1.5),
    default="0.5",
    help="friction coefficient of the table or the cylinder",
)


@click.command()
@json_option
@shows_errors
def fabrics(as_json: bool) -> None:
    """List the built-in fabrics, with their bending lengths and drape coefficients.

    Each is one measured specimen: another cloth of the same name may be twice as stiff.
    """
    table = measured_fabrics()
    if as_json:
        print_json({name: facts._asdict() for name, facts in table.items()})
        return
    rows = [(name, *_fabric_cells(facts)) for name, facts in table.items()]
    heads = ("fabric", "g/m2", "D warp, weft uN m", "bending length mm", "drape %")
    print_table(heads, rows)


def _fabric_cells(facts: MeasuredFabric) -> tuple[str, ...]:
    warp, weft, _ = (MICRO * rigidity for rigidity in facts.bending)
    return (
        f"{1e3 * facts.density:.0f}",
        f"{warp:.1f}, {weft:.1f}",
        f"{facts.bending_length[0]:.1f}, {facts.bending_length[1]:.1f}",
        f"{facts.drape:.0f}",
    )


@click.group(cls=CommandGroup)
def lab() -> None:
    """Test a fabric in a simulated textile laboratory."""


@lab.command()
@card_argument
@click.option("--out", type=FILE, default="lab", help="directory for the picture")
@click.option(
    "--cell", type=amount("millimetres", 1, 20), default="5", help="distance of vertices [mm]"
)
@click.option("--seed", type=int, default=0, help="seed of the mesh, which chooses the folds")
@json_option
@shows_errors
def drape(card: str, out: Path, cell: float, seed: int, as_json: bool) -> None:
    """Hang a disc of 30 cm over a pedestal of 18 cm: Cusick's drape test, BS 5058.

    Prints the drape coefficient and the number of folds, and writes drape.svg. Takes about half a
    minute.
    """
    _test("drape", card, {"out": str(out), "cell": cell, "seed": seed}, as_json=as_json)


@lab.command()
@card_argument
@json_option
@shows_errors
def cantilever(card: str, as_json: bool) -> None:
    """Push strips over an edge until they bend by 41.5 degrees: ASTM D1388.

    Prints the bending length along the warp and along the weft.
    """
    _test("cantilever", card, {}, as_json=as_json)


@lab.command()
@card_argument
@mu_option
@json_option
@shows_errors
def tilt(card: str, mu: float, as_json: bool) -> None:
    """Tilt a table by one degree in a second until a sheet slides."""
    _test("tilt", card, {"mu": mu}, as_json=as_json)


@lab.command()
@card_argument
@mu_option
@json_option
@shows_errors
def pull(card: str, mu: float, as_json: bool) -> None:
    """Draw a strip over a cylinder against a light pull, and read mu from both pulls."""
    _test("pull", card, {"mu": mu}, as_json=as_json)


def _test(test: str, card: str, options: Mapping[str, Any], *, as_json: bool) -> None:
    """Run a test on a card and print its result."""
    result = making.run_lab({"test": test, **_fabric_of(card), **options})
    if as_json:
        print_json(result)
        return
    print_fields(_fields(result))
    if not result.get("at_rest", True):
        say("the cloth did NOT come to rest: the coefficient is that of a moving disc")


def _fabric_of(card: str) -> dict[str, Any]:
    """Return the name and the numbers of a fabric; the numbers of a built-in one are null."""
    path = Path(card)
    if card in list(Material):
        return {"name": card, "numbers": None}
    # What looks like a file is one: a missing file must not be answered with a list of fabrics.
    if path.exists() or path.suffix in SCENE_SUFFIXES or "/" in card:
        return {"name": path.stem, "numbers": read_card(path).numbers()}
    known = [str(name) for name in Material]
    raise CommandError(
        f"card must be a file, or one of {', '.join(known)}{did_you_mean(card, known)}; it is "
        f"{card!r}"
    )


_WRITTEN: Mapping[type, Callable[[Any], str]] = {
    bool: lambda value: "yes" if value else "no",
    list: lambda values: ", ".join(str(value) for value in values),
    dict: lambda parts: ", ".join(f"{_words(name)} {value}" for name, value in parts.items()),
    type(None): lambda _: "none",
}
"""How values of a result are written for people, by their type; others are written as they are."""


def _fields(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the fields of a result in words."""
    return [(_words(name), _WRITTEN.get(type(value), str)(value)) for name, value in result.items()]


def _words(name: str) -> str:
    return name.replace("_", " ")
