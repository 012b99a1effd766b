"""Datasets in formats that other libraries read: HDF5, WebDataset, Parquet, LeRobot, and OBJ
meshes.
"""
