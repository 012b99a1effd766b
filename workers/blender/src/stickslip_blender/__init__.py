"""Render the simulations of stickslip with headless Blender.

No other distribution imports bpy.
"""
