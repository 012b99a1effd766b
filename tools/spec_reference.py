"""Write docs/spec.md, the reference of every key of a spec, from the models that check specs.

python tools/spec_reference.py > docs/spec.md
"""

import json
import sys
from collections.abc import Iterable
from typing import Any

from stickslip_schemas.base import Document
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.kinds.cloth.spec import ClipSpec
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.spec.fabrics import FabricDistribution, FabricNumbers, FabricRanges
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.spec.names import Calibration, FloorNumbers, LampNumbers

HEAD = """# Every key of a spec

<!-- Written by tools/spec_reference.py from the models that check specs; do not edit. -->

A spec is a YAML or JSON document with a `kind` and the axes of a parameter grid. This page lists
every key with its range, unit and cost. `stickslip validate FILE` checks a spec and counts its
samples, also without a service. CPU times are of one core of a shared virtual AMD EPYC
([measurements](measurements.md)).

## Axes

An axis, under `axes`, has one of these forms:

| form | example | values |
|---|---|---|
| one value | `0.5` | that value |
| list | `[0.1, 0.2]` | these values, without repetition |
| linspace | `{type: linspace, start: 0, stop: 1, num: 5}` | `num` even steps, both ends included |
| random | `{type: random, low: 0, high: 1, num: 5}` | `num` independent values in [low, high) |
| sobol | `{type: sobol, low: 0, high: 1, num: 5}` | `num` values of a scrambled Sobol sequence |

A random or Sobol axis may have a `seed`, 0 by default.

An axis of names, such as `material`, takes one name or a list. An axis of fabrics may draw them:
`{distribution: measured-618, num: 100}`, see [drawn fabrics](#drawn-fabrics). A job has
at most 1,000,000 samples.
"""

AXIS_HEAD = ("| axis | values | meaning |", "|---|---|---|")
KEY_HEAD = ("| key | values | default | meaning |", "|---|---|---|---|")

CUSTOM: tuple[tuple[str, str, type[Document]], ...] = (
    ("materials", "fabric", FabricNumbers),
    ("viewpoints", "camera", Calibration),
    ("lamps", "lamp", LampNumbers),
    ("substrates", "floor", FloorNumbers),
)
"""What a spec may define: its key, what one entry is, and the model of an entry."""

Rows = dict[str, str]
"""Rows of a table, by the name of the axis or key."""


def reference() -> str:
    """Return the page.

    Keys that all kinds share come first, then keys that all kinds of cloth share, then each kind,
    then custom entries.
    """
    keys = {name: _keys(kind) for name, kind in KINDS.items()}
    axes = {name: _axes(kind) for name, kind in KINDS.items()}
    cloth = [name for name, kind in KINDS.items() if issubclass(kind, ClipSpec)]
    every, every_cloth = _shared(keys.values()), _shared(keys[name] for name in cloth)
    cloth_axes = _shared(axes[name] for name in cloth)
    lines = [
        HEAD,
        "## Keys of every kind\n",
        *_table(KEY_HEAD, every),
        "## Keys of every kind of cloth\n",
    ]
    lines += _table(AXIS_HEAD, cloth_axes) + _table(KEY_HEAD, _without(every_cloth, every))
    for name, kind in KINDS.items():
        lines += [f"## `{name}`\n", f"{(kind.__doc__ or '').splitlines()[0]}\n"]
        known = {**every, **(every_cloth if name in cloth else {})}
        lines += _table(AXIS_HEAD, _without(axes[name], cloth_axes if name in cloth else {}))
        lines += _table(KEY_HEAD, _without(keys[name], known))
    for key, entry_name, model in CUSTOM:
        meaning = " ".join((model.__doc__ or "").split("\n\n", 1)[-1].split())
        schema = model.model_json_schema()
        rows = {
            name: _field_row(name, field, schema) for name, field in schema["properties"].items()
        }
        lines += [f"## Custom {entry_name}s\n", f"Entries of `{key}`. {meaning}\n"]
        lines += _table(KEY_HEAD, rows)
    return "\n".join(lines + _drawn_fabrics())


