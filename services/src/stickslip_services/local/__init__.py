"""What runs on this machine: processes, sockets, logs, the certifying program."""
