"""What holds for the tests of all components: tiers, groups for parallel runs, and what each test costs.

`make test-fast` runs the tests without the markers `slow`, `real` and `physics`, and fails one that takes more CPU time
than `--cpu-limit`. With `--cpu-report FILE` every test's CPU time [s] is written to a JSON file, longest first.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

for _name in ("STICKSLIP_DATABASE", "STICKSLIP_STORE"):  # no test is to write into what is in use
    os.environ.pop(_name, None)

GROUPS = {"service": "service", "cluster": "ray", "postgresql": "postgresql", "database": "postgresql"}
"""Fixtures that start a server once a process, and the group of their tests: xdist runs a group in one process. These
tests are marked `real`."""

CPU_SECONDS = pytest.StashKey[float]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cpu-limit", type=float, help="fail a test whose call takes more CPU time than this [s]")
    parser.addoption("--cpu-report", type=Path, help="write the CPU time of every test to this JSON file [s]")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        names = getattr(item, "fixturenames", ())
        for fixture, group in GROUPS.items():
            if fixture in names and (fixture != "database" or "postgresql" in item.name):
                item.add_marker(pytest.mark.xdist_group(group))
                item.add_marker(pytest.mark.real)
                break


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Count the CPU time of the call, with that of processes that it started and waited for."""
    before = sum(os.times()[:4])
    yield
    item.stash[CPU_SECONDS] = sum(os.times()[:4]) - before
    limit = item.config.getoption("--cpu-limit")
    if limit is not None and item.stash[CPU_SECONDS] > limit:
        pytest.fail(
            f"took {item.stash[CPU_SECONDS]:.1f} CPU s, a fast test may take {limit:g}: mark it or make it quick"
        )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[pytest.TestReport]:
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
        file.write_text(json.dumps(dict(sorted(_costs.items(), key=lambda cost: -cost[1])), indent=1))
