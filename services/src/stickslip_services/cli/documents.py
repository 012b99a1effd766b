"""Spec and scene files, YAML or JSON, with the files that a scene names."""

import datetime
import json
import math
import re
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from stickslip_schemas.documents.problems import field_errors
from stickslip_schemas.kinds import AnyJobSpec, job_spec_adapter
from stickslip_schemas.scene.document import MAX_DOCUMENT_BYTES, Scene
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_schemas.spec.fabrics import FabricNumbers
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.names import MATERIAL_NAME, Material, did_you_mean
from stickslip_schemas.spec.yaml_documents import parse_yaml

from stickslip_services.cli.common import field_line
from stickslip_services.errors import CommandError

FABRICS = "fabrics"
"""Folder beside a spec or a scene with cards of fabrics, each named as its file."""
SCENE_SUFFIXES = (".yaml", ".yml", ".json")
"""Suffixes of a `scene` that is a file; all other names mean built-in scenes."""
MAX_VALUES = 1_000_000
"""Most values of a document, with aliases written out."""
MAX_FILE_BYTES = 16 * 2**20
"""Largest spec file [bytes]: the coordinator takes no larger request."""
VALUE_LETTERS = 100
"""Most letters of a value that a message repeats."""

_MAGIC = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"PK\x03\x04": "a ZIP or NPZ file",
    b"%PDF": "a PDF file",
    b"\xff\xfe": "text in UTF-16",
    b"\xfe\xff": "text in UTF-16",
}
"""First bytes of files that people name by mistake."""


def read_spec(path: Path) -> dict[str, Any]:
    """Return the document of a spec file, which may break rules of specs.

    Raises:
        CommandError: The file cannot be read, or holds no document.
    """
    # Each parser has errors of its own, which are put into our words.
    text = _read_text(path)
    syntax = "JSON" if path.suffix == ".json" else "YAML"
    try:
        document = json.loads(text) if syntax == "JSON" else parse_yaml(text)
    except RecursionError as error:
        raise CommandError(f"{path} must not nest its values so deeply") from error
    except json.JSONDecodeError as error:
        line = f"line {error.lineno}, column {error.colno}"
        raise CommandError(f"{path} is not JSON: {error.msg}, {line}") from error
    except yaml.MarkedYAMLError as error:
        raise CommandError(f"{path} is not YAML: {_yaml_problem(error)}") from error
    except (ValueError, yaml.YAMLError) as error:
        raise CommandError(f"{path} is not {syntax}: {error}") from error
    if document is None:
        raise CommandError(f"{path} is empty: it must hold a mapping (key: value)")
    if not isinstance(document, dict):
        raise CommandError(
            f"{path} must hold a mapping (key: value), and it holds {_value_words(document)}"
        )
    # The size comes first: the other check writes aliases out.
    _check_size(document, path)
    _check_values(document, "", path)
    return document


def _read_text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise CommandError(f"there is no file {path}") from error
    except OSError as error:
        raise CommandError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) > MAX_FILE_BYTES:
        raise CommandError(
            f"{path} must have at most {MAX_FILE_BYTES} bytes, and it has {len(data)}"
        )
    rule = f"{path} cannot be read: it must be YAML or JSON, text in UTF-8"
    # A PDF file may be nothing but text.
    for magic, kind in _MAGIC.items():
        if data.startswith(magic):
            raise CommandError(f"{rule}, and it is {kind}")
    try:
        # Editors of Windows write a mark of the byte order, which is no part of the text.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CommandError(f"{rule}; byte {error.start} is not UTF-8") from error


def _yaml_problem(error: yaml.MarkedYAMLError) -> str:
    """Return the fault and its position, without the excerpt that the library adds."""
    mark = error.problem_mark
    position = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
    return f"{error.problem or error.context}{position}"


def _value_words(value: object) -> str:
    """Return a value of a document as people write it, and never as Python does."""
    if isinstance(value, datetime.date):
        return f"the date {value.isoformat()}: write it in quotes to have a word"
    if isinstance(value, bytes):
        return "binary data"
    if isinstance(value, set | frozenset):
        return "a set"
    text = json.dumps(value, default=lambda item: type(item).__name__)
    return text if len(text) <= VALUE_LETTERS else f"{text[:VALUE_LETTERS]}..."


