"""What imports at run time: commands start quickly, and pictures are optional. import-linter checks
the rest.
"""

import pkgutil
import subprocess
import sys

import pytest
import stickslip_training

MODULES = [
    module.name
    for module in pkgutil.walk_packages(stickslip_training.__path__, "stickslip_training.")
]


def loaded(*modules: str) -> set[str]:
    """Return the packages that are loaded after the import of modules in a process of its own."""
    code = (
        "import importlib, sys; [importlib.import_module(name) for name in "
        "sys.argv[1:]]; print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *modules], capture_output=True, text=True, check=True
    )
    return {name.split(".")[0] for name in done.stdout.split()}


@pytest.mark.real
def test_optional_packages_are_imported_where_they_are_needed():
    assert len(MODULES) > 10
    assert not loaded(*MODULES) & {
        "matplotlib",
        "PIL",
        "av",
        "cv2",
        "h5py",
        "datasets",
        "pyarrow",
        "pxr",
        "obstore",
    }


@pytest.mark.real
def test_the_reader_and_the_command_need_no_torch():
    assert not loaded("stickslip_training.data.reader", "stickslip_training.cli") & {
        "torch",
        "scipy",
        "httpx",
    }
