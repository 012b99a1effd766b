"""Make the thesis's 160 cloth simulations through the service, with the certificate.

The script reports the cost of the simulations.

    .venv/bin/python examples/thesis_cloth_simulations.py [--out DIR] [--certificate DIR]

Certifies the preset first; give `--certificate` to use a certificate that `stickslip certify` has
already written. You can stop the script and start it again: it goes on where it was. Pictures are
kept to a few of low quality: the trajectories stay in the store, and a later job with other
textures and views uses them.
"""

import argparse
import json
import sqlite3
from pathlib import Path

import numpy as np
import zarr
from demo import console, run, service, submit

SPEC = Path(__file__).with_name("thesis-cloth-simulations.yaml")
DATABASE = Path("service") / "coordinator.sqlite3"


def main() -> None:
    """Certify, simulate, pull, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("thesis-cloth-out"))
    parser.add_argument(
        "--certificate", type=Path, help="what `stickslip certify --preset certified` wrote"
    )
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True)
    with service(args.out / "service") as url:
        if args.certificate is None:
            run(
                "stickslip",
                "certify",
                "--preset",
                "certified",
                "--out",
                args.out / "certificate",
                "--url",
                url,
            )
        else:
            run("stickslip", "register", args.certificate, "--url", url)
        dataset = submit(SPEC, url)
        run("stickslip", "pull", dataset, args.out / "dataset", "--url", url)
    run("stickslip", "verify", args.out / "dataset")
    report(args.out)


def report(out: Path) -> None:
    """Print the CPU seconds of the simulations, and how many of their steps did not converge."""
    with sqlite3.connect(f"file:{out / DATABASE}?mode=ro", uri=True) as database:
        rows = database.execute(
            "SELECT payload, cpu_seconds FROM tasks "
            "WHERE stage = 'simulate' AND state = 'succeeded'"
        )
        simulations = [(json.loads(payload), seconds) for payload, seconds in rows]
    costs = np.array([seconds for _, seconds in simulations])
    names = [f"{document['material']}, mu {document['mu']:g}" for document, _ in simulations]
    labels = zarr.open_group(out / "dataset", mode="r")
    valid = np.asarray(labels["valid"])
    steps, unconverged = (
        np.asarray(labels[name])[valid] for name in ("steps", "unconverged_steps")
    )
    fractions = unconverged / steps
    median = np.median(costs)
    console.rule("cost")
    console.print(
        f"{len(costs)} simulations, {costs.sum() / 3600:.2f} CPU h; median {median:.1f} CPU s"
    )
    for i in np.argsort(costs)[::-1][:5]:
        console.print(f"  {costs[i]:6.1f} CPU s, {costs[i] / median:.1f} x the median: {names[i]}")
    console.print(
        f"steps that did not converge: {unconverged.sum()} of {steps.sum()}; "
        f"at most {100 * fractions.max():.3f} % of one simulation; "
        f"in {np.count_nonzero(unconverged)} of {len(steps)} valid samples; "
        f"{np.count_nonzero(~valid)} were rejected"
    )


if __name__ == "__main__":
    main()
