"""Answer a test set of rods by our methods, in one file of predictions each.

`stickslip-train benchmark score` reads the files.

    python benchmarks/training/rod_entries.py INPUTS.npz OUT [--table-5-1 MODEL.pt]

INPUTS.npz is of `stickslip-train benchmark inputs`. The network answers where its file is given.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _library in ("OMP", "OPENBLAS", "MKL"):  # threads that wait for one another count as CPU time
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402
import torch  # noqa: E402
from stickslip_sim_core import fit_natural_curvature, fit_parameters  # noqa: E402
from stickslip_training.rods import curvature as table_5_1  # noqa: E402
from stickslip_training.rods.evaluation import (  # noqa: E402
    bending,
    cubic_spline_curvature,
    estimate_strains,
    finite_difference_curvature,
    quintic_spline_curvature,
)

Lines = npt.NDArray[np.float32]
Answer = dict[str, Any]


def at_once(method: Callable[[Lines], npt.NDArray[np.float64]]) -> Callable[[Lines], list[Answer]]:
    """Return a method that knows no gamma as answers."""
    return lambda lines: [{"bending": row.tolist()} for row in np.round(method(lines), 5)]


def network(net: torch.nn.Module) -> Callable[[Lines], npt.NDArray[np.float64]]:
    """Return a trained network as a method."""
    return lambda lines: bending(estimate_strains(net, lines))


def rod_by_rod(fit: Callable[[Any], Any]) -> Callable[[Lines], list[Answer]]:
    """Return a fit of `stickslip_sim_core` as answers.

    Null where no rod nearby hangs in a stable equilibrium.
    """

    def answers(lines: Lines) -> list[Answer]:
        answers: list[Answer] = []
        for line in lines.astype(np.float64):
            try:
                fitted = fit(line)
            except RuntimeError:
                answers.append({"bending": None})
                continue
            curvature = bending(fitted.solution.curvature[0])
            answers.append(
                {"bending": np.round(curvature, 5).tolist(), "gamma": float(fitted.gamma)}
            )
        return answers

    return answers


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("inputs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table-5-1", type=Path)
    args = parser.parse_args()
    with np.load(args.inputs) as file:
        slots = file["slot"].tolist()
        noises = file["noise"].tolist()
        lines = file["centerline"]
    methods = {
        "finite-differences": at_once(finite_difference_curvature),
        "cubic-spline": at_once(cubic_spline_curvature),
        "quintic-spline": at_once(quintic_spline_curvature),
        "three-parameter-fit": rod_by_rod(fit_parameters),
        "distributed-fit": rod_by_rod(fit_natural_curvature),
    }
    if args.table_5_1 is not None:
        methods["table-5-1"] = at_once(network(table_5_1.load_model(args.table_5_1).eval()))
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for name, method in methods.items():
        started = time.process_time()
        answers = [
            {"slot": slot, "noise": noise, **answer}
            for noise, noisy_lines in zip(noises, lines, strict=True)
            for slot, answer in zip(slots, method(noisy_lines), strict=True)
        ]
        (args.out / f"{name}.json").write_text(json.dumps(answers) + "\n")
        print(
            f"{name}: {1e3 * (time.process_time() - started) / len(answers):.2f} CPU ms a rod",
            flush=True,
        )


if __name__ == "__main__":
    main()
