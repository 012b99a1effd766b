"""Run the everyday scenes of cloth at finer meshes, and print what came of them.

python benchmarks/everyday.py [CELLS ...]
"""

import sys
import time

from stickslip_testing.everyday import EVERYDAY


def main() -> None:
    """Print a row for each scene and mesh.

    Exit with 1 if one is neither right nor refused nor caught.
    """
    wrong = []
    print("| scene | cells | outcome | CPU s |\n|---|---|---|---|")
    for cells in [int(argument) for argument in sys.argv[1:]] or [8, 16]:
        for name, (scene, allowed) in EVERYDAY.items():
            begin = time.process_time()
            outcome = scene(cells)
            print(
                f"| {name} | {cells} | {outcome} | {time.process_time() - begin:.2f} |", flush=True
            )
            if outcome not in allowed:
                wrong.append(f"{name} at {cells} cells")
    if wrong:
        sys.exit(f"wrong: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
