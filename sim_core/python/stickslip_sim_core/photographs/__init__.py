"""Bending lengths of threads, yarns and wires that hang over a ledge, from photographs.

It needs OpenCV and SciPy, which the extra `photographs` brings.
"""