def _check_size(document: dict[str, Any], path: Path) -> None:
    """Raise CommandError for a document of too many values, or one that contains itself.

    Aliases of YAML name one value many times. Each value is counted once and remembered, so that a
    file of 400 bytes with aliases of aliases is refused at once.
    """
    counts: dict[int, int] = {}
    open_values: set[int] = set()

    def count_values(value: object) -> int:
        if isinstance(value, dict):
            items = list(value.values())
        elif isinstance(value, list):
            items = value
        else:
            return 1
        # The document lives while it is counted, so no identity is used twice.
        identity = id(value)
        if identity in open_values:
            raise CommandError(f"{path} must not nest so deeply: does an alias name what it is in?")
        if identity not in counts:
            open_values.add(identity)
            counts[identity] = 1 + sum(count_values(item) for item in items)
            open_values.remove(identity)
        return counts[identity]

    try:
        total = count_values(document)
    except RecursionError as error:
        raise CommandError(f"{path} must not nest its values so deeply") from error
    if total > MAX_VALUES:
        raise CommandError(
            f"{path} must hold at most {MAX_VALUES} values, with aliases written out, and it holds "
            f"{total}"
        )


def _check_values(value: object, field: str, path: Path) -> None:
    """Raise CommandError for values that JSON cannot hold."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check_values(item, f"{field}.{key}" if field else str(key), path)
    elif isinstance(value, list):
        for position, item in enumerate(value):
            _check_values(item, f"{field}.{position}", path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise CommandError(f"{path}: {field} must be a finite number, and it is {value}")
    elif value is not None and not isinstance(value, str | int | float | bool):
        raise CommandError(
            f"{path}: {field} must be a number, a word, a list or a mapping, and it is "
            f"{_value_words(value)}"
        )


def read_job(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the document of a spec file, and the files by digest that its scene names.

    A scene that is a file, or that names files, becomes a document with references by digest.

    Raises:
        CommandError: The file holds no document, or its scene breaks a rule.
    """
    document = read_spec(path)
    # A scene may be a document, a file beside the spec, or the name of a built-in one.
    stated = document.get("scene")
    if isinstance(stated, dict):
        scene, files = _inline_files(stated, path)
    elif isinstance(stated, str) and Path(stated).suffix in SCENE_SUFFIXES:
        scene, files = read_scene(path.parent / stated)
    else:
        return _with_cards_of_axes(document, path), {}
    document = document | {"scene": scene.model_dump(mode="json")}
    return _with_cards_of_axes(document, path), files


