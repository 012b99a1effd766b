"""Scenes as data: what stands where, how it moves, what it looks like, and what may vary."""
