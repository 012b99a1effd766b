"""Parts of specs: axes, looks, cameras, fabrics, and the arrays that follow."""
