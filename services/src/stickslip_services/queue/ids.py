"""Names: random ones, and those of tasks, `<stage>-<content key>`.

And digests of rows (`recompute`).
"""

import hashlib
import json
import secrets

from stickslip_schemas.base import Stage, is_sha256


def new_id(prefix: str) -> str:
    """Return a new, unguessable name such as `job-4f1c09d3a2b87e65`."""
    return f"{prefix}-{secrets.token_hex(8)}"


SAMPLE_COLUMNS = ("job", "slot", "key", "simulate_task", "render_task", "split", "labels")
"""Columns of `samples` that its digest covers."""


def row_digest(*values: object) -> int:
    """Return 63 bits of a digest of the values of a row."""
    text = json.dumps(values, default=bytes.hex)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest()) >> 1


def task_id(stage: str, key: bytes) -> str:
    return f"{stage}-{key.hex()}"


def task_key(name: str) -> bytes | None:
    """Return the content key in the name of a task; None for any other text."""
    stage, _, key = name.partition("-")
    if stage not in list(Stage) or not is_sha256(key):
        return None
    return bytes.fromhex(key)
