"""Scenes: the simulations of each kind. `KIND` of the module of a kind runs them."""
