"""All use of Blender: its engine and device, what stands in a scene, and the pixels of a frame."""
