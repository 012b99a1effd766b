"""The commands for scenes: check one, look at it, and simulate one sample here."""

import json
from pathlib import Path
from typing import Any

import click
from click.exceptions import Exit
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene
from stickslip_schemas.spec.cameras import FRAMING, load_rig

from stickslip_services.cli.common import FILE, json_option, print_table, say, shows_errors
from stickslip_services.cli.specs import read_scene
from stickslip_services.client.http import ClientError
from stickslip_services.local import making
from stickslip_services.units import size

scene_argument = click.argument("scene", help="a scene, YAML or JSON, or the name of a built-in one")


@click.command()
@scene_argument
@click.argument("out", metavar="DIR", type=FILE, help="a new directory for the trajectories")
@click.option(
    "--certificate",
    metavar="DIR",
    type=FILE,
    help="what `stickslip certify` wrote (certificates/PRESET, if it is there)",
)
@click.option("--allow-uncertified", is_flag=True, help="simulate even where no certificate vouches for the preset")
@click.option("--obj", is_flag=True, help="write an OBJ file for each sheet and frame, too")
@json_option
@shows_errors
def simulate(
    scene: str, out: Path, certificate: Path | None, allow_uncertified: bool, obj: bool, as_json: bool
) -> None:
    """Simulate one sample of a scene on this machine, by the stages of the queue, with its default parameters.

    Writes trajectory.npz and scene.json; exits with 1 if the sample is not valid. No coordinator is needed.
    """
    given, files = _scene(scene)
    usual = Path("certificates") / given.preset.value
    directory = certificate or (usual if usual.is_dir() else None)
    found = None if directory is None else making.read_certificate(directory)
    spec = spec_of(given, allow_uncertified=allow_uncertified)
    result = making.simulate(spec, files, out, certificate=found, obj=obj)
    if as_json:
        click.echo(json.dumps(result, indent=2))
    else:
        click.echo(f"{spec.instants} frames of {len(given.sheets)} sheets: {out}")
        say("certified" if result["certified"] else f"NOT certified: {result['why_not_certified']}")
        if not result["valid"]:
            say(f"NOT valid: {result['reason']}")
    raise Exit(0 if result["valid"] else 1)


@click.group()
def scenes() -> None:
    """Check and preview scenes."""


@scenes.command()
@scene_argument
@json_option
@shows_errors
def check(scene: str, as_json: bool) -> None:
    """Check a scene and the files that it names; list its axes, the arrays of a dataset of it, and costs."""
    given, files = _scene(scene)
    spec = spec_of(given)
    arrays: list[dict[str, Any]] = [
        {"name": each.name, "dtype": each.dtype, "shape": list(each.shape), "description": each.description}
        for each in layout(spec)
    ]
    axes: dict[str, dict[str, Any]] = {
        name: {
            "default": given.default(name),
            "values": parameter.range,
            "unit": parameter.unit,
            "sets": list(parameter.sets),
            "description": parameter.description,
        }
        for name, parameter in given.parameters.items()
    }
    usual = spec.usual_costs
    said: dict[str, Any] = {
        "scene": given.name,
        "digest": given.digest,
        "axes": axes,
        "arrays": arrays,
        "cost": {
            "vertices": sum(sheet.mesh.shape[0] for sheet in given.sheets.values()),
            "frames": given.frames,
            "cpu_seconds_a_sample": [usual.simulate / usual.unsure, usual.simulate * usual.unsure],
            "bytes_a_sample": sum(each.sample_bytes for each in layout(spec)),
            "files_bytes": sum(map(len, files.values())),
        },
    }
    if as_json:
        return click.echo(json.dumps(said, indent=2))
    print_table(("axis", "default", "values"), ((n, str(a["default"]), a["values"]) for n, a in axes.items()))
    rows = ((each["name"], each["dtype"], str(tuple(each["shape"])), each["description"]) for each in arrays)
    print_table(("array", "type", "shape", "meaning"), rows, sentences=True)
    cost = said["cost"]
    least, most = cost["cpu_seconds_a_sample"]
    say(
        f"{cost['vertices']} vertices, {cost['frames']} frames. A sample has {size(cost['bytes_a_sample'])} before "
        f"compression, and its simulation most likely takes {least:.2g} to {most:.2g} CPU s. Digest {given.digest}"
    )
    return None


@scenes.command()
@scene_argument
@click.argument("out", metavar="DIR", type=FILE, help="a directory for the pictures")
@json_option
@shows_errors
def preview(scene: str, out: Path, as_json: bool) -> None:
    """Draw how a scene starts and what moves in it, from all its cameras. Nothing is simulated.

    Writes CAMERA.png and motion.webp. No coordinator is needed, but the environment of Blender is.
    """
    pictures = making.preview(*_scene(scene), out)
    if as_json:
        click.echo(json.dumps({"pictures": pictures}))
    else:
        say(f"{', '.join(pictures)} in {out}")


def _scene(name: str) -> tuple[Scene, dict[str, bytes]]:
    """Return a built-in scene, or that of a file, and the files that it names by digest."""
    if Path(name).exists():
        return read_scene(Path(name))
    try:
        return load_scene(name), {}
    except ValueError as error:
        raise ClientError(f"scene {error}, in a file; it is {name!r}") from None


def spec_of(scene: Scene, *, allow_uncertified: bool = True) -> ClothSceneSpec:
    """Return the spec of one sample of a scene: its default parameters, seen by its first camera."""
    cameras = scene.looks.cameras
    rig = [camera.name for camera in load_rig(cameras)] if isinstance(cameras, str) else FRAMING
    spec = job_spec_adapter.validate_python(
        {
            "kind": "cloth_scene",
            "scene": scene.model_dump(mode="json"),
            "frames": min(30, scene.frames),
            "allow_uncertified": allow_uncertified,
            "axes": {"texture": "checker", "viewpoint": next(iter(cameras if isinstance(cameras, dict) else rig))},
        }
    )
    assert isinstance(spec, ClothSceneSpec)
    return spec
