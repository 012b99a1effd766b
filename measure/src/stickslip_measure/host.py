"""The program that runs an adapter: `PYTHON host.py ADAPTER.py`, in the simulator's environment.

It answers the requests of process.py over its standard input and output. It imports the standard
library and NumPy only, and nothing of this package but two files beside it.
"""

from __future__ import annotations  # Python 3.9 reads the types below as text

import importlib.util
import logging
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

FOLDER = Path(__file__).resolve().parent

LOGGER = logging.getLogger("stickslip_measure")

REASON_LENGTH = 160
"""Most characters of an exception that a cell shows."""

CLEARANCE = 0.0
GAP = 5e-4


def load(path: Path, name: str) -> Any:
    """Import a file as the module `name`."""
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def reason_of(error: Exception) -> str:
    """Return an exception as one short line; the log has all of it."""
    lines = str(error).strip().splitlines() or [""]
    text = f"{type(error).__name__}: {lines[0]}".strip().rstrip(":")
    return text if len(text) <= REASON_LENGTH else f"{text[:REASON_LENGTH]}..."


class Host:
    """Answers requests about one adapter. It runs at most one scene."""

    def __init__(self, adapter: Path) -> None:
        self.contract = load(FOLDER / "contract.py", "stickslip_contract")
        self.wire = load(FOLDER / "wire.py", "stickslip_wire")
        self.adapter = adapter
        self.simulator: Any = None
        self.run: Any = None

    def answer(self, header: dict[str, Any], arrays: list[Any]) -> bytes:
        """Return the reply to a request: its result, or the error of the adapter."""
        verbs = {"describe": self.describe, "start": self.start, "advance": self.advance}
        try:
            reply, results = verbs[header["verb"]](header, arrays)
        except Exception as error:
            # Whatever an adapter raises is a result of the measurement: the reason of a cell.
            LOGGER.exception("the adapter raised")
            reply = {"error": reason_of(error)}
            results = []
        reply["cpu"] = time.process_time()
        return bytes(self.wire.encoded(reply, results))

    def describe(self, header: dict[str, Any], arrays: list[Any]) -> tuple[Any, list[Any]]:
        """Import the adapter, and return its description of itself."""
        # An adapter may import files beside it. They come last: an adapter often has the name of
        # the simulator that it imports.
        sys.path.append(str(self.adapter.parent))
        self.simulator = load(self.adapter, "stickslip_adapter").Simulator
        settings = {name: dict(facts) for name, facts in self.simulator.settings.items()}
        return {
            "name": str(self.simulator.name),
            "version": str(self.simulator.version),
            "capabilities": sorted(self.simulator.capabilities),
            "settings": settings,
            "clearance": float(getattr(self.simulator, "clearance", CLEARANCE)),
            "gap": float(getattr(self.simulator, "gap", GAP)),
            "damps": hasattr(self.simulator, "damp"),
            "python": platform.python_version(),
            "numpy": np.__version__,
        }, []

    def start(self, header: dict[str, Any], arrays: list[Any]) -> tuple[Any, list[Any]]:
        """Set a scene up, and return its frame and positions."""
        scene = self.wire.to_scene((header["scene"], arrays), self.contract)
        self.run = self.simulator(scene, header["setting"])
        return {"frame": float(self.run.frame)}, [self.positions()]

    def advance(self, header: dict[str, Any], arrays: list[Any]) -> tuple[Any, list[Any]]:
        """Take steps, each with its gravity (N, 3), and return all positions (N, V, 3)."""
        if header["damping"] is not None:
            self.run.damp(header["damping"])
        frames = []
        for gravity in arrays[0]:
            self.run.set_gravity(gravity)
            self.run.step()
            frames.append(self.positions())
        return {}, [np.stack(frames)]

    def positions(self) -> Any:
        """Return a copy of the positions: a simulator may hand out its own array."""
        return np.array(self.run.positions(), dtype=np.float64)


def read_exactly(stream: BinaryIO, size: int) -> bytes:
    """Read bytes; the end of the stream ends the program, because the measurement has ended."""
    content = stream.read(size)
    if len(content) < size:
        raise SystemExit(0)
    return content


def main() -> None:
    """Answer requests until the measurement closes the stream."""
    # What a simulator prints must not get between the replies.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # Files of this package must not hide modules of the simulator.
    sys.path[:] = [place for place in sys.path if Path(place or ".").resolve() != FOLDER]
    host = Host(Path(sys.argv[1]))
    requests = sys.stdin.buffer
    while True:
        header, arrays = host.wire.read_message(lambda size: read_exactly(requests, size))
        replies.write(host.answer(header, arrays))
        replies.flush()


if __name__ == "__main__":
    main()
