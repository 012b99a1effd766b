"""Servers and helpers that the tests of several distributions share."""
