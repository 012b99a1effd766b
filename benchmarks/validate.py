"""Time and memory of `:validate` for a grid of a million samples, over HTTP.

    python benchmarks/validate.py

Prints one JSON object: medians of 5 [s], and the peak resident memory of the coordinator [MB]. Targets: 0.5 s, 200 MB.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
from plan import peak_megabytes, spec
from stickslip_schemas.builds import Builds


def main() -> None:
    """Measure and print."""
    product = spec(1_000_000, start=0.0)
    product["axes"]["gamma"]["num"] = 10_000
    axis = {"type": "linspace", "start": 0.0, "stop": 10.0, "num": 1_000_000}
    zipped = {"kind": "rod_hang", "combine": "zip", "axes": dict.fromkeys(("gamma", "phi0", "phi1"), axis)}
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as data:
        command = [sys.executable, "-m", "stickslip_services.coordinator", "--data", data, "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as coordinator:
            assert coordinator.stdout is not None
            url = coordinator.stdout.readline().split()[-1]
            with httpx.Client(base_url=url, timeout=120) as client:
                worker = {
                    "name": "bench",
                    "builds": {"rod_hang": dict.fromkeys(Builds.model_fields, "a" * 64)},
                    "slots": 1,
                }
                key = {"Authorization": f"Bearer {(Path(data) / 'worker-key').read_text().strip()}"}
                client.post("/v1/workers", json=worker, headers=key).raise_for_status()
                for name, document in (("product", product), ("zip", zipped)):
                    times = []
                    for _ in range(5):
                        begin = time.perf_counter()
                        answer = client.post("/v1/jobs:validate", json=document).raise_for_status().json()
                        times.append(time.perf_counter() - begin)
                    assert answer["simulation_count"] == 1_000_000
                    result[f"{name}_seconds"] = round(statistics.median(times), 4)
                    result[f"{name}_peak_mb"] = round(peak_megabytes(coordinator.pid), 1)
            coordinator.terminate()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
