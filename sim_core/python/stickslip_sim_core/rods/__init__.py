"""Hanging rods: equilibria, labels of their shapes, and inverses to their natural shape."""
