"""Curvature of hanging rods: a network that estimates it, and methods without learning."""
