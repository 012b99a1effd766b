"""Hanging rods: equilibria, what they look like, and the way back to their natural shape."""
