"""Rules for the tests of all components: tiers, groups for parallel runs, costs.

`make test-fast` runs the tests without the markers `slow`, `real` and `physics`, and fails one that
takes more CPU time than `--cpu-limit`. With `--cpu-report FILE` every test's CPU time [s] is
written to a JSON file, longest first.
"""

import gc
import json
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from _pytest.nodeid import NodeId

# No test may write into a store in use, and pytest-xdist sets the size of a terminal.
for _name in ("STICKSLIP_DATABASE", "STICKSLIP_STORE", "COLUMNS", "LINES"):
    os.environ.pop(_name, None)

os.environ.setdefault(
    "RAY_worker_niceness", "0"
)  # 15 by default: the other tests would starve those that use Ray
os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # threads of NumPy and torch wait by spinning, which the other tests pay

# Tests started by nohup or in the background of a shell ignore these signals, and what they start
# would, too: then no test of a signal could pass.
for _signal, _handler in (
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGINT, signal.default_int_handler),
):
    if signal.getsignal(_signal) == signal.SIG_IGN:
        signal.signal(_signal, _handler)

SERVERS = {"service": "service", "cluster": "ray", "postgresql": "postgresql", "s3": "s3"}
"""Fixtures that start a server, and the group of the tests that share it. These tests are marked
`real`.
"""

PERTURBATION = 4e-16
"""Largest change of `--perturb`, relative to a coordinate: two units of rounding, by which sines of
other processors differ. Only a chaotic motion shows it.
"""

CPU_SECONDS = pytest.StashKey[float]()
LAST_OF = pytest.StashKey[list[str]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--cpu-limit", type=float, help="fail a test whose call takes more CPU time than this [s]"
    )
    parser.addoption(
        "--cpu-report", type=Path, help="write the CPU time of every test to this JSON file [s]"
    )
    parser.addoption(
        "--perturb",
        type=int,
        metavar="SEED",
        help="round the starts of cloth differently, as another processor may",
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep the garbage collector from imported objects: it would take a tenth of the time."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let one process run all tests that share a server or a module's fixture; sort the modules.

    Long rows of tests come first, then tests that wait or take long: no process is left with them
    when the others are done.
    """
    turns: dict[Path, tuple[bool, float, bool, bool]] = {}
    for item in items:
        scopes = {
            name: found[-1].scope for name, found in item._fixtureinfo.name2fixturedefs.items()
        }
        if "database" in scopes and "postgresql" in item.name:
            scopes["postgresql"] = "session"
        servers = [name for name in SERVERS if name in scopes]
        if servers:
            item.add_marker(pytest.mark.real)
        mark = item.get_closest_marker("xdist_group")
        if hasattr(item.config, "workerinput"):  # of xdist
            shared = [SERVERS[name] for name in servers if scopes[name] == "session"]
            shared += [item.nodeid.partition("::")[0]] if "module" in scopes.values() else []
            if group := mark.args[0] if mark else next(iter(shared), None):
                # What xdist 3.8 does at `item._nodeid`, which pytest 9.2 no longer reads.
                item._id = NodeId.parse(f"{item.nodeid}@{group}")
        patience = item.get_closest_marker("timeout")
        is_other = [item.get_closest_marker(name) is None for name in ("real", "physics")]
        turn = (mark is None, -patience.args[0] if patience else 0, *is_other)
        turns[item.path] = min(turn, turns.get(item.path, turn))
    items.sort(key=lambda item: turns[item.path])


def pytest_collection_finish(session: pytest.Session) -> None:
    """Note the last test of each server."""
    last = {
        name: item
        for item in session.items
        for name in SERVERS
        if name in item._fixtureinfo.name2fixturedefs
    }
    for name, item in last.items():
        item.stash.setdefault(LAST_OF, []).append(name)


@pytest.fixture(autouse=True)
def perturbed_starts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Move the starts of cloth if `--perturb` asks for it: no bound may hang on a chaotic motion.

    NumPy and the C library round differently on other processors. A sheet that crumples goes
    another way there, and a test must hold on each of these ways.
    """
    seed = request.config.getoption("--perturb")
    if seed is None:
        return
    # The root conftest also serves components that do without the core.
    import numpy as np
    from stickslip_sim_core import Cloth

    set_state = Cloth.set_state

    def set_perturbed_state(
        cloth: Cloth, positions: object, *arguments: Any, **options: Any
    ) -> None:
        exact = np.asarray(positions, float)
        # The same start twice is displaced alike: reruns are compared bit by bit.
        noise = np.random.default_rng(seed).uniform(-PERTURBATION, PERTURBATION, exact.shape)
        # Held vertices are where their holders are, which the test moves itself.
        noise[cloth.held] = 0.0
        set_state(cloth, exact * (1.0 + noise), *arguments, **options)

    monkeypatch.setattr(Cloth, "set_state", set_perturbed_state)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[object]:
    """Let the handlers of logging that a test adds end with it: their stream does, too."""
    root = logging.getLogger()
    handlers = list(root.handlers)
    level = root.level
    result = yield
    root.handlers[:] = handlers
    root.setLevel(level)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Stop a server when its last test is over: an idle Ray takes a tenth of a processor."""
    yield
    for name in item.stash.get(LAST_OF, ()):
        item._fixtureinfo.name2fixturedefs[name][-1].finish(item._request)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Count the CPU time of the call, with that of processes that it started and waited for."""
    before = sum(os.times()[:4])
    yield
    item.stash[CPU_SECONDS] = sum(os.times()[:4]) - before
    limit = item.config.getoption("--cpu-limit")
    if limit is not None and item.stash[CPU_SECONDS] > limit:
        seconds = item.stash[CPU_SECONDS]
        pytest.fail(
            f"took {seconds:.1f} CPU s, a fast test may take {limit:g}: mark it or make it quick"
        )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Iterator[pytest.TestReport]:
    report = yield
    if report.when == "call" and CPU_SECONDS in item.stash:
        report.user_properties.append(("cpu_seconds", round(item.stash[CPU_SECONDS], 2)))
    return report


_costs: dict[str, float] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    for name, value in report.user_properties:
        if name == "cpu_seconds":
            _costs[report.nodeid] = float(str(value))


def pytest_sessionfinish(session: pytest.Session) -> None:
    file = session.config.getoption("--cpu-report")
    if file is not None and not hasattr(session.config, "workerinput"):
        file.write_text(
            json.dumps(dict(sorted(_costs.items(), key=lambda cost: -cost[1])), indent=1)
        )
