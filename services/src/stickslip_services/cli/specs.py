"""Spec and scene files, YAML or JSON."""

import json
import math
import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.scene.document import MAX_DOCUMENT_BYTES, Scene
from stickslip_schemas.scene.library import parse_yaml
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.names import MATERIAL_NAME

from stickslip_services.errors import CommandError

SCENE_SUFFIXES = (".yaml", ".yml", ".json")
"""Of a `scene` that is a file; other names are those of built-in scenes."""

MAX_VALUES = 10_000_000
"""Of a file."""


def read_spec(path: Path) -> dict[str, Any]:
    """Return the document of a spec file, which may break rules of specs; raise CommandError if it is no document."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise CommandError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path} cannot be read: {error}") from error
    try:
        document = json.loads(text) if path.suffix == ".json" else parse_yaml(text)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise CommandError(f"{path} is not {'JSON' if path.suffix == '.json' else 'YAML'}: {error}") from error
    if not isinstance(document, dict):
        raise CommandError(f"{path} must hold a mapping (key: value), and it holds {document!r:.100}")
    try:
        _check(document, "", path, count())
    except RecursionError as error:
        raise CommandError(f"{path} must not nest so deeply: does an alias name what it is in?") from error
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
    """Return the scene of a file, with references by digest, and its files by digest; raise CommandError."""
    name = path.stem if re.fullmatch(MATERIAL_NAME, path.stem) else None
    return _inlined({"name": name, **read_spec(path)}, path)


def _inlined(document: dict[str, Any], path: Path) -> tuple[Scene, dict[str, bytes]]:
    if (length := len(json.dumps(document))) > MAX_DOCUMENT_BYTES:
        raise CommandError(f"{path} must be a scene of at most {MAX_DOCUMENT_BYTES} bytes as JSON, and has {length}")
    try:
        scene = Scene.model_validate(document)
    except ValidationError as error:
        raise _not_valid(error, document, Scene, path) from error

    if not any(scene.files()):
        return scene, {}
    from stickslip_schemas.scene.files import UnfitFileError, frames_of, inlined  # needs the extra `arrays`

    def read(name: str) -> bytes:
        place = (path.parent / name).resolve()
        if not place.is_relative_to(path.parent.resolve()):
            raise UnfitFileError("must be in the folder of the scene, and a link leads out of it")
        return frames_of(sorted(place.glob("*.obj")), scene, name) if place.is_dir() else place.read_bytes()

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


def _not_valid(error: ValidationError, document: dict[str, Any], model: Any, path: Path) -> CommandError:
    lines = [field_line(field) for field in field_errors(error, document, model)]
    return CommandError("\n".join([f"{path} is not valid", *lines]))


def field_line(field: FieldError) -> str:
    """Return a line that names a field of a document, the rule that it breaks, and its value."""
    place = field.pointer.lstrip("/").replace("/", ".") or "the document"
    return f"  {place}: {field.rule}" + (f", and it is {field.value}" if field.value else "")


def _check(value: Any, place: str, path: Path, values: Iterator[int]) -> None:
    """Raise CommandError for values that JSON cannot hold, and for aliases that make too many of them."""
    if next(values) > MAX_VALUES:
        raise CommandError(f"{path} must hold at most {MAX_VALUES} values, with aliases written out")
    if isinstance(value, dict):
        for key, item in value.items():
            _check(item, f"{place}.{key}" if place else str(key), path, values)
    elif isinstance(value, list):
        for position, item in enumerate(value):
            _check(item, f"{place}.{position}", path, values)
    elif isinstance(value, float) and not math.isfinite(value):
        raise CommandError(f"{path}: {place} must be a finite number, and it is {value}")
    elif value is not None and not isinstance(value, str | int | float | bool):
        raise CommandError(f"{path}: {place} must be a number, a word, a list or a mapping, and it is {value!r}")
