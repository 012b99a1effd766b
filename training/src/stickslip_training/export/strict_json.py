"""JSON that every parser reads.

RFC 8259 has no NaN and no infinity. Python writes them all the same, and most parsers of other
languages refuse the file. They become null here. A binary array beside the JSON keeps the exact
value in every format that has one.
"""

import json
import math
from typing import Any


def strict_json(value: Any, *, indent: int | None = None) -> str:
    """Return a value as JSON; a number that is not finite is null."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    """Return plain data with None in place of each number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
