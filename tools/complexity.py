"""Refuse functions of the core whose cognitive complexity is above 25, by clang-tidy.

    python tools/complexity.py [FILE ...]

Without files it reads all sources of the core, which takes a CPU minute. Headers are read with the
sources that include them.
"""

import argparse
import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

CORE = Path(__file__).resolve().parents[1] / "sim_core"
THRESHOLD = 25
"""Largest cognitive complexity of a function, by the rule of clang-tidy."""

CHECK = "readability-function-cognitive-complexity"

# Kernels are compiled once for each level: the first stands for all.
KERNEL_DEFINITIONS = (
    "-DROD_KERNELS=rods_baseline",
    "-DCLOTH_KERNEL=cloth_baseline",
    '-DKERNEL_LEVEL="baseline"',
    "-DROD_LANES=2",
    "-DCLOTH_FLOATS=4",
)


def compile_flags() -> list[str]:
    """Return the flags that a source needs to be read, with headers from this environment."""
    packages = Path(sysconfig.get_paths()["purelib"])
    system = [
        packages / "cmeel.prefix/include/eigen3",
        packages / "nanobind/include",
        Path(sysconfig.get_paths()["include"]),
    ]
    return [
        "-std=c++20",
        f"-I{CORE / 'src'}",
        *(f"-isystem{directory}" for directory in system),
        *KERNEL_DEFINITIONS,
    ]


def read(source: Path) -> tuple[list[str], str]:
    """Return the warnings about a source, and what clang-tidy says if it cannot read it."""
    tidy = subprocess.run(
        [
            Path(sys.executable).with_name("clang-tidy"),
            "--quiet",
            f"--checks=-*,{CHECK}",
            f"--config={{CheckOptions: {{{CHECK}.Threshold: {THRESHOLD}}}}}",
            f"--header-filter={re.escape(str(CORE))}/src/.*",
            source,
            "--",
            *compile_flags(),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    warnings = [line for line in tidy.stdout.splitlines() if CHECK in line]
    return warnings, tidy.stdout + tidy.stderr if tidy.returncode else ""


def sources() -> Iterator[Path]:
    """Yield the sources of the core that are compiled wherever the core is."""
    for source in sorted((CORE / "src").rglob("*.cpp")):
        # Its macro names are written by CMake, and it binds functions that stand elsewhere.
        if source.name != "module.cpp":
            yield source


def main(arguments: Sequence[str]) -> int:
    """Print the functions that are too complex, and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    files = parser.parse_args(arguments).files or list(sources())
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(read, files))
    for _, failure in results:
        if failure:
            print(failure)
            return 2
    # A header is read with each source that includes it.
    warnings = sorted({line for lines, _ in results for line in lines})
    print("\n".join(warnings) or f"no function of {len(files)} files is above {THRESHOLD}")
    return 1 if warnings else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
