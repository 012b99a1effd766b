"""The command that simulates a custom scene."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from stickslip_services.cli.common import JsonOption, console, say
from stickslip_services.cli.errors import shows_errors
from stickslip_services.cli.specs import check_scene, read_spec
from stickslip_services.local import certifying, simulating


@shows_errors
def simulate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="the scene, YAML or JSON")],
    out: Annotated[Path, typer.Argument(metavar="DIR", help="a new directory for the trajectories")],
    certificate: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="what `stickslip certify` wrote (certificates/PRESET, if it is there)"),
    ] = None,
    allow_uncertified: Annotated[
        bool, typer.Option("--allow-uncertified", help="simulate even where no certificate vouches for the preset")
    ] = False,
    obj: Annotated[bool, typer.Option("--obj", help="write an OBJ file for each sheet and frame, too")] = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a custom scene on this machine: sheets, bodies and motions from a file.

    Writes trajectory.npz and scene.json; exits with 1 if the solver did not converge. No coordinator is needed.
    """
    scene = check_scene(read_spec(file), file)
    usual = Path("certificates") / scene.preset.value
    directory = certificate or (usual if usual.is_dir() else None)
    if directory is not None:
        certifying.read_certificate(directory)  # refuses an invalid certificate with the reason
    result = simulating.simulate(
        scene,
        file.parent,
        out,
        certificate=None if directory is None else directory / certifying.DOCUMENT_NAME,
        allow_uncertified=allow_uncertified,
        obj=obj,
    )
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        console().print(f"{result['frames']} frames of {len(scene.sheets)} sheets: {escape(str(out))}")
        say("certified" if result["certified"] else f"NOT certified: {result['why_not_certified']}")
        if not result["valid"]:
            say(f"NOT valid: {result['reason']}")
    raise typer.Exit(0 if result["valid"] else 1)
