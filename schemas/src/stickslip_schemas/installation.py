"""The command that installs an optional part of stickslip.

No distribution is on a package index yet, so the commands install from a clone of the repository.
Messages take them from here: after the first release, only this file changes.
"""

FOLDERS = {
    "stickslip-schemas": ("./schemas",),
    "stickslip": ("./schemas", "./services"),
    "stickslip-training": ("./schemas", "./training"),
    "stickslip-measure": ("./sim_core", "./measure"),
    "stickslip-blender": ("./schemas", "./workers/blender"),
}
"""The folders of a clone that pip needs for each distribution; the last is the distribution's."""


def install_command(distribution: str, *extras: str) -> str:
    """Return the command that installs a distribution with extras, to be run in a clone.

    For example, `install_command("stickslip", "server")` returns
    `pip install ./schemas './services[server]'`.
    """
    *dependencies, folder = FOLDERS[distribution]
    # Shells read brackets as patterns, so a folder with extras is quoted.
    target = f"'{folder}[{','.join(extras)}]'" if extras else folder
    return " ".join(["pip install", *dependencies, target])


def install_hint(distribution: str, *extras: str) -> str:
    """Return a sentence that tells the reader of an error how to install a missing part."""
    command = install_command(distribution, *extras)
    return f"run `{command}` in the folder of the stickslip repository"
