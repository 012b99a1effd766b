"""The command that fits parameters of a scene to vertices or silhouettes that were seen."""

from pathlib import Path

import click
from stickslip_schemas.scene.reading import reading_files_once

from stickslip_services.cli.common import FILE, json_option, shows_errors
from stickslip_services.cli.documents import find_scene
from stickslip_services.cli.output import print_json, print_table, say
from stickslip_services.cli.specs import refuse_impossible_start, scene_argument, spec_of
from stickslip_services.errors import CommandError
from stickslip_services.local import making


@click.command()
@scene_argument
@click.argument("observations", metavar="FILE", type=FILE, help="an NPZ file of observations")
@click.option(
    "--parameters", metavar="NAMES", required=True, help="parameters to fit, for example mu,speed"
)
@click.option(
    "--start",
    metavar="VALUES",
    default="",
    show_default=False,
    help="where to start, for example mu=0.3,speed=2; by default at the values of the scene",
)
@click.option(
    "--multistart",
    type=click.IntRange(min=1, max=100),
    default=3,
    help="most starts, while noise does not explain the observations",
)
@click.option("--seed", type=int, default=0, help="draws the starts after the first")
@json_option
@shows_errors
@reading_files_once()
def fit(
    scene: str,
    observations: Path,
    parameters: str,
    start: str,
    multistart: int,
    seed: int,
    as_json: bool,
) -> None:
    """Fit parameters of a scene to observations of it, by exact derivatives of its runs.

    FILE has `frames` (T), `noise` [m] and `SHEET.positions` (T, K, 3) [m], with `SHEET.vertices`
    (K) unless all were seen; or silhouettes, `CAMERA.masks` (T, h, w) and `CAMERA.matrix` (3, 4),
    with `CAMERA.hidden` where something may hide cloth and `pixel_noise` [px]. Exits with 1
    if noise does not explain the observations.
    """
    document, files = find_scene(scene)
    refuse_impossible_start(scene, spec_of(document), files)
    request = {
        "parameters": [name.strip() for name in parameters.split(",")],
        "start": _values_of(start),
        "multistart": multistart,
        "seed": seed,
    }
    answer = making.fit(document, files, observations, request)
    if as_json:
        print_json(answer)
    else:
        rows = []
        for name, value in answer["values"].items():
            deviation = answer["deviations"][name]
            rows.append((name, f"{value:.5g}", f"{deviation:.2g}", answer["units"][name]))
        print_table(("parameter", "value", "standard deviation", "unit"), rows)
        say(answer["warning"] or f"noise explains the observations; {answer['runs']} runs")
    raise click.exceptions.Exit(0 if answer["is_explained"] else 1)


def _values_of(start: str) -> dict[str, float]:
    """Return the values of `mu=0.3,speed=2`."""
    values = {}
    for part in start.split(",") if start else ():
        name, separator, number = part.partition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError as error:
            rule = "--start: must be NAME=NUMBER, several separated by commas"
            raise CommandError(f"{rule}, and it is {start!r}") from error
        if not separator:
            raise CommandError(f"--start: must be NAME=NUMBER, and it is {start!r}")
    return values
