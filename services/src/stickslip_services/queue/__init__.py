"""The durable queue: from a spec to tasks, leases and results."""
