"""Drape and bending lengths of the built-in fabrics, beside published measurements.

python benchmarks/reality.py [--only-write]

It drapes each fabric with three distances of vertices and some seeds, and tests strips of it. What
benchmarks/results/reality.json has already is not run again: remove the file to measure all, in
about an hour of CPU time. Then it writes schemas' table of the fabrics and docs/reality.md.
"""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from stickslip_schemas.spec.reality import Reality, reality
from stickslip_sim_core.cloth.fabrics import Fabric, fabric, fabric_names
from stickslip_sim_core.lab.cantilever import cantilever
from stickslip_sim_core.lab.drape import drape

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/results/reality.json"
NEW_RECORD = {
    "what": "Cusick's drape and the cantilever test of the built-in fabrics, simulated",
    "command": "python benchmarks/reality.py",
    "commit": "",
    "conditions": "",
}
"""A record to begin with. You fill in the commit and the conditions."""

TABLE = ROOT / "schemas/src/stickslip_schemas/fabrics/measured.toml"
PAGE = ROOT / "docs/reality.md"

SEEDS = {20.0: (0, 1, 2), 10.0: (0, 1, 2), 5.0: (0,), 2.5: (0,)}
"""Seeds of the mesh by the distance of vertices [mm]: other seeds fold in other places."""
STATED = 5.0
"""Distance of vertices of the coefficients that the table of the fabrics states [mm]."""
FINEST = min(SEEDS)

BENDING_HEAD = ("fabric", "card, warp and weft [mm]", "cantilever, warp and weft [mm]")

Row = dict[str, Any]

TABLE_HEAD = """# Facts of the ten fabrics measured by [Wang et al. 2011]; each is one specimen.
# benchmarks/reality.py writes this file; numbers of the solver are in sim_core. density
# [kg/m^2]; bending: rigidities along the warp, along the weft, at 45 degrees [N m];
# bending_length: (D / rho g)^(1/3) along the warp and the weft [mm]; drape: coefficient of
# Cusick's test, simulated [%]; folds: of the draped disc.
"""


def measured(record: Row) -> Iterator[None]:
    """Measure what a record lacks, and yield after each measurement."""
    done = {(row["fabric"], row["cell_mm"], row["seed"]) for row in rows_of(record, "drape")}
    for cell, seeds in sorted(SEEDS.items(), reverse=True):
        for name in fabric_names():
            for seed in seeds:
                if (name, cell, seed) not in done:
                    record["rows"].append(draped(name, cell, seed))
                    yield
    tested = {row["fabric"] for row in rows_of(record, "cantilever")}
    for name in fabric_names():
        if name not in tested:
            lengths = [cantilever(fabric(name), way).bending_length for way in ("warp", "weft")]
            millimetres = [round(1e3 * length, 2) for length in lengths]
            record["rows"].append(
                {"test": "cantilever", "fabric": name, "bending_length_mm": millimetres}
            )
            yield


def rows_of(record: Row, test: str) -> list[Row]:
    """Return the rows of one of the two tests."""
    return [row for row in record["rows"] if row["test"] == test]


def draped(name: str, cell: float, seed: int) -> Row:
    """Return the result of a drape test."""
    began = time.process_time()
    result = drape(fabric(name), cell=1e-3 * cell, seed=seed)
    return {
        "test": "drape",
        "fabric": name,
        "cell_mm": cell,
        "seed": seed,
        "drape_percent": round(result.coefficient, 2),
        "folds": result.folds,
        "at_rest": result.at_rest,
        "unconverged_steps": result.unconverged,
        "vertices": len(result.positions),
        "cpu_seconds": round(time.process_time() - began, 1),
    }


def of_fabric(record: Row, name: str, cell: float, key: str) -> list[float]:
    """Return a number of all drape tests of a fabric with a distance of vertices [mm]."""
    rows = rows_of(record, "drape")
    return [row[key] for row in rows if row["fabric"] == name and row["cell_mm"] == cell]


def stiffness(sample: Fabric) -> tuple[float, float, float]:
    """Return the rigidities along the warp, along the weft, and at 45 degrees [N m]."""
    warp, weft, twist = np.diag(sample.rigidity)
    return float(warp), float(weft), float(twist + 0.25 * (warp + weft))


def table(record: Row) -> str:
    """Return the table of the fabrics for the schemas, as TOML."""
    parts = [TABLE_HEAD]
    for name in fabric_names():
        sample = fabric(name)
        rigidities = stiffness(sample)
        lengths = [1e3 * np.cbrt(d / (sample.density * 9.81)) for d in rigidities[:2]]
        parts.append(
            f'["{name}"]\n'
            f"density = {sample.density}\n"
            f"bending = [{', '.join(f'{d:.4g}' for d in rigidities)}]\n"
            f"bending_length = [{', '.join(f'{length:.1f}' for length in lengths)}]\n"
            f"drape = {fmean(of_fabric(record, name, STATED, 'drape_percent')):.1f}\n"
            f"folds = {round(fmean(of_fabric(record, name, STATED, 'folds')))}\n"
        )
    return "\n".join(parts)


