"""Read stickslip datasets and train on them.

See the modules, one concept each; `reader` needs no torch.
"""

from importlib.metadata import version

__version__ = version("stickslip-training")
