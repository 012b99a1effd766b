"""Datasets in formats that other libraries read: HDF5, WebDataset, and Parquet for Hugging Face `datasets`."""
