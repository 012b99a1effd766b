"""Commands for scenes: check, preview and simulate one."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.exceptions import Exit
from pydantic import JsonValue, ValidationError
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.scene.reading import reading_files_once
from stickslip_schemas.spec.cameras import FRAMING, load_rig

from stickslip_services.cli.common import FILE, CommandGroup, field_line, json_option, shows_errors
from stickslip_services.cli.documents import find_scene
from stickslip_services.cli.output import print_json, print_table, say, tell
from stickslip_services.errors import CommandError
from stickslip_services.local import making
from stickslip_services.units import size

CERTIFICATES = Path("certificates")
"""Folder that `stickslip certify` writes to without its option --out."""
SAMPLE_FRAMES = 30
"""Most frames of a sample that is simulated or checked."""

scene_argument = click.argument(
    "scene", help="a scene, YAML or JSON, or the name of a built-in one"
)


@click.command()
@scene_argument
@click.argument("out", metavar="DIR", type=FILE, help="a new directory for the trajectories")
@click.option(
    "--certificate",
    "certificate_folder",
    metavar="DIR",
    type=FILE,
    help="what `stickslip certify` wrote (certificates/PRESET, if it is there)",
)
@click.option(
    "--allow-uncertified",
    is_flag=True,
    help="simulate even where no certificate vouches for the preset",
)
@click.option("--obj", is_flag=True, help="write an OBJ file for each sheet and frame, too")
@click.option(
    "--sensitivities",
    metavar="NAMES",
    default="",
    show_default=False,
    help="differentiate the positions by these parameters of the scene, for example mu,speed",
)
@json_option
@shows_errors
@reading_files_once()
def simulate(
    scene: str,
    out: Path,
    certificate_folder: Path | None,
    allow_uncertified: bool,
    obj: bool,
    sensitivities: str,
    as_json: bool,
) -> None:
    """Simulate one sample of a scene on this machine, with its default parameters.

    It runs the stages of the queue. Writes trajectory.npz and scene.json; exits with 1 if the
    sample is not valid. No coordinator is needed.
    """
    document, files = find_scene(scene)
    # The certificate of the preset is found by itself where `stickslip certify` has put it.
    usual_folder = CERTIFICATES / document.preset.value
    if certificate_folder is None and usual_folder.is_dir():
        certificate_folder = usual_folder
    certificate = None
    if certificate_folder is not None:
        certificate = making.read_certificate(certificate_folder)
    names = [name.strip() for name in sensitivities.split(",")] if sensitivities else []
    spec = spec_of(document, allow_uncertified=allow_uncertified, sensitivities=names)
    refuse_impossible_start(scene, spec, files)
    result = making.simulate(spec, files, out, certificate=certificate, obj=obj)
    if as_json:
        print_json(result)
    else:
        tell(f"{spec.instants} frames of {len(document.sheets)} sheets: {out}")
        say("certified" if result["certified"] else f"NOT certified: {result['why_not_certified']}")
        if not result["valid"]:
            say(f"NOT valid: {result['reason']}")
        for line in _derivative_lines(spec, result["labels"]):
            say(line)
    raise Exit(0 if result["valid"] else 1)


def _derivative_lines(spec: ClothSceneSpec, labels: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each derivative of a run, as far as it ran."""
    for name in spec.sensitivities if labels else ():
        largest = labels[f"largest_by_{name}"]
        unit = f"m per {spec.parameter_unit(name)}"
        size = f"at most {largest:.3g} {unit}" if largest else "0: it has no effect here"
        is_solved = math.isfinite(largest)
        yield f"derivative by {name}: {size if is_solved else 'NOT solved in some step'}"


@click.group(cls=CommandGroup)
def scene() -> None:
    """Check and preview scenes."""


@scene.command()
@scene_argument
@json_option
@shows_errors
@reading_files_once()
def check(scene: str, as_json: bool) -> None:
    """Check a scene, its start and the files that it names.

    List its axes, the arrays of a dataset of it, and costs.
    """
    document, files = find_scene(scene)
    spec = spec_of(document)
    refuse_impossible_start(scene, spec, files)
    if as_json:
        print_json(
            {
                "scene": document.name,
                "digest": document.digest,
                "axes": _axes(document),
                "arrays": _arrays(spec),
                "cost": _cost(document, spec, files),
            }
        )
        return
    # The last column is text, which is wrapped: lists of values and meanings are long.
    axis_rows = []
    for name, parameter in document.parameters.items():
        axis_rows.append((name, str(document.default(name)), str(parameter.range)))
    print_table(("axis", "default", "values"), axis_rows, sentences=True)
    array_rows = []
    for array in layout(spec):
        shape = " x ".join(str(extent) for extent in array.shape) or "one number"
        array_rows.append((array.name, str(array.dtype), shape, array.description))
    print_table(("array", "type", "shape", "meaning"), array_rows, sentences=True)
    cost = _cost(document, spec, files)
    least, most = cost["cpu_seconds_a_sample"]
    say(
        f"{cost['vertices']} vertices, {cost['frames']} frames. A sample has "
        f"{size(cost['bytes_a_sample'])} before compression, and its simulation most likely takes "
        f"{least:.2g} to {most:.2g} CPU s. Digest {document.digest}"
    )
    if files:
        # This module needs the extra `arrays`, which a scene without files does not.
        from stickslip_schemas.scene.files import weld_notes

        for note in weld_notes(document, files):
            say(note)


