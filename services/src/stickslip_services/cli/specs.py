"""Spec and scene files, YAML or JSON, and the commands for scenes: check, preview and simulate one."""

import json
import math
import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import click
import yaml
from click.exceptions import Exit
from pydantic import ValidationError
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.document import MAX_DOCUMENT_BYTES, Scene
from stickslip_schemas.scene.library import load_scene, parse_yaml
from stickslip_schemas.spec.cameras import FRAMING, load_rig
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.names import MATERIAL_NAME

from stickslip_services.cli.common import (
    FILE,
    field_line,
    json_option,
    print_table,
    say,
    shows_errors,
)
from stickslip_services.client.errors import ClientError
from stickslip_services.errors import CommandError
from stickslip_services.local import making
from stickslip_services.units import size

SCENE_SUFFIXES = (".yaml", ".yml", ".json")
"""Of a `scene` that is a file; other names are those of built-in scenes."""
MAX_VALUES = 10_000_000
"""Of a file."""

scene_argument = click.argument(
    "scene", help="a scene, YAML or JSON, or the name of a built-in one"
)


@click.command()
@scene_argument
@click.argument("out", metavar="DIR", type=FILE, help="a new directory for the trajectories")
@click.option(
    "--certificate",
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
@json_option
@shows_errors
def simulate(
    scene: str,
    out: Path,
    certificate: Path | None,
    allow_uncertified: bool,
    obj: bool,
    as_json: bool,
) -> None:
    """Simulate one sample of a scene on this machine, by the stages of the queue, with its default
    parameters.

    Writes trajectory.npz and scene.json; exits with 1 if the sample is not valid. No coordinator is
    needed.
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
def scene() -> None:
    """Check and preview scenes."""


@scene.command()
@scene_argument
@json_option
@shows_errors
def check(scene: str, as_json: bool) -> None:
    """Check a scene and the files that it names.

    List its axes, the arrays of a dataset of it, and costs.
    """
    given, files = _scene(scene)
    spec = spec_of(given)
    arrays: list[dict[str, Any]] = [
        {
            "name": each.name,
            "dtype": each.dtype,
            "shape": list(each.shape),
            "description": each.description,
        }
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
    print_table(
        ("axis", "default", "values"),
        ((n, str(a["default"]), a["values"]) for n, a in axes.items()),
    )
    rows = (
        (each["name"], each["dtype"], str(tuple(each["shape"])), each["description"])
        for each in arrays
    )
    print_table(("array", "type", "shape", "meaning"), rows, sentences=True)
    cost = said["cost"]
    least, most = cost["cpu_seconds_a_sample"]
    say(
        f"{cost['vertices']} vertices, {cost['frames']} frames. A sample has {size(cost['bytes_a_sample'])} before "
        f"compression, and its simulation most likely takes {least:.2g} to {most:.2g} CPU s. Digest {given.digest}"
    )
    return None


@scene.command()
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
            "axes": {
                "texture": "checker",
                "viewpoint": next(iter(cameras if isinstance(cameras, dict) else rig)),
            },
        }
    )
    assert isinstance(spec, ClothSceneSpec)
    return spec


def read_spec(path: Path) -> dict[str, Any]:
    """Return the document of a spec file, which may break rules of specs.

    Raise CommandError if it is no document.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise CommandError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path} cannot be read: {error}") from error
    try:
        document = json.loads(text) if path.suffix == ".json" else parse_yaml(text)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise CommandError(
            f"{path} is not {'JSON' if path.suffix == '.json' else 'YAML'}: {error}"
        ) from error
    if not isinstance(document, dict):
        raise CommandError(
            f"{path} must hold a mapping (key: value), and it holds {document!r:.100}"
        )
    try:
        _check(document, "", path, count())
    except RecursionError as error:
        raise CommandError(
            f"{path} must not nest so deeply: does an alias name what it is in?"
        ) from error
    return document


def read_job(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the document of a spec file, and the files by digest that its scene names.

    A scene that is a file, or that names files, becomes a document with references by digest.

    Raises CommandError where it is no document, or the scene breaks a rule.
    """
    document = read_spec(path)
    scene = document.get("scene")
    if isinstance(scene, dict):
        made, files = _inlined(scene, path)
    elif isinstance(scene, str) and Path(scene).suffix in SCENE_SUFFIXES:
        made, files = read_scene(path.parent / scene)
    else:
        return document, {}
    return document | {"scene": made.model_dump(mode="json")}, files


def read_scene(path: Path) -> tuple[Scene, dict[str, bytes]]:
    """Return the scene of a file, with references by digest, and its files by digest; raise
    CommandError.
    """
    name = path.stem if re.fullmatch(MATERIAL_NAME, path.stem) else None
    return _inlined({"name": name, **read_spec(path)}, path)


def _inlined(document: dict[str, Any], path: Path) -> tuple[Scene, dict[str, bytes]]:
    if (length := len(json.dumps(document))) > MAX_DOCUMENT_BYTES:
        raise CommandError(
            f"{path} must be a scene of at most {MAX_DOCUMENT_BYTES} bytes as JSON, and has {length}"
        )
    try:
        scene = Scene.model_validate(document)
    except ValidationError as error:
        raise _not_valid(error, document, Scene, path) from error

    if not any(scene.files()):
        return scene, {}
    from stickslip_schemas.scene.files import (
        UnfitFileError,
        frames_of,
        inlined,
    )  # needs the extra `arrays`

    def read(name: str) -> bytes:
        place = (path.parent / name).resolve()
        if not place.is_relative_to(path.parent.resolve()):
            raise UnfitFileError("must be in the folder of the scene, and a link leads out of it")
        return (
            frames_of(sorted(place.glob("*.obj")), scene, name)
            if place.is_dir()
            else place.read_bytes()
        )

    try:
        return inlined(scene, read)
    except UnfitFileError as error:
        raise CommandError(f"{path} is not valid\n  {error}") from error


def check_spec(document: dict[str, Any], path: Path) -> JobSpec:
    """Return the spec of a document; raise CommandError with all fields that break a rule."""
    try:
        return job_spec_adapter.validate_python(document)
    except ValidationError as error:
        raise _not_valid(error, document, AnyJobSpec, path) from error


def _not_valid(
    error: ValidationError, document: dict[str, Any], model: Any, path: Path
) -> CommandError:
    lines = [field_line(field) for field in field_errors(error, document, model)]
    return CommandError("\n".join([f"{path} is not valid", *lines]))


def _check(value: Any, place: str, path: Path, values: Iterator[int]) -> None:
    """Raise CommandError for values that JSON cannot hold, and for aliases that make too many of
    them.
    """
    if next(values) > MAX_VALUES:
        raise CommandError(
            f"{path} must hold at most {MAX_VALUES} values, with aliases written out"
        )
    if isinstance(value, dict):
        for key, item in value.items():
            _check(item, f"{place}.{key}" if place else str(key), path, values)
    elif isinstance(value, list):
        for position, item in enumerate(value):
            _check(item, f"{place}.{position}", path, values)
    elif isinstance(value, float) and not math.isfinite(value):
        raise CommandError(f"{path}: {place} must be a finite number, and it is {value}")
    elif value is not None and not isinstance(value, str | int | float | bool):
        raise CommandError(
            f"{path}: {place} must be a number, a word, a list or a mapping, and it is {value!r}"
        )
