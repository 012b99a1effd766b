"""All use of Blender: its engine and device, the objects of a scene, and the pixels of a frame."""
