"""Scopes of keys, and names of projects."""

import re
from enum import StrEnum

from stickslip_services.errors import CommandError


class Scope(StrEnum):
    """What a key permits. `submit` includes `read`; `admin` includes everything."""

    read = "read"
    """Read what belongs to the project of the key: jobs, datasets, pages."""
    submit = "submit"
    """Submit jobs, and pause, resume, cancel and prioritise them."""
    work = "work"
    """Be a worker: register, lease tasks and report results."""
    admin = "admin"
    """Everything of all projects, and register certificates."""


_IMPLIED = {
    Scope.read: {Scope.read},
    Scope.submit: {Scope.submit, Scope.read},
    Scope.work: {Scope.work},
    Scope.admin: set(Scope),
}


def includes(granted: Scope, needed: Scope) -> bool:
    return needed in _IMPLIED[granted]


def check_project(name: str) -> str:
    """Return the name of a project; raise CommandError where it is malformed."""
    if re.fullmatch(r"([a-z0-9][a-z0-9-]{0,62})?", name) is None:
        raise CommandError(f"project must be lower-case letters, digits and '-', 63 at most; got {name[:100]!r}")
    return name
