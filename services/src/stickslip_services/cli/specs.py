"""Spec and scene files, YAML or JSON."""

import json
import math
import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from stickslip_schemas.documents.problems import FieldError, field_errors
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.scene_file import SceneFile

from stickslip_services.errors import CommandError


class SpecFileError(CommandError):
    """The file holds no valid spec or scene."""


class _Loader(yaml.SafeLoader):
    """YAML in which `1e-3` is a number and a repeated key is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is no word", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is there twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_spec(path: Path) -> dict[str, Any]:
    """Return the document of a spec file, which may break rules of specs; raise SpecFileError if it is no document."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SpecFileError(f"there is no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise SpecFileError(f"{path} cannot be read: {error}") from error
    try:
        document = json.loads(text) if path.suffix == ".json" else yaml.load(text, _Loader)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise SpecFileError(f"{path} is not {'JSON' if path.suffix == '.json' else 'YAML'}: {error}") from error
    if not isinstance(document, dict):
        raise SpecFileError(f"{path} must hold a mapping (key: value), and it holds {document!r:.100}")
    _check(document, "", path)
    return document


def check_spec(document: dict[str, Any], path: Path) -> JobSpec:
    """Return the spec of a document; raise SpecFileError with all fields that break a rule."""
    try:
        return job_spec_adapter.validate_python(document)
    except ValidationError as error:
        raise _not_valid(error, document, AnyJobSpec, path) from error


def check_scene(document: dict[str, Any], path: Path) -> SceneFile:
    """Return the scene of a document; raise SpecFileError with all fields that break a rule."""
    try:
        return SceneFile.model_validate(document)
    except ValidationError as error:
        raise _not_valid(error, document, SceneFile, path) from error


def _not_valid(error: ValidationError, document: dict[str, Any], model: Any, path: Path) -> SpecFileError:
    lines = [field_line(field) for field in field_errors(error, document, model)]
    return SpecFileError("\n".join([f"{path} is not valid", *lines]))


def field_line(field: FieldError) -> str:
    """Return a line that names a field of a document, the rule that it breaks, and its value."""
    place = field.pointer.lstrip("/").replace("/", ".") or "the document"
    return f"  {place}: {field.rule}" + (f", and it is {field.value}" if field.value else "")


def _check(value: Any, place: str, path: Path) -> None:
    """Raise SpecFileError for values that JSON cannot hold."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check(item, f"{place}.{key}" if place else str(key), path)
    elif isinstance(value, list):
        for position, item in enumerate(value):
            _check(item, f"{place}.{position}", path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise SpecFileError(f"{path}: {place} must be a finite number, and it is {value}")
    elif value is not None and not isinstance(value, str | int | float | bool):
        raise SpecFileError(f"{path}: {place} must be a number, a word, a list or a mapping, and it is {value!r}")
