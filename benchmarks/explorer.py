"""The page of a large dataset in Chromium: how long until it paints, and until its list has
followed a filter.

    python benchmarks/explorer.py [--samples 100000] [--repeat 9]

Makes a dataset of rods without pictures as `million.py publish` does. Prints one JSON object with
the first visit, the median of later ones [s], and the CPU time of the coordinator for each [s]. The
list waits until a slider has not moved for 100 ms, which is part of the time of a filter.
"""

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

from million import _coordinate, cpu_seconds
from plan import coordinator
from playwright.sync_api import sync_playwright

PAINT = """() => new Promise((done) => new PerformanceObserver((list) => {
  for (const entry of list.getEntriesByName("first-contentful-paint")) done(entry.startTime);
}).observe({ type: "paint", buffered: true }))"""

FILTER = """([value]) => new Promise((done) => {
  const from = document.querySelector("input[name='gamma.from']"), begin = performance.now();
  const end = () => requestAnimationFrame(() => done(performance.now() - begin));
  new MutationObserver((_, self) => { self.disconnect(); end(); })
    .observe(document.getElementById("thumbs"), { childList: true });
  from.value = value;
  from.dispatchEvent(new Event("input", { bubbles: true }));
})"""


def measure(samples: int, repeat: int) -> dict[str, Any]:
    """Make the dataset, and visit its page."""
    with tempfile.TemporaryDirectory() as directory, sync_playwright() as playwright:
        _coordinate(Path(directory), samples, 0.0)
        browser = playwright.chromium.launch(
            executable_path="/usr/bin/chromium", args=["--no-sandbox"]
        )
        with coordinator(Path(directory)) as (client, pid):
            (dataset,) = client.get("/v1/datasets").json()["items"]
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            paints, filters, cpu_paint, cpu_filter = [], [], [], []
            for turn in range(repeat):
                before = cpu_seconds(pid)
                page.goto(f"{client.base_url}/datasets/{dataset['id']}/v1")
                paints.append(page.evaluate(PAINT) / 1e3)
                between = cpu_seconds(pid)
                filters.append(page.evaluate(FILTER, [10 + turn]) / 1e3)
                cpu_paint.append(between - before)
                cpu_filter.append(cpu_seconds(pid) - between)
        browser.close()
    told = {"paint": paints, "filter": filters, "cpu_paint": cpu_paint, "cpu_filter": cpu_filter}
    return {"samples": samples} | {
        f"{name}_seconds": {
            "first": round(values[0], 3),
            "median": round(statistics.median(values[1:]), 3),
        }
        for name, values in told.items()
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--repeat", type=int, default=9, help="visits (default: %(default)s)")
    arguments = parser.parse_args()
    print(json.dumps(measure(arguments.samples, arguments.repeat), indent=2))


if __name__ == "__main__":
    main()
