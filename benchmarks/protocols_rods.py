"""Acceptance of the rod solver on the physical protocols.

It prints errors against the master curves, and costs.

python benchmarks/protocols_rods.py [--figures FOLDER]

Prints one table per protocol. CPU seconds are those of the process, one thread; the master curves
are part of them. With --figures the pictures of docs/protocols.md are drawn, too (needs
matplotlib).
"""

import argparse
import os
import platform
import time
from pathlib import Path

# NumPy's threads only disturb: the matrices are small.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from stickslip_sim_core import build_info, protocols
from stickslip_sim_core.protocols import ProtocolResult
from stickslip_sim_core.reference import master_curves


def report(result: ProtocolResult, seconds: float) -> None:
    print(
        f"\n{result.protocol}: {'passed' if result.passed else 'FAILED'}, tolerance "
        f"{result.tolerance:g}",
        end="",
    )
    print(
        f", largest error {result.error:.1e}, settings {dict(result.settings)}, {seconds:.2f} CPU s"
    )
    for curve in result.curves:
        print(
            "  "
            + (", ".join(f"{name} {value:g}" for name, value in curve.parameters.items()) or "all")
        )
        print(f"  {result.x_name:>12} {'measured':>16} {'master':>16} {'error':>9}")
        for x, measured, master, error in zip(
            curve.x, curve.measured, curve.master, curve.errors, strict=True
        ):
            print(f"  {x:12.6g} {measured:16.9g} {master:16.9g} {error:9.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--figures", type=Path, help="folder to draw the pictures of the documentation into"
    )
    figures = parser.parse_args().figures

    build = build_info()
    print(
        f"stickslip-sim-core {build.version}  build {build.build_hash[:12]}  {build.compiler}  isa "
        f"{build.isa}"
    )
    print(
        f"numpy {np.__version__}  python {platform.python_version()}  load {os.getloadavg()[0]:.1f}"
    )
    results = []
    for name in [name for name in protocols.PROTOCOLS if name in protocols.ROD_PROTOCOLS]:
        start = time.process_time()
        results.append(protocols.run(name))
        report(results[-1], time.process_time() - start)

    print("\nonset of the three-dimensional window")
    for poisson in (0.0, 0.3, 0.5):
        phi, gamma = master_curves.bend_twist_onset(poisson)
        print(f"  poisson {poisson:g}: phi {phi:.9f} = {phi / np.pi:.6f} pi, Gamma {gamma:.7f}")

    if figures:
        import plots

        figures.mkdir(parents=True, exist_ok=True)
        for result in results:
            plots.plot(result).savefig(figures / f"{result.protocol}.png")


if __name__ == "__main__":
    main()
