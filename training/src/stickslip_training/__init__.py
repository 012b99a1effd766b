"""Read stickslip datasets and train on them. See the modules, one concept each; `reader` needs no torch."""

__version__ = "0.1.0"