def _with_cards_of_axes(document: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a spec with the cards of the folder `fabrics` that its axes name."""
    cards = read_cards(path.parent, _words(document.get("axes")))
    if not cards:
        return document
    scene = document.get("scene")
    if scene is None:
        return _with_cards(document, cards, path)
    # The cards of a scene are in its document, so a built-in one is written out.
    if isinstance(scene, str):
        scene = find_scene(scene)[0].model_dump(mode="json")
    return document | {"scene": _with_cards(scene, cards, path)}


def _with_cards(
    document: dict[str, Any], cards: Mapping[str, dict[str, Any]], path: Path
) -> dict[str, Any]:
    """Return a spec or a scene with more cards; raise CommandError for two of one name."""
    defined = document.get("materials") or {}
    # Materials that are no mapping have an error of their own.
    if not isinstance(defined, dict):
        return document
    for name, card in cards.items():
        if name in defined and defined[name] != card:
            raise CommandError(
                f"{path} must not define the fabric {name}, which {FABRICS}/ beside it has, too"
            )
    return document | {"materials": {**defined, **cards}}


def read_cards(folder: Path, words: AbstractSet[str]) -> dict[str, dict[str, Any]]:
    """Return the cards of the files in `fabrics/` of a folder that are among the words, by name.

    Raises:
        CommandError: A file holds no card.
    """
    cards: dict[str, dict[str, Any]] = {}
    beside = folder / FABRICS
    for file in sorted(beside.iterdir()) if beside.is_dir() else ():
        if file.suffix in SCENE_SUFFIXES and file.stem in words:
            if file.stem in cards:
                raise CommandError(f"{beside} must have one file of the fabric {file.stem}")
            if file.stem in list(Material):
                raise CommandError(
                    f"{file} must have another name: {file.stem} is the name of a built-in fabric"
                )
            cards[file.stem] = read_card(file).model_dump(mode="json", exclude_unset=True)
    return cards


def read_card(path: Path) -> FabricNumbers:
    """Return the card of a fabric in a file.

    Raises:
        CommandError: The file holds no card, or it breaks rules; the message has all of them.
    """
    document = read_spec(path)
    try:
        return FabricNumbers.model_validate(document)
    except ValidationError as error:
        raise _not_valid(error, document, FabricNumbers, path) from error


def _words(value: object) -> set[str]:
    """Return all words in a part of a document."""
    if isinstance(value, str):
        return {value}
    words: set[str] = set()
    items = value.values() if isinstance(value, dict) else value
    for item in items if isinstance(items, Iterable) else ():
        words |= _words(item)
    return words


def find_scene(name: str) -> tuple[Scene, dict[str, bytes]]:
    """Return a scene with its files by digest; `name` is a file or a built-in scene.

    Raises:
        CommandError: The file does not exist, or breaks a rule, or no built-in scene has the name.
    """
    # What looks like a file is one: a missing file must not be answered with a list of scenes.
    path = Path(name)
    if path.exists() or path.suffix in SCENE_SUFFIXES or "/" in name:
        return read_scene(path)
    names = scene_names()
    if name not in names:
        raise CommandError(
            f"scene must be one of {', '.join(names)}, or a file, and it is "
            f"{name!r}{did_you_mean(name, names)}"
        )
    return load_scene(name), {}


def read_scene(path: Path) -> tuple[Scene, dict[str, bytes]]:
    """Return the scene of a file, with references by digest, and its files by digest.

    Raises:
        CommandError: The file holds no document, or the scene breaks a rule.
    """
    # A scene without a name has that of its file, if the file's name is a possible one.
    name = path.stem if re.fullmatch(MATERIAL_NAME, path.stem) else None
    return _inline_files({"name": name, **read_spec(path)}, path)


def _inline_files(document: dict[str, Any], path: Path) -> tuple[Scene, dict[str, bytes]]:
    """Return a scene with references by digest in place of names of files, and these files."""
    cards = read_cards(path.parent, _words([document.get(key) for key in ("sheets", "parameters")]))
    if cards:
        document = _with_cards(document, cards, path)
    # The coordinator has the same limit, and would refuse the document later.
    length = len(json.dumps(document))
    if length > MAX_DOCUMENT_BYTES:
        raise CommandError(
            f"{path} must be a scene of at most {MAX_DOCUMENT_BYTES} bytes as JSON, and has "
            f"{length}"
        )
    try:
        scene = Scene.model_validate(document)
    except ValidationError as error:
        raise _not_valid(error, document, Scene, path) from error
    if not any(scene.files()):
        return scene, {}

    # This module needs the extra `arrays`, which a scene without files does not.
    from stickslip_schemas.scene.files import UnfitFileError, frames_of, inlined

    # A scene of somebody else must not read files outside of its folder.
    folder = path.parent.resolve()

    def read(name: str) -> bytes:
        file = (path.parent / name).resolve()
        if not file.is_relative_to(folder):
            raise UnfitFileError("must be in the folder of the scene, and a link leads out of it")
        if file.is_dir():
            return frames_of(sorted(file.iterdir()), scene, name)
        return file.read_bytes()

    try:
        return inlined(scene, read)
    except UnfitFileError as error:
        raise CommandError(f"{path} is not valid\n  {error}") from error


def check_spec(document: Mapping[str, Any], path: Path) -> JobSpec:
    """Return the spec of a document.

    Raises:
        CommandError: It breaks rules; the message has all of them.
    """
    try:
        return job_spec_adapter.validate_python(document)
    except ValidationError as error:
        raise _not_valid(error, document, AnyJobSpec, path) from error


def _not_valid(
    error: ValidationError, document: Mapping[str, Any], model: object, path: Path
) -> CommandError:
    lines = [field_line(field) for field in field_errors(error, document, model)]
    return CommandError("\n".join([f"{path} is not valid", *lines]))
