"""Scenes as data: things, their motions and looks, and the parameters that may vary."""
