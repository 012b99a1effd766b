"""Names: random names, and the names of tasks, `<stage>-<content key>`."""

import secrets

from stickslip_schemas.base import Stage, is_sha256


def new_id(prefix: str) -> str:
    """Return a new, unguessable name such as `job-4f1c09d3a2b87e65`."""
    return f"{prefix}-{secrets.token_hex(8)}"


def task_id(stage: str, key: bytes) -> str:
    """Return the name of a task outside the database."""
    return f"{stage}-{key.hex()}"


def task_key(name: str) -> bytes | None:
    """Return the content key in the name of a task, or None for any other text."""
    stage, _, key = name.partition("-")
    if stage not in list(Stage) or not is_sha256(key):
        return None
    return bytes.fromhex(key)
