"""Write docs/spec.md, the reference of every key of a spec, from the models that check specs.

python tools/spec_reference.py > docs/spec.md
"""

import json
import sys
from collections.abc import Iterator
from typing import Any

from stickslip_schemas.base.document import Document
from stickslip_schemas.kinds import KINDS
from stickslip_schemas.spec.appearance import Calibration, FloorNumbers, LampNumbers
from stickslip_schemas.spec.fabrics import FabricNumbers

HEAD = """# Every key of a spec

<!-- Written by tools/spec_reference.py from the models that check specs; do not edit. -->

A spec is a YAML or JSON document. It names a `kind` and the axes of a parameter grid. This page lists every key, with
its range, its unit and what it costs. `stickslip validate FILE` checks a spec and counts its samples, also offline.
Every CPU time on this page is of one core of a shared virtual AMD EPYC; [measurements](measurements.md) say how it was
measured.

## Axes

Each axis of a grid has one of these forms:

| form | example | values |
|---|---|---|
| one value | `0.5` | that value |
| list | `[0.1, 0.2]` | these values; no value twice |
| linspace | `{type: linspace, start: 0, stop: 1, num: 5}` | `num` equal steps from `start` to `stop`, both included |
| random | `{type: random, low: 0, high: 1, num: 5, seed: 0}` | `num` independent uniform values in [low, high) |
| sobol | `{type: sobol, low: 0, high: 1, num: 5, seed: 0}` | `num` values of a scrambled Sobol sequence |

An axis of names, such as `material`, takes one name or a list. A job has at most 1,000,000 samples.
"""


def reference() -> str:
    """Return the page."""
    return "\n".join(
        [
            HEAD,
            *(part for kind in KINDS.values() for part in _kind(kind)),
            *(part for entry in CUSTOM for part in _custom(*entry)),
        ]
    )


def _kind(kind: Any) -> Iterator[str]:
    schema = kind.model_json_schema()
    axes = schema["$defs"][schema["properties"]["axes"]["$ref"].rpartition("/")[2]]
    yield f"## `{schema['properties']['kind']['const']}`\n"
    yield f"{kind.__doc__.splitlines()[0]}\n"
    yield "Axes, under `axes`:\n"
    yield "| axis | values | meaning |"
    yield "|---|---|---|"
    for name, axis in axes["properties"].items():
        alternatives = axis.get("anyOf", [axis])
        value = _resolved(alternatives[0] if "anyOf" in axis else axis, schema)
        if "anyOf" in value:
            value = _resolved(value["anyOf"][0], schema)
        meaning = axis.get("description") or value.get("description", "")
        required = "" if name in axes.get("required", ()) else " (optional)"
        yield f"| `{name}`{required} | {_allowed(value)} | {_first_line(meaning)} |"
    yield "\nOther keys:\n"
    yield "| key | values | default | meaning | cost |"
    yield "|---|---|---|---|---|"
    for name, field in schema["properties"].items():
        if name not in ("axes", "kind"):
            yield _field_row(name, field, schema)
    yield ""


CUSTOM: tuple[tuple[str, str, type[Document]], ...] = (
    ("materials", "fabric", FabricNumbers),
    ("viewpoints", "camera", Calibration),
    ("lamps", "lamp", LampNumbers),
    ("substrates", "floor", FloorNumbers),
)
"""What a spec may define: its key, what one entry is, and the model of an entry."""


def _custom(key: str, what: str, model: type[Document]) -> Iterator[str]:
    schema = model.model_json_schema()
    meaning = " ".join((model.__doc__ or "").split("\n\n", 1)[-1].split())
    yield f"## Custom {what}s\n"
    yield f"An entry of `{key}` names a {what} and gives its numbers. {meaning}\n"
    yield "| key | values | default | meaning | cost |"
    yield "|---|---|---|---|---|"
    for name, field in schema["properties"].items():
        yield _field_row(name, field, schema)
    yield ""


_MAPPINGS = ("textures", *(key for key, _, _ in CUSTOM))


def _field_row(name: str, field: dict[str, Any], schema: dict[str, Any]) -> str:
    value = _resolved(field, schema)
    default = json.dumps(field["default"]) if "default" in field else "" if "anyOf" in field else "required"
    meaning = field.get("description") or value.get("description", "")
    default = "`{}`" if name in _MAPPINGS else f"`{default}`" if default not in ("", "required") else default
    cells = (f"`{name}`", _allowed(value), default, _first_line(meaning), field.get("x-cost", ""))
    return f"| {' | '.join(cells)} |"


def _resolved(value: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a value, without references, and of what may be null what it is otherwise."""
    found = value
    if "$ref" in found:
        found = {**schema["$defs"][found["$ref"].rpartition("/")[2]], **{k: v for k, v in found.items() if k != "$ref"}}
    kinds = [kind for kind in found.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) == 1:
        nullable = {"x-null": True, **{k: v for k, v in found.items() if k != "anyOf"}}
        return {**_resolved(kinds[0], schema), **nullable}
    return found


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
    words = {"number": "number", "integer": "integer", "boolean": "`true`, `false`", "object": "mapping"}
    kind = words.get(value.get("type", ""), "name" if value.get("type") == "string" else "list")
    return (f"{kind} {', '.join(bounds)}" if bounds else kind) + null


def _first_line(text: str) -> str:
    return text.strip().split("\n\n")[0].replace("\n", " ").replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(reference())
