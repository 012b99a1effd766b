"""The products: dataset versions and certificates."""
