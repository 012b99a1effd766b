"""Permissions, the log of changes, and the programs that receive job events."""
