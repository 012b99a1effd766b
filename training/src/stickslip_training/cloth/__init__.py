"""Friction and material of dragged cloth from video, with how sure the answer is."""