def page(record: Row, facts: Reality) -> str:
    """Return docs/reality.md."""
    meaning = facts.yarn_meaning[0].upper() + facts.yarn_meaning[1:]
    return f"""# Beside measurements

<!-- Written by benchmarks/reality.py; do not edit. -->

The protocols compare the solver with formulas. This page compares it with measurements of real
things, as far as they are published. `make reality` measures the simulated side again. Facts are
of {facts.date}.

## Bending of the built-in fabrics

The laboratory pushes a strip of each fabric over an edge (ASTM D1388) and reads the bending
length that its card states. This tests the laboratory, and says nothing of the real fabric.

{markdown(BENDING_HEAD, bending_rows(record))}

## Drape

Cusick's test (BS 5058): a disc of 30 cm hangs over a pedestal of 18 cm. The drape coefficient is
the share of the overhanging ring that its shadow covers. Each number is the mean over the seeds
of a mesh, and the range behind it is that over the seeds. Where a fold begins is a matter of
chance, in the laboratory and here.

{markdown(drape_head(), drape_rows(record))}

{change_words(record, 10.0, STATED)}

{change_words(record, STATED, FINEST)}

Do not read a coefficient more finely than its change. The two largest changes to 5 mm are those of
the fabrics that stretch least, probably because flat triangles hinder the double curvature of folds
until cells are small beside a fold.

Nobody measured the drape of these ten specimens. Published coefficients of classes of fabrics:

{markdown(("class", "drape coefficient [%]", "source"), band_rows(facts))}

A built-in name is that of one specimen. `11oz-black-denim` has bending lengths of 16 to 20 mm and
is softer than the denim of the literature.

## Rods: photographs of yarn

The bending length by {facts.yarn_source}:

{markdown(("overhang [mm]", "bending length [mm]"), yarn_rows(facts))}

{meaning}.
Each number is the weighted mean of four or five photographs, which scatter by 2 to 5 mm at one
length. Residuals are 1.4 to 5.5e-3 L.

Nobody measured how level the camera was. One degree of roll changes the bending length by 0.9 mm at
100 mm and by 4 to 7 mm at 250 mm: the lower part of a long yarn hangs along gravity, and a wrong
direction of gravity reads as another stiffness. The longest pieces cannot say more than that.

## What the model leaves out

[What a label says](labels.md) lists the physics that the model does not have, with sizes.
"""


def changes(record: Row, coarse: float, fine: float) -> dict[str, float]:
    """Return the change of the mean coefficient between two meshes [points], by fabric.

    Fabrics that were not draped with both have none.
    """
    differences: dict[str, float] = {}
    for name in fabric_names():
        means = [of_fabric(record, name, cell, "drape_percent") for cell in (coarse, fine)]
        if all(means):
            differences[name] = fmean(means[1]) - fmean(means[0])
    return differences


def change_words(record: Row, coarse: float, fine: float) -> str:
    """Return a sentence on the change of the coefficients between two meshes."""
    differences = changes(record, coarse, fine)
    if not differences:
        return f"No fabric was draped with both {coarse:g} and {fine:g} mm."
    worst = max(differences, key=lambda name: abs(differences[name]))
    within = sum(abs(value) <= 2.0 for value in differences.values())
    return (
        f"From {coarse:g} to {fine:g} mm the mean changes by at most 2 points for {within} of the "
        f"{len(differences)} fabrics that were draped with both, and by {differences[worst]:+.1f} "
        f"points at most (`{worst}`)."
    )


def bending_rows(record: Row) -> Sequence[tuple[str, ...]]:
    """Return the rows of the bending lengths."""
    rows = []
    for row in rows_of(record, "cantilever"):
        sample = fabric(row["fabric"])
        card = [1e3 * np.cbrt(d / (sample.density * 9.81)) for d in stiffness(sample)[:2]]
        tested = ", ".join(f"{length:.1f}" for length in row["bending_length_mm"])
        rows.append((f"`{row['fabric']}`", ", ".join(f"{v:.1f}" for v in card), tested))
    return rows


def drape_head() -> tuple[str, ...]:
    """Return the head of the table of drape."""
    cells = (f"{cell:g} mm [%]" for cell in sorted(SEEDS, reverse=True))
    return ("fabric", *cells, f"folds at {STATED:g} mm")


def drape_rows(record: Row) -> Sequence[tuple[str, ...]]:
    """Return the rows of the drape coefficients."""
    rows = []
    for name in fabric_names():
        means = []
        for cell in sorted(SEEDS, reverse=True):
            values = of_fabric(record, name, cell, "drape_percent")
            spread = f" ({min(values):.1f} to {max(values):.1f})" if len(values) > 1 else ""
            means.append(f"{fmean(values):.1f}{spread}" if values else "not run")
        folds = round(fmean(of_fabric(record, name, STATED, "folds")))
        rows.append((f"`{name}`", *means, str(folds)))
    return rows


def band_rows(facts: Reality) -> Sequence[tuple[str, ...]]:
    """Return the rows of the published bands."""
    return [(band.name, f"{band.low:g} to {band.high:g}", band.source) for band in facts.bands]


def yarn_rows(facts: Reality) -> Sequence[tuple[str, ...]]:
    """Return the rows of the yarn."""
    return [
        (f"{fit.length:g}", f"{fit.bending_length:.1f} +- {fit.error:.1f}") for fit in facts.yarn
    ]


def markdown(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Measure what the record lacks, and write the table and the page."""
    parser = argparse.ArgumentParser(description="Drape and bending lengths beside measurements.")
    parser.add_argument("--only-write", action="store_true", help="measure nothing")
    only_write = parser.parse_args().only_write
    record = json.loads(RECORD.read_text()) if RECORD.exists() else dict(NEW_RECORD, rows=[])
    for _ in () if only_write else measured(record):
        # A measurement takes up to a minute: an interrupted run goes on where it was.
        RECORD.write_text(json.dumps(record, indent=1) + "\n")
    TABLE.write_text(table(record))
    PAGE.write_text(page(record, reality()))


if __name__ == "__main__":
    main()
