"""The builds that jobs were planned for, read and checked once each.

The builds of a planned job never change. A request for tasks needs the builds of all schedulable
jobs.
"""

from sqlalchemy import Connection, bindparam, select
from stickslip_schemas.plan.builds import Builds

from stickslip_services.database.statements import RowQuery
from stickslip_services.database.tables import jobs
from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.integrity import plan_inputs_of
from stickslip_services.queue.rows import JobRow, job_columns

_JOB = RowQuery(JobRow, select(*job_columns(JobRow)).where(jobs.c.seq == bindparam("b_job")))


class JobBuilds:
    """Builds by job, in memory."""

    def __init__(self) -> None:
        self._builds: dict[int, Builds] = {}
        self._damaged: dict[int, DamagedRowError] = {}
        """Jobs whose rows are damaged, so that nobody can say which workers serve them."""

    def read(self, connection: Connection, job: int) -> Builds | None:
        """Return the builds of a job, or None before its planning or if its row is damaged."""
        builds = self._builds.get(job)
        if builds is not None or job in self._damaged:
            return builds
        row = _JOB.first(connection, {"b_job": job})
        if row is None:
            return None
        try:
            inputs = plan_inputs_of(row)
        except DamagedRowError as error:
            # The next sweep ends the job (`background.fail_damaged_jobs`).
            self._damaged[job] = error
            return None
        if inputs is None:
            return None
        self._builds[job] = inputs.builds
        return inputs.builds

    def take_damaged(self) -> dict[int, DamagedRowError]:
        """Return the damaged jobs, and forget them."""
        damaged = self._damaged
        self._damaged = {}
        return damaged
