"""Run the code of the notebook, cell by cell, where nothing but the wheel and matplotlib is.

`python run_notebook.py NOTEBOOK` needs no Jupyter, and writes the pictures nowhere.
"""

import json
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")


def main() -> None:
    """Run all cells in one namespace. An exception names the cell that raised it."""
    document = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    namespace: dict[str, object] = {"__name__": "__main__"}
    for cell in document["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"cell {cell['id']}", "exec"), namespace)
    # What the text promises, in numbers.
    fit = namespace["fit"]
    error = abs(fit.gamma - 50.0) / fit.standard_error[0]  # type: ignore[attr-defined]
    assert error < 4.0, f"gamma is {error:.1f} standard errors off"
    assert namespace["run"].valid  # type: ignore[attr-defined]
    rest = namespace["heights"][-1]  # type: ignore[index]
    assert abs(rest) < 1e-3, f"the patch rests at {rest} m"


if __name__ == "__main__":
    main()
