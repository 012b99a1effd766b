"""Files of a run: tensors, and its report."""

import io
import json
import platform
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import torch
from stickslip_schemas.store import write_durably

from stickslip_training import __version__

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MODEL_NAME = "model.pt"
REPORT_NAME = "report.json"


def save_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_durably(path, buffer.getvalue())


def load_tensors(path: str | Path, *, device: str = "cpu") -> dict[str, Any]:
    """Return what `save_tensors` wrote; nothing but tensors and plain values is ever loaded."""
    content: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    return content


def write_report(out: Path, report: "DataclassInstance") -> None:
    """Write the report of a run below `out`, whole or not at all; a number that is none raises ValueError."""
    text = json.dumps(asdict(report), indent=2, allow_nan=False, default=str)
    write_durably(out / REPORT_NAME, f"{text}\n".encode())


def versions() -> dict[str, str]:
    """Return the versions of what a run's numbers depend on."""
    return {
        "stickslip-training": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }
