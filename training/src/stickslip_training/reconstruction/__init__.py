"""From calibrated views of a hanging rod to its centreline [thesis, 5.3.1]."""
