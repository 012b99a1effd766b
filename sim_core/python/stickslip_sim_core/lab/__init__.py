"""A textile laboratory: tests of fabrics by the standards of the field, on simulated cloth."""
