"""Datasets: opening, checking and reading them, and batches for PyTorch."""
