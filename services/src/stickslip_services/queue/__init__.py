"""The durable queue: from a spec to tasks, leases and results.

Jobs, each verb in a module:

- `estimate`, `submit`: what a spec would cost, and its submission.
- `planner`, `plan`, `insertion`: when a job is planned, its tasks, and their rows.
- `control`: cancel, pause, resume, prioritise, retry. `heartbeat` has what a pause or a
  cancellation does to tasks that workers hold.
- `job_states`: how a job starts, pauses, ends and publishes.
- `jobs`, `progress`, `eta`, `totals`, `task_log`: a job as users see it.
- `leaving`, `background`: ended jobs leave the queue; all work by the clock.

Tasks, in the order of their life:

- `ready`: the queue of tasks that can run now.
- `scheduler`: who gets the next task: which project, which of its jobs, which task of the job.
- `lease`: workers register and get tasks; also what happens if the answer to a lease is lost.
- `documents`: the work of a task, composed when it is leased.
- `heartbeat`: leases are renewed; workers hear which tasks to drop, started or not.
- `results`, `dependents`: a report, and the tasks that it makes ready.
- `failures`, `rerun`: leases that end without a result (returned, expired, failed), and results
  that are damaged or gone.

Data: `rows` has the typed rows and the sets of states, `transaction` the write lock, `integrity`
damaged rows, `existing_datasets` and `scrub` damaged files, `backup` and `maintenance` the rest of
an operator's work.
"""
