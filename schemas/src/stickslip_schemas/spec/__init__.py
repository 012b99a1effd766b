"""What a user may ask for: axes, looks, cameras, fabrics, and the arrays that follow."""
