"""Exports to HDF5, WebDataset, Parquet, LeRobot, and OBJ meshes."""
