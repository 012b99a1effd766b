"""Scenes: what is simulated. The module of a kind of simulations offers it as `KIND`."""
