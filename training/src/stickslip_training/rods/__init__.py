"""Curvature of hanging rods: networks that estimate it from a centreline, and what needs no
learning.
"""
