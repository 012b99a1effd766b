"""The program that runs an adapter: `PYTHON host.py ADAPTER.py`, in the simulator's environment.

It answers the requests of process.py over its standard input and output. It imports the standard
library and NumPy only, and nothing of this package but two files beside it.
"""

from __future__ import annotations  # Python 3.9 reads the types below as text

import hashlib
import importlib.abc
import importlib.util
import logging
import os
import platform
import site
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

FOLDER = Path(__file__).resolve().parent

LOGGER = logging.getLogger("stickslip_measure")

REASON_LENGTH = 160
"""Most characters of an exception that a cell shows."""

CLEARANCE = 0.0
GAP = 5e-4

REQUIRED = ("name", "version", "capabilities", "settings")
"""Attributes of the class that have no default."""


class RuleError(Exception):
    """The adapter misses a part of the contract. Its message needs no name of an exception."""


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


def reason_of(error: Exception, adapter: Path) -> str:
    """Return an exception as one short line with its place; the log has all of it."""
    lines = str(error).strip().splitlines() or [""]
    if isinstance(error, RuleError):
        return lines[0]
    text = f"{type(error).__name__}: {lines[0]}".strip().rstrip(":")
    if len(text) > REASON_LENGTH:
        text = f"{text[:REASON_LENGTH]}..."
    # The last line of the adapter itself: below it stand lines of its simulator.
    numbers = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename) == adapter
    ]
    return f"{text} ({adapter.name}, line {numbers[-1]})" if numbers else text


class Sources:
    """Digests of the files of modules that an adapter imports, and that are not installed.

    These are the adapter, what lies beside it, and all that stands outside of the standard library
    and site-packages: a result is old if one of them has changed.

    Args:
        adapter: The file of the adapter.
    """

    def __init__(self, adapter: Path) -> None:
        self.folder = adapter.parent
        self.installed = installed_places()
        self.modules = 0
        self.names: set[str] = set()

    def additions(self) -> dict[str, str]:
        """Return the digests (SHA-256) of files that were imported since the last call, by path."""
        # A look at all modules costs as much as a step of a small scene.
        if len(sys.modules) == self.modules:
            return {}
        self.modules = len(sys.modules)
        digests = {}
        for module in list(sys.modules.values()):
            # `getattr` would load modules that wait to be used.
            name = getattr(module, "__dict__", {}).get("__file__")
            digests.update(self.addition(name))
        return digests

    def addition(self, name: Any) -> dict[str, str]:
        """Return the digest of the file of a module, by path, unless it is known or installed."""
        if not isinstance(name, str) or name in self.names:
            return {}
        self.names.add(name)
        path = Path(name).resolve()
        if not self.belongs(path):
            return {}
        return {str(path): hashlib.sha256(path.read_bytes()).hexdigest()}

    def belongs(self, path: Path) -> bool:
        """Return whether the file of a module decides results beside the simulator's version."""
        # The messages and the contract are this package's.
        if path.parent == FOLDER or not path.is_file():
            return False
        return path.parent == self.folder or not any(
            place in path.parents for place in self.installed
        )


