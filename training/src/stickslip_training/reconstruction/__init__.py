"""From calibrated views of a hanging rod to its centreline [thesis, 5.3.1]."""

from stickslip_training.reconstruction.pipeline import Reconstruction, Verdict, reconstruct
from stickslip_training.reconstruction.silhouette import ReconstructionError

__all__ = ["Reconstruction", "ReconstructionError", "Verdict", "reconstruct"]
