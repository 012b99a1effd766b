"""Cloth: fabrics, meshes, contact, and the solver."""