def installed_places() -> list[Path]:
    """Return the folders of the standard library and of installed packages."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    places = [sysconfig.get_paths()[name] for name in names]
    places += [*site.getsitepackages(), site.getusersitepackages()]
    return [Path(place).resolve() for place in places]


class ImportWatch(importlib.abc.MetaPathFinder):
    """Names each module before it is run, so that a module that crashes or hangs is known as well.

    It finds nothing itself: it asks the finders behind it in `sys.meta_path`.

    Args:
        adapter: The file of the adapter.
        sources: The files that are known.
        tell: Takes the digests of a file that was not, by path.
    """

    def __init__(
        self, adapter: Path, sources: Sources, tell: Callable[[dict[str, str]], None]
    ) -> None:
        self.adapter = adapter
        self.sources = sources
        self.tell = tell

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        """Return the specification of a module, or None if no other finder has it.

        Raises:
            ModuleNotFoundError: Only the adapter itself has this name.
        """
        behind = sys.meta_path[sys.meta_path.index(self) + 1 :]
        for finder in behind:
            # Finders of old packages lack the method, and Python skips them too.
            find = getattr(finder, "find_spec", None)
            spec = None if find is None else find(name, path, target)
            if spec is None:
                continue
            if spec.has_location:
                self.see(name, spec.origin)
            return spec
        return None

    def see(self, name: str, origin: str) -> None:
        """Name the file of a module, unless it is known.

        Raises:
            ModuleNotFoundError: The file is the adapter.
        """
        # An adapter often has the name of its simulator, which may not be installed.
        if Path(origin).resolve() == self.adapter:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        digests = self.sources.addition(origin)
        if digests:
            self.tell(digests)


class Host:
    """Answers requests about one adapter. It runs at most one scene."""

    def __init__(self, adapter: Path, replies: BinaryIO) -> None:
        self.contract = load(FOLDER / "contract.py", "stickslip_contract")
        self.wire = load(FOLDER / "wire.py", "stickslip_wire")
        self.adapter = adapter
        self.replies = replies
        # A simulator may import a module in a thread of its own.
        self.sending = threading.Lock()
        self.sources = Sources(adapter)
        sys.meta_path.insert(0, ImportWatch(adapter, self.sources, self.send_sources))
        self.simulator: Any = None
        self.run: Any = None

    def answer(self, header: dict[str, Any], arrays: list[Any]) -> None:
        """Reply to a request: send its result, or the error of the adapter."""
        verbs = {"describe": self.describe, "start": self.start, "advance": self.advance}
        try:
            reply, results = verbs[header["verb"]](header, arrays)
        except Exception as error:
            # Whatever an adapter raises is a result of the measurement: the reason of a cell.
            LOGGER.exception("the adapter raised")
            reply = {"error": reason_of(error, self.adapter)}
            results = []
        reply["cpu"] = time.process_time()
        reply["sources"] = self.sources.additions()
        self.send(reply, results)

    def send(self, header: dict[str, Any], arrays: list[Any]) -> None:
        """Send a message to the measurement."""
        message = self.wire.encoded(header, arrays)
        with self.sending:
            self.replies.write(message)
            self.replies.flush()

    def send_sources(self, digests: dict[str, str]) -> None:
        """Send the digests of files that are about to be imported, by path."""
        self.send({"imports": digests}, [])

    def describe(self, header: dict[str, Any], arrays: list[Any]) -> tuple[Any, list[Any]]:
        """Import the adapter, and return its description of itself."""
        # An adapter may import files beside it. They come last: an adapter often has the name of
        # the simulator that it imports.
        sys.path.append(str(self.adapter.parent))
        # No finder looks for the adapter itself.
        self.send_sources(self.sources.addition(str(self.adapter)))
        self.simulator = simulator_of(load(self.adapter, "stickslip_adapter"))
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
            # A step that hangs is then known by its number.
            self.send({"ended": True}, [])
        return {}, [np.stack(frames)]

    def positions(self) -> Any:
        """Return a copy of the positions: a simulator may hand out its own array."""
        return np.array(self.run.positions(), dtype=np.float64)


def simulator_of(module: Any) -> Any:
    """Return the class of an adapter.

    Raises:
        RuleError: It has another name, or misses an attribute.
    """
    simulator = getattr(module, "Simulator", None)
    if simulator is None:
        classes = [
            name
            for name, value in vars(module).items()
            if isinstance(value, type) and value.__module__ == module.__name__
        ]
        raise RuleError(
            f"adapter: must define the class Simulator, got {', '.join(classes) or 'no class'}"
        )
    missing = [name for name in REQUIRED if not hasattr(simulator, name)]
    if missing:
        raise RuleError(f"adapter: the class Simulator must have {', '.join(missing)}")
    return simulator


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
    host = Host(Path(sys.argv[1]), replies)
    requests = sys.stdin.buffer
    while True:
        header, arrays = host.wire.read_message(lambda size: read_exactly(requests, size))
        host.answer(header, arrays)


if __name__ == "__main__":
    main()
