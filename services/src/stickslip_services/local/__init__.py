"""Processes on this machine: `stickslip up`, the workers' program, locks, sockets and logs."""
