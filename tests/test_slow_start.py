"""`stickslip up` where Python imports slowly."""

import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness import Service, wait_for

SPEC: dict[str, Any] = yaml.safe_load(
    (Path(__file__).parents[1] / "examples" / "demo-rods.yaml").read_text()
)
RAY = str(Path(sys.executable).with_name("ray"))
SLOW = """
import os, sys, time
line = " ".join(sys.orig_argv)
if os.environ["SLOW"] == "all" or "agent" in line:
    time.sleep({"all": 20, "agents": 25}[os.environ["SLOW"]])
"""

# One after the other, and after those of test_chaos.py: each waits for minutes, alone.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.real,
    pytest.mark.timeout(1500),
    pytest.mark.xdist_group("chaos"),
]


@pytest.mark.parametrize("module", ["agents", "all"])
def test_a_machine_that_imports_slowly(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every Python process takes 20 s to start, or every agent of Ray 25 s."""
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("SLOW", module)
    service = Service(tmp_path / "data")
    service.start()
    try:
        job = service.submit(SPEC)

        def waits() -> bool | None:
            conditions = [worker["condition"] for worker in service.get("/v1/workers")]
            return (
                True
                if any("waiting for Ray" in condition["reason"] for condition in conditions)
                else None
            )

        wait_for("the reason", waits, 120)
        assert service.finished(job, 300)["state"] == "succeeded"
        assert service.get("/v1/workers")[0]["condition"]["state"] == "ready"
    finally:
        service.stop()
