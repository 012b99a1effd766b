"""Processes on this machine: `stickslip up`, the workers' program for certificates, locks, sockets
and logs.
"""
