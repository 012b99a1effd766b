"""What a dispatcher does before it has work."""

import json
import os
import subprocess
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from stickslip_schemas.plan.builds import Builds

from stickslip_workers.settings import Settings
from stickslip_workers.stages.run import StageActor

_DESCRIBE = "import json, os; from {} import {} as made; print(json.dumps(made(os.devnull).describe()))"


class StartError(RuntimeError):
    """The dispatcher cannot start."""


def find_builds(settings: Settings) -> dict[bool, dict[str, Any]]:
    """Return what the stages (False) and the renderer (True) say about themselves, with their builds."""
    python, (module, name) = settings.blender_python, settings.render_actor.split(":")
    try:
        described = subprocess.run(
            [python, "-c", _DESCRIBE.format(module, name)], check=True, capture_output=True, text=True
        ).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        said = str(getattr(error, "stderr", "") or error).strip().splitlines()[-1]
        raise StartError(f"{python} cannot describe its renderer: {said}; see the log of the dispatcher") from error
    return {False: StageActor(os.devnull).describe(), True: json.loads(described.splitlines()[-1])}


def common_builds(described: Mapping[bool, Mapping[str, Any]]) -> dict[str, Builds]:
    """Return the builds of the kinds that the stages and the renderer know; none where nothing is known yet."""
    own, rendering = (described.get(who, {"builds": {}})["builds"] for who in (False, True))
    return {name: Builds(**builds, render=rendering[name]) for name, builds in own.items() if name in rendering}


def in_thread(work: Callable[[], Any]) -> "Future[Any]":
    """Do something in a thread that does not keep the process alive."""
    done: Future[Any] = Future()

    def do() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=do, daemon=True).start()
    return done
