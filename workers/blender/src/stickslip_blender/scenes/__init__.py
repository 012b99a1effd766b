"""The scenes of all kinds: one module per kind, named after it."""
