"""The form that submits a job: its fields from the JSON schema of a kind, and the spec from it.

A field has the name of its place in the spec: `quality`, or `axes.mu.values`. What the form has no
field for, such as custom textures, is written as YAML in the field `more`.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import yaml
from stickslip_schemas.kinds import KINDS, kind_named
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.names import Material
from stickslip_schemas.spec.yaml_documents import parse_yaml

MAX_FIELDS = 2000
"""Most fields of a form that is sent."""

FIRST_SETTINGS = ("preset", "quality", "frames", "mesh", "allow_uncertified")
"""Settings that users change most, in the order of the form."""

HANDLED = ("kind", "name", "scene", "set", "axes")
"""Keys of a spec that are no settings."""

AXIS_FORMS = {
    "values": "values",
    "linspace": "evenly spaced",
    "random": "random",
    "sobol": "Sobol sequence",
}
"""Forms of an axis of numbers, with the words of the page."""

RANGE_ENDS = {"linspace": ("start", "stop"), "random": ("low", "high"), "sobol": ("low", "high")}
"""Keys of the two ends of a range, by the form of the axis."""

_SEPARATORS = re.compile(r"[\s,;]+")

Schema = Mapping[str, Any]
Sent = Mapping[str, list[str]]
"""What a browser sends: the values of each field by its name."""


class FormError(ValueError):
    """A field that cannot be read; the rule says what it must be."""

    def __init__(self, name: str, rule: str) -> None:
        super().__init__(f"{name}: {rule}")
        self.name = name
        self.rule = rule


@dataclass(frozen=True)
class Setting:
    """A key of a spec with one field."""

    name: str
    kind: str
    """choice, several, flag, number or text."""
    text: str
    cost: str
    default: Any
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None
    is_whole: bool = False


@dataclass(frozen=True)
class Axis:
    """An axis of the grid, with fields for each of its forms."""

    name: str
    text: str
    is_required: bool
    is_number: bool
    choices: tuple[str, ...] = ()
    """Names to choose from; empty for numbers."""
    range: str = ""
    default: str = ""
    """The value without an axis; empty if there is none."""
    can_draw: bool = False
    """Whether fabrics may be drawn instead of chosen."""


@dataclass(frozen=True)
class SubmitForm:
    """The fields of a kind, or of a scene of it."""

    kind: str
    title: str
    scene: str | None
    scenes: tuple[str, ...]
    axes: tuple[Axis, ...]
    settings: tuple[Setting, ...]
    yaml_keys: tuple[str, ...] = ()
    """Keys that only YAML can give."""

    @property
    def first_axes(self) -> tuple[Axis, ...]:
        """Those that a grid needs, and the parameters of a scene."""
        return tuple(axis for axis in self.axes if self._comes_first(axis))

    @property
    def more_axes(self) -> tuple[Axis, ...]:
        """All others."""
        return tuple(axis for axis in self.axes if not self._comes_first(axis))

    def _comes_first(self, axis: Axis) -> bool:
        # Of a scene, what has a default is a parameter; looks have none.
        is_parameter = self.scene is not None and bool(axis.default)
        return axis.is_required or is_parameter

    @property
    def first_settings(self) -> tuple[Setting, ...]:
        """Those that users change most."""
        return tuple(setting for setting in self.settings if setting.name in FIRST_SETTINGS)

    @property
    def more_settings(self) -> tuple[Setting, ...]:
        """All others."""
        return tuple(setting for setting in self.settings if setting.name not in FIRST_SETTINGS)

    @property
    def names(self) -> list[str]:
        """The names of all fields that may be wrong."""
        axes = [f"axes.{axis.name}" for axis in self.axes]
        return ["name", *axes, *(setting.name for setting in self.settings), "more"]


@lru_cache(maxsize=64)
def form_of(kind: str, scene: str | None) -> SubmitForm:
    """Return the form of a kind; raise UnknownKindError or ValueError for an unknown scene."""
    spec_type = kind_named(kind)
    schema = spec_type.model_json_schema()
    scenes = scene_names() if "scene" in schema["properties"] else ()
    chosen = load_scene(scene or scenes[0]) if scenes else None
    settings, yaml_keys = _settings(schema)
    return SubmitForm(
        kind=kind,
        title=kinds()[kind] if chosen is None else chosen.description,
        scene=None if chosen is None else chosen.name,
        scenes=scenes,
        axes=tuple(_axes(spec_type, schema, chosen)),
        settings=settings,
        yaml_keys=yaml_keys,
    )


def kinds() -> dict[str, str]:
    """Return the kinds with the first line of their descriptions."""
    return {name: (kind.__doc__ or "").partition("\n")[0] for name, kind in KINDS.items()}


# ---- Fields from the schema ----------------------------------------------------------------------


def _resolved(schema: Schema, whole: Schema) -> Schema:
    """Return a schema without a reference at its top; of a choice with null, the other part."""
    reference = schema.get("$ref")
    if reference is not None:
        target = whole["$defs"][reference.rpartition("/")[2]]
        return {**target, **{key: value for key, value in schema.items() if key != "$ref"}}
    parts = [part for part in schema.get("anyOf", ()) if part.get("type") != "null"]
    if len(parts) == 1:
        rest = {key: value for key, value in schema.items() if key != "anyOf"}
        return {**_resolved(parts[0], whole), **rest}
    return schema


def _settings(schema: Schema) -> tuple[tuple[Setting, ...], tuple[str, ...]]:
    """Return the keys that have a field, and those that have none."""
    settings: dict[str, Setting] = {}
    yaml_keys: list[str] = []
    for name, raw in schema["properties"].items():
        if name in HANDLED:
            continue
        setting = _setting(name, _resolved(raw, schema), schema)
        if setting is None:
            yaml_keys.append(name)
        else:
            settings[name] = setting
    first = [settings[name] for name in FIRST_SETTINGS if name in settings]
    rest = [setting for name, setting in settings.items() if name not in FIRST_SETTINGS]
    return (*first, *rest), tuple(yaml_keys)


_SCALARS = {"boolean": "flag", "integer": "number", "number": "number", "string": "text"}


def _setting(name: str, schema: Schema, whole: Schema) -> Setting | None:
    """Return the field of a key, or None if its value is a document of its own."""
    choices = _choices(schema)
    kind = "choice" if choices else _SCALARS.get(str(schema.get("type")))
    if schema.get("type") == "array":
        # A tuple, such as a size, has no single kind of item, and no field.
        choices = _choices(_resolved(schema.get("items", {}), whole))
        kind = "several" if choices else None
    if kind is None:
        return None
    return Setting(
        name=name,
        kind=kind,
        text=schema.get("description", ""),
        cost=schema.get("x-cost", ""),
        default=schema.get("default"),
        choices=choices,
        low=schema.get("minimum"),
        high=schema.get("maximum"),
        is_whole=schema.get("type") == "integer",
    )


def _choices(schema: Schema) -> tuple[str, ...]:
    names = schema.get("enum") or ([schema["const"]] if "const" in schema else [])
    return tuple(map(str, names))


def _axes(spec_type: type[JobSpec], schema: Schema, scene: Scene | None) -> list[Axis]:
    """Return the axes: parameters of the scene first, then those of the schema."""
    axes: list[Axis] = []
    if scene is not None:
        for name, parameter in scene.parameters.items():
            default = scene.default(name)
            is_number = isinstance(default, float)
            choices = () if is_number else tuple(map(str, parameter.values or Material))
            axes.append(
                Axis(
                    name=name,
                    text=parameter.description,
                    is_required=False,
                    is_number=is_number,
                    choices=choices,
                    range=parameter.range if is_number else "",
                    default=f"{default:g}" if is_number else str(default),
                    can_draw=not is_number and not parameter.values,
                )
            )
    of_axes = _resolved(schema["properties"]["axes"], schema)
    required = of_axes.get("required", ())
    for name, raw in of_axes["properties"].items():
        axes.append(_axis(name, _resolved(raw, schema), schema, name in required))
        if not axes[-1].is_number and not axes[-1].choices:
            axes[-1] = _with_names(axes[-1], spec_type, scene)
    return axes


def _axis(name: str, schema: Schema, whole: Schema, is_required: bool) -> Axis:
    """Return an axis of the schema, whose first alternative is one value."""
    forms = [_resolved(part, whole) for part in schema["anyOf"]]
    value = forms[0]
    # Names are one of the built-in ones, or the name of a custom one.
    parts = [_resolved(part, whole) for part in value.get("anyOf", [value])]
    choices = tuple(choice for part in parts for choice in _choices(part))
    is_number = any(part.get("type") in ("number", "integer") for part in parts)
    ends = [value[key] for key in ("minimum", "maximum") if key in value]
    return Axis(
        name=name,
        text=schema.get("description") or value.get("description", ""),
        is_required=is_required,
        is_number=is_number,
        choices=choices,
        range=" to ".join(f"{end:g}" for end in ends),
        can_draw=any("distribution" in part.get("properties", ()) for part in forms),
    )


def _with_names(axis: Axis, spec_type: type[JobSpec], scene: Scene | None) -> Axis:
    """Return an axis of names with those that the kind, or the scene, has built in."""
    # Only what `built_in` reads is there: a whole spec needs the axes that the form asks for.
    bare = spec_type.model_construct(scene=scene, set={}, viewpoints={})  # type: ignore[call-arg]
    built_in = getattr(bare, "built_in", None)
    choices = () if built_in is None else tuple(built_in(axis.name))
    return Axis(axis.name, axis.text, axis.is_required, axis.is_number, choices)


# ---- The spec from the fields --------------------------------------------------------------------


def document_of(form: SubmitForm, sent: Sent) -> dict[str, Any]:
    """Return the document of a spec as a user has filled in its form; raise FormError.

    Values are as they were written: whether they fit is for the model of the spec to say.
    """
    document: dict[str, Any] = {"kind": form.kind}
    name = _text(sent, "name")
    if name:
        document["name"] = name
    if form.scene is not None:
        document["scene"] = form.scene
    axes = {axis.name: _axis_value(axis, sent) for axis in form.axes}
    document["axes"] = {name: value for name, value in axes.items() if value is not None}
    for setting in form.settings:
        value = _setting_value(setting, sent)
        if value is not None and value != setting.default:
            document[setting.name] = value
    for key, value in _more(sent).items():
        both_are_maps = isinstance(value, dict) and isinstance(document.get(key), dict)
        document[key] = {**document[key], **value} if both_are_maps else value
    return document


def _text(sent: Sent, name: str) -> str:
    return (sent.get(name) or [""])[0].strip()


def _scalar(text: str) -> int | float | str:
    """Return a number, or the text itself if it is none."""
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text


def _axis_value(axis: Axis, sent: Sent) -> object:
    """Return the value of an axis as a spec writes it; None if its fields are empty."""
    name = f"axes.{axis.name}"
    if axis.can_draw and (num := _text(sent, f"{name}.num")):
        return {"distribution": "measured-618", "num": _scalar(num)}
    if axis.choices:
        chosen = [value for value in sent.get(f"{name}.values", ()) if value]
        return _short(chosen)
    form = _text(sent, f"{name}.form") or "values"
    if form == "values":
        words = [word for word in _SEPARATORS.split(_text(sent, f"{name}.values")) if word]
        return _short([_scalar(word) if axis.is_number else word for word in words])
    if form not in RANGE_ENDS:
        raise FormError(name, f"must be one of {', '.join(AXIS_FORMS)}, and is {form[:50]!r}")
    parts = {key: _text(sent, f"{name}.{key}") for key in ("from", "to", "num")}
    if not any(parts.values()):
        return None
    first, last = RANGE_ENDS[form]
    keys = {first: parts["from"], last: parts["to"], "num": parts["num"]}
    # An empty part is left out, and the model says that it is required.
    return {"type": form, **{key: _scalar(text) for key, text in keys.items() if text}}


def _short(values: Sequence[object]) -> object:
    """Return the short form of a list: its only value, or None for an empty one."""
    if not values:
        return None
    return values[0] if len(values) == 1 else values


def _setting_value(setting: Setting, sent: Sent) -> object:
    if setting.kind == "flag":
        # A browser sends nothing for a box that is not ticked.
        return bool(sent.get(setting.name))
    if setting.kind == "several":
        return [value for value in sent.get(setting.name, ()) if value] or None
    text = _text(sent, setting.name)
    if not text:
        return None
    return _scalar(text) if setting.kind == "number" else text


def _more(sent: Sent) -> dict[str, Any]:
    text = _text(sent, "more")
    if not text:
        return {}
    try:
        document = parse_yaml(text)
    except yaml.YAMLError as error:
        raise FormError("more", f"is not YAML: {' '.join(str(error).split())[:300]}") from error
    if not isinstance(document, dict):
        raise FormError("more", "must be keys of a spec with their values, such as `seed: 7`")
    # Tags such as `!!binary` and `!!set` make values that a spec, which is JSON, cannot hold.
    try:
        json.dumps(document)
    except TypeError as error:
        raise FormError("more", f"must have values that JSON has, too: {error}") from error
    return document


def field_of(form: SubmitForm, pointer: str) -> str:
    """Return the name of the field that a JSON pointer into the spec leads to; empty for none."""
    parts = pointer.split("/")[1:]
    while parts:
        name = ".".join(parts)
        if name in form.names:
            return name
        parts.pop()
    return ""


def spec_yaml(document: Mapping[str, Any]) -> str:
    """Return a document as YAML, in the order of its keys."""
    return yaml.safe_dump(
        dict(document), sort_keys=False, allow_unicode=True, default_flow_style=None
    )


def grouped(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the values of each field of a form."""
    sent: dict[str, list[str]] = {}
    for name, value in pairs:
        sent.setdefault(name, []).append(value)
    return sent