def _drawn_fabrics() -> list[str]:
    """Return the section of axes that draw fabrics."""
    lines = ["## Drawn fabrics\n"]
    for model in (FabricDistribution, FabricRanges):
        schema = model.model_json_schema()
        fields = schema["properties"].items()
        rows = {name: _field_row(name, field, schema) for name, field in fields}
        lines += [f"{' '.join((model.__doc__ or '').split())}\n", *_table(KEY_HEAD, rows)]
    return lines


def _shared(tables: Iterable[Rows]) -> Rows:
    """Return the rows that all tables have, in the order of the first table."""
    first, *further_tables = tables
    return {
        name: row
        for name, row in first.items()
        if all(table.get(name) == row for table in further_tables)
    }


def _without(table: Rows, known: Rows) -> Rows:
    return {name: row for name, row in table.items() if known.get(name) != row}


def _table(head: tuple[str, str], rows: Rows) -> list[str]:
    return [*head, *rows.values(), ""] if rows else []


def _axes(kind: type[JobSpec]) -> Rows:
    schema = kind.model_json_schema()
    axes = schema["$defs"][schema["properties"]["axes"]["$ref"].rpartition("/")[2]]
    rows = {}
    for name, axis in axes["properties"].items():
        alternatives = axis.get("anyOf", [axis])
        value = _resolved(alternatives[0] if "anyOf" in axis else axis, schema)
        if "anyOf" in value:
            value = _resolved(value["anyOf"][0], schema)
        meaning = axis.get("description") or value.get("description", "")
        required = "" if name in axes.get("required", ()) else " (optional)"
        rows[name] = f"| `{name}`{required} | {_allowed(value)} | {_first_line(meaning)} |"
    return rows


def _keys(kind: type[JobSpec]) -> Rows:
    schema = kind.model_json_schema()
    fields = {
        name: field for name, field in schema["properties"].items() if name not in ("axes", "kind")
    }
    if issubclass(kind, ClothDragSpec):
        fields["frames"] = {**fields["frames"], "maximum": kind.instants}
    return {name: _field_row(name, field, schema) for name, field in fields.items()}


def _field_row(name: str, field: dict[str, Any], schema: dict[str, Any]) -> str:
    value = _resolved(field, schema)
    meaning = field.get("description") or value.get("description", "")
    default = (
        "required" if name in schema["required"] else f"`{json.dumps(field.get('default', {}))}`"
    )
    cost = f". Cost: {field['x-cost']}" if "x-cost" in field else ""
    cells = (f"`{name}`", _allowed(value), default, _first_line(meaning) + cost)
    return f"| {' | '.join(cells)} |"


def _resolved(value: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a value with its references resolved.

    A nullable value becomes its other alternative.
    """
    resolved = value
    if "$ref" in resolved:
        resolved = {
            **schema["$defs"][resolved["$ref"].rpartition("/")[2]],
            **{k: v for k, v in resolved.items() if k != "$ref"},
        }
    kinds = [kind for kind in resolved.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) == 1:
        nullable = {"x-null": True, **{k: v for k, v in resolved.items() if k != "anyOf"}}
        return {**_resolved(kinds[0], schema), **nullable}
    return resolved


def _allowed(value: dict[str, Any]) -> str:
    null = " or null" if value.get("x-null") else ""
    if "enum" in value:
        return ", ".join(f"`{item}`" for item in value["enum"]) + null
    if "const" in value:
        return f"`{value['const']}`{null}"
    bounds = [
        *(f"≥ {value[key]:,g}" for key in ("minimum",) if key in value),
        *(f"> {value[key]:,g}" for key in ("exclusiveMinimum",) if key in value),
        *(f"≤ {value[key]:,.10g}" for key in ("maximum",) if key in value),
        *(f"< {value[key]:,.10g}" for key in ("exclusiveMaximum",) if key in value),
    ]
    words = {
        "number": "number",
        "integer": "integer",
        "boolean": "`true`, `false`",
        "object": "mapping",
    }
    kind = words.get(value.get("type", ""), "name" if value.get("type") == "string" else "list")
    if "anyOf" in value:
        kind = "a name, or a mapping"
    return (f"{kind} {', '.join(bounds)}" if bounds else kind) + null


def _first_line(text: str) -> str:
    return text.strip().split("\n\n")[0].replace("\n", " ").replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(reference())
