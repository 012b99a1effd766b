"""Pictures of rods: the tube, its colour, and the renderer."""
