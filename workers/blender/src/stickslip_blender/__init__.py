"""Render stickslip's simulations with headless Blender. The only distribution that imports bpy."""
