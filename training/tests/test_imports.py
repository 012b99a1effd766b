"""The package stands alone: it needs neither what makes datasets nor what serves them."""

import pkgutil
import subprocess
import sys

import pytest
import stickslip_training

MODULES = [module.name for module in pkgutil.walk_packages(stickslip_training.__path__, "stickslip_training.")]

BLOCK = """
import importlib, sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Block())
for name in MODULES:
    importlib.import_module(name)
"""


def run(blocked, modules):
    code = f"BLOCKED = {set(blocked)!r}\nMODULES = {modules!r}\n{BLOCK}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.real
def test_everything_imports_without_what_makes_and_serves_datasets():
    blocked = ["ray", "bpy", "fastapi", "starlette", "sqlalchemy", "zarr", "tensorstore", "matplotlib"]
    blocked += ["stickslip_workers", "stickslip_services", "stickslip_sim_core", "stickslip_blender"]
    assert len(MODULES) > 10
    result = run(blocked, MODULES)
    assert result.returncode == 0, result.stderr


def test_the_block_blocks():
    assert "No module named 'numpy'" in run(["numpy"], ["stickslip_training.data.reader"]).stderr


def test_the_reader_and_the_command_need_no_torch():
    result = run(["torch", "scipy", "httpx"], ["stickslip_training.data.reader", "stickslip_training.cli"])
    assert result.returncode == 0, result.stderr
