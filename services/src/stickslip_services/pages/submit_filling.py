"""The submit form filled in with the spec of a job: the way back from a spec to its fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.pages.rendering import spec_document
from stickslip_services.pages.submit_form import (
    RANGE_ENDS,
    Axis,
    Setting,
    SubmitForm,
    form_of,
    spec_yaml,
)

_RANGE_PARTS = ("from", "to", "num")
"""Fields of an axis that is a range; a spec calls them by `RANGE_ENDS`, and `num`."""


@dataclass(frozen=True)
class Filling:
    """The values of the fields of a form."""

    fields: Mapping[str, list[str]] = field(default_factory=dict)
    is_of_a_job: bool = False
    """Without a job, the fields show their defaults."""
    has_scene_in_yaml: bool = False
    """The scene of the job is not built in, and stands under `more` with its parameters."""
    sets_more_axes: bool = False
    """The job has an axis that the form shows under "More axes"."""
    sets_more_settings: bool = False
    """The job has a setting that the form shows under "More settings"."""

    def first(self, name: str, default: object = "") -> str:
        """Return the value of a field; `default` if the form shows no job, and None is empty."""
        values = self.fields.get(name, [""] if self.is_of_a_job else [default])
        value = values[0] if values else ""
        return "" if value is None else str(value)

    def has(self, name: str, value: str, default: bool = False) -> bool:
        """Return whether a box of a field is ticked."""
        return value in self.fields.get(name, []) if self.is_of_a_job else default


def filled_form(spec: JobSpec) -> tuple[SubmitForm, Filling]:
    """Return the form of a spec, and the values of its fields.

    What has no field is YAML in the field `more`. So the form gives the spec again.
    """
    document = spec_document(spec)
    # A scene is the name of a built-in one, or a document, which has no field.
    is_built_in = isinstance(document.get("scene"), str)
    scene = document.pop("scene") if is_built_in else None
    form = form_of(spec.kind, scene)
    fields: dict[str, list[str]] = {"name": [document.pop("name", "")]}
    more: dict[str, Any] = {}
    axes = document.pop("axes")
    sets_more_axes = any(axis.name in axes for axis in form.more_axes)
    sets_more_settings = any(setting.name in document for setting in form.more_settings)
    known = {axis.name: axis for axis in form.axes}
    for name, value in axes.items():
        axis_fields = _axis_fields(known[name], value) if name in known else None
        if axis_fields is None:
            more.setdefault("axes", {})[name] = value
        else:
            fields |= axis_fields
    for setting in form.settings:
        # What the spec does not say has the default of its kind.
        value = document.pop(setting.name, setting.default)
        if value is None and setting.default is not None:
            # An empty field means the default, and not null.
            more[setting.name] = None
        fields[setting.name] = _setting_values(setting, value)
    more |= {name: value for name, value in document.items() if name != "kind"}
    fields["more"] = [spec_yaml(more) if more else ""]
    filling = Filling(
        fields,
        is_of_a_job=True,
        has_scene_in_yaml="scene" in more,
        sets_more_axes=sets_more_axes,
        sets_more_settings=sets_more_settings or bool(more),
    )
    return form, filling


def _axis_fields(axis: Axis, value: object) -> dict[str, list[str]] | None:
    """Return the fields of an axis; None if the form cannot write its value."""
    name = f"axes.{axis.name}"
    if isinstance(value, dict):
        return _range_fields(name, axis, value)
    values = [str(item) for item in (value if isinstance(value, list) else [value])]
    if axis.choices:
        # A custom texture, for example, has no box. Boxes are sent in their own order.
        in_order = [choice for choice in axis.choices if choice in values]
        return {f"{name}.values": values} if in_order == values else None
    return {f"{name}.form": ["values"], f"{name}.values": [", ".join(values)]}


def _range_fields(name: str, axis: Axis, value: dict[str, Any]) -> dict[str, list[str]] | None:
    """Return the fields of a range; None if it has a key that the form lacks, such as a seed."""
    ends = RANGE_ENDS.get(value["type"])
    if ends is None or not axis.is_number:
        return None
    keys = (*ends, "num")
    if set(value) != {"type", *keys}:
        return None
    parts = {
        f"{name}.{part}": [str(value[key])] for part, key in zip(_RANGE_PARTS, keys, strict=True)
    }
    return {f"{name}.form": [value["type"]], **parts}


def _setting_values(setting: Setting, value: object) -> list[str]:
    """Return what a browser sends for a setting."""
    if setting.kind == "flag":
        return ["yes"] if value else []
    if setting.kind == "several":
        return [str(item) for item in value] if isinstance(value, list | tuple) else []
    return ["" if value is None else str(value)]
