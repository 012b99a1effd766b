"""Datasets: where their bytes come from, what they must say, and what is read of them."""