def _axes(document: Scene) -> dict[str, JsonValue]:
    axes: dict[str, JsonValue] = {}
    for name, parameter in document.parameters.items():
        axes[name] = {
            "default": document.default(name),
            "values": parameter.range,
            "unit": parameter.unit,
            "sets": list(parameter.sets),
            "description": parameter.description,
        }
    return axes


def _arrays(spec: ClothSceneSpec) -> list[JsonValue]:
    arrays: list[JsonValue] = []
    for array in layout(spec):
        arrays.append(
            {
                "name": array.name,
                "dtype": array.dtype,
                "shape": list(array.shape),
                "description": array.description,
            }
        )
    return arrays


def _cost(document: Scene, spec: ClothSceneSpec, files: Mapping[str, bytes]) -> dict[str, Any]:
    """Return the size of a sample, and an interval of the CPU time that it takes."""
    costs = spec.default_costs
    return {
        "vertices": sum(sheet.mesh.shape[0] for sheet in document.sheets.values()),
        "frames": document.frames,
        "cpu_seconds_a_sample": [
            costs.simulate / costs.uncertainty_factor,
            costs.simulate * costs.uncertainty_factor,
        ],
        "bytes_a_sample": sum(array.sample_bytes for array in layout(spec)),
        "files_bytes": sum(len(data) for data in files.values()),
    }


@scene.command()
@scene_argument
@click.argument("out", metavar="DIR", type=FILE, help="a directory for the pictures")
@json_option
@shows_errors
def preview(scene: str, out: Path, as_json: bool) -> None:
    """Draw how a scene starts and what moves in it, from all its cameras. Nothing is simulated.

    Writes CAMERA.png and motion.webp. No coordinator is needed, but the environment of Blender is.
    """
    document, files = find_scene(scene)
    pictures = making.preview(document, files, out)
    if as_json:
        print_json({"pictures": list(pictures)})
    else:
        say(f"{', '.join(pictures)} in {out}")


def refuse_impossible_start(name: str, spec: ClothSceneSpec, files: Mapping[str, bytes]) -> None:
    """Raise CommandError if a scene can never work; `files` are those that it names, by digest."""
    faults = spec.start_faults(lambda digest: files.get(digest) or built_in_files()[digest])
    if not faults:
        return
    lines = [f"{name} can never work"]
    for fault in faults:
        # The scene is the document of this command, and not a field of a spec.
        pointer = "".join(f"/{step}" for step in fault.location[1:])
        value = json.dumps(fault.value)
        lines.append(field_line(FieldError(pointer=pointer, rule=fault.rule, value=value)))
    raise CommandError("\n".join(lines))


def spec_of(
    scene: Scene, *, allow_uncertified: bool = True, sensitivities: Sequence[str] = ()
) -> ClothSceneSpec:
    """Return the spec of one sample of a scene: default parameters, seen by its first camera.

    Raises CommandError if its runs cannot be differentiated by `sensitivities`.
    """
    # One camera suffices: the simulation does not depend on it.
    cameras = scene.looks.cameras
    if isinstance(cameras, dict):
        viewpoints = list(cameras)
    elif isinstance(cameras, str):
        viewpoints = [camera.name for camera in load_rig(cameras)]
    else:
        viewpoints = list(FRAMING)
    document = {
        "kind": "cloth_scene",
        "scene": scene.model_dump(mode="json"),
        "frames": min(SAMPLE_FRAMES, scene.frames),
        "allow_uncertified": allow_uncertified,
        "sensitivities": list(sensitivities),
        "axes": {"texture": "checker", "viewpoint": viewpoints[0]},
    }
    try:
        return ClothSceneSpec.model_validate(document)
    except ValidationError as error:
        # The scene itself has been checked, so the fault is in what the command adds.
        lines = [field_line(field) for field in field_errors(error, document, ClothSceneSpec)]
        raise CommandError("\n".join(["the scene cannot be run so", *lines])) from error
