"""Pieces of cloth: what they are made of, their meshes, and the solver that steps them."""
