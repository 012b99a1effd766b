"""Time and memory of `:validate` for a grid of a million samples, over HTTP.

    python benchmarks/validate.py

Prints one JSON object: medians of 5 [s], and the peak resident memory of the coordinator [MB].
Targets: 0.5 s, 200 MB.
"""

import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from plan import coordinator, peak_megabytes, spec


def main() -> None:
    """Measure and print."""
    product = spec(1_000_000, start=0.0)
    product["axes"]["gamma"]["num"] = 10_000
    axis = {"type": "linspace", "start": 0.0, "stop": 10.0, "num": 1_000_000}
    zipped = {
        "kind": "rod_hang",
        "combine": "zip",
        "axes": dict.fromkeys(("gamma", "phi0", "phi1"), axis),
    }
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as data, coordinator(Path(data)) as (client, pid):
        for name, document in (("product", product), ("zip", zipped)):
            times = []
            for _ in range(5):
                begin = time.perf_counter()
                answer = client.post("/v1/jobs:validate", json=document).raise_for_status().json()
                times.append(time.perf_counter() - begin)
            assert answer["simulation_count"] == 1_000_000
            result[f"{name}_seconds"] = round(statistics.median(times), 4)
            result[f"{name}_peak_mb"] = round(peak_megabytes(pid), 1)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
