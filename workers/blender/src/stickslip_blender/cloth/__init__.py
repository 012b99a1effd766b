"""Clips of cloth: geometry, looks, shading, and the renderer of every scene of cloth."""
