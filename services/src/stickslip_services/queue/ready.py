"""The queue of tasks that can run now: a row of `ready_tasks` for each active job that needs one.

Code that makes a task ready, or ends that, calls one of these two functions. A task is ready while
it is `pending` and all its dependencies have results.
"""

from collections.abc import Iterable

from sqlalchemy import Connection, bindparam, text

from stickslip_services.database.statements import Statement, batches

# CROSS JOIN keeps SQLite's order of loops: from the few tasks to their jobs.
_ADD = Statement(
    text(
        "INSERT INTO ready_tasks (task, job, stage, cost_group) "
        "SELECT tasks.seq, job_tasks.job, tasks.stage, tasks.cost_group "
        "FROM tasks CROSS JOIN job_tasks CROSS JOIN jobs "
        "WHERE tasks.seq IN :b_tasks AND tasks.state = 'pending' AND tasks.waiting_on = 0 "
        "AND job_tasks.task = tasks.seq AND jobs.seq = job_tasks.job "
        "AND jobs.finished_at IS NULL AND jobs.state != 'cancelling' "
        "ON CONFLICT DO NOTHING"
    ).bindparams(bindparam("b_tasks", expanding=True))
)
_REMOVE = Statement(
    text("DELETE FROM ready_tasks WHERE task IN :b_tasks").bindparams(
        bindparam("b_tasks", expanding=True)
    )
)


def add_ready(connection: Connection, tasks: Iterable[int]) -> None:
    """Put the tasks that can run into the queue of each active job that needs them."""
    for batch in batches(tasks):
        _ADD.run(connection, {"b_tasks": batch})


def remove_ready(connection: Connection, tasks: Iterable[int]) -> None:
    """Take tasks out of the queue of all jobs."""
    for batch in batches(tasks):
        _REMOVE.run(connection, {"b_tasks": batch})
