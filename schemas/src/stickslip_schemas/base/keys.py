"""Content keys: SHA-256 of the canonical JSON of exactly what a result depends on."""

import hashlib
import json
import re
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field

KEY_PATTERN = r"^[0-9a-f]{64}$"

Sha256 = Annotated[str, Field(pattern=KEY_PATTERN, description="SHA-256, 64 lower-case hexadecimal digits")]


def canonical_json(value: Any) -> str:
    """Return the one JSON text of `value`: sorted keys, no spaces, shortest round-trip floats, -0.0 as 0.0.

    NaN and infinities raise ValueError, for they have no JSON form.
    """
    return json.dumps(_normalised(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def content_key(purpose: str, value: Any) -> str:
    """Return the SHA-256 of `value`, kept apart by `purpose` so that two kinds of thing never share a key."""
    return sha256(keyed_text(purpose, canonical_json(value)).encode())


def keyed_text(purpose: str, canonical: str) -> str:
    """Return the text whose SHA-256 is the content key of a value with the canonical JSON `canonical`."""
    return f"stickslip/{purpose}\n{canonical}"


def derived_seed(seed: int, purpose: str, value: Any) -> int:
    """Return a seed in [0, 2**31) that depends on `seed` and on what it is for, never on a position in a grid."""
    return seed_of_key(content_key(f"seed/{purpose}", {"seed": seed, "for": value}))


def seed_of_key(key: str) -> int:
    """Return the seed in [0, 2**31) that a content key gives."""
    return int(key[:15], 16) % 2**31


def sha256(data: bytes) -> str:
    """Return the SHA-256 of `data` in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def is_sha256(text: str) -> bool:
    return re.fullmatch(KEY_PATTERN, text) is not None


ARTIFACT = "sha256:"
"""How a reference to an artifact begins, where a name might stand as well."""

ArtifactRef = Annotated[
    str, Field(pattern=r"^sha256:[0-9a-f]{64}$", description="`sha256:` and the SHA-256 of an artifact")
]


def referred(name: str) -> Sha256 | None:
    """Return the digest that a reference to an artifact names; None where `name` is a name."""
    return name.removeprefix(ARTIFACT) if name.startswith(ARTIFACT) else None


def placed(document: Any, place: Sequence[str | int], value: Any) -> Any:
    """Return a copy of a JSON document with another value at a place; positions in lists may be texts."""
    if not place:
        return value
    step, *rest = place
    if isinstance(document, list):
        return [placed(item, rest, value) if at == int(step) else item for at, item in enumerate(document)]
    return {**document, step: placed(document[step], rest, value)}


def _normalised(value: Any) -> Any:
    if isinstance(value, float):
        return value + 0.0  # -0.0 + 0.0 is 0.0
    if isinstance(value, dict):
        return {key: _normalised(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_normalised(item) for item in value]
    return value
