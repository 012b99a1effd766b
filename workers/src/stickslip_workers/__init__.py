"""Workers run tasks: the dispatcher is a Ray driver, and the stages are functions.

- `dispatcher`: the loop that leases tasks, runs them and reports their results.
- `lease_client`: the worker API of the coordinator, the leases that are held, and their heartbeat.
- `batching`, `ray_calls`, `call`: which tasks run together, and how Ray runs them.
- `cluster`, `machine`, `process_log`: Ray's cluster, the speed of a machine, and logs of processes
  that died.
- `stages`: simulate, render, pack and publish. `commands`, `fitting` and `laboratory` run without
  a coordinator.
"""
