"""Specs and arrays that all kinds of cloth share."""
