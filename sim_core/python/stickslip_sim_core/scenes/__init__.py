"""Scenes: the simulations of each kind. `KIND` in the module of a kind runs them."""
