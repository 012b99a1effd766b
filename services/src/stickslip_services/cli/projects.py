"""Projects: listing them and setting their quotas, in the database of a data directory."""

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stickslip_services.cli.common import DEFAULT_DATA, DatabaseOption, DataOption, console, table
from stickslip_services.cli.errors import shows_errors
from stickslip_services.client.errors import ClientError
from stickslip_services.installed import require_server

if TYPE_CHECKING:
    from sqlalchemy import Connection

app = typer.Typer(help="List projects, and set their quotas.", no_args_is_help=True)

UNLIMITED = "any number"


def _visited(data: Path, database: str | None) -> AbstractContextManager["Connection"]:
    """Open the database of a coordinator, which may run, for a few rows."""
    require_server("projects")
    from stickslip_services.access.audit_log import visited  # the server's packages may be missing

    return visited(data, database)


@app.command("list")
@shows_errors
def list_(data: DataOption = DEFAULT_DATA, database: DatabaseOption = None) -> None:
    """List projects with their quotas, and what of these is taken by jobs that have not ended."""
    with _visited(data, database) as connection:
        from stickslip_services.access.projects import list_projects

        found = list_projects(connection)
    shown = table("project", "jobs", "at most", "samples", "at most", no_wrap=("project",))
    for project in found:
        shown.add_row(
            project.name or "(none)",
            f"{project.jobs:,}",
            _limit(project.max_jobs),
            f"{project.samples:,}",
            _limit(project.max_samples),
        )
    console().print(shown)


@app.command()
@shows_errors
def quota(
    name: Annotated[str, typer.Argument(metavar="PROJECT", help="'' is that of requests without a project")],
    samples: Annotated[int | None, typer.Option(min=0, help="of jobs that have not ended; without it, any")] = None,
    jobs: Annotated[int | None, typer.Option(min=0, help="that have not ended; without it, any number")] = None,
    data: DataOption = DEFAULT_DATA,
    database: DatabaseOption = None,
) -> None:
    """Set the quota of a project, from its next submission on. Jobs that are there go on."""
    with _visited(data, database) as connection:
        from stickslip_services.access.projects import set_quota

        try:
            set_quota(connection, name, max_samples=samples, max_jobs=jobs, now=time.time())
        except ValueError as error:
            raise ClientError(str(error)) from None
    whose = f"the project {name}" if name else "requests without a project"
    console().print(f"{whose}: at most {_limit(jobs)} jobs and {_limit(samples)} samples that have not ended")


def _limit(value: int | None) -> str:
    return UNLIMITED if value is None else f"{value:,}"
