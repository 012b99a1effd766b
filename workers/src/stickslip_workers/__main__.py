"""Command line: `python -m stickslip_workers`, with the commands that `_parser` has."""

import argparse
import ctypes
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from pydantic import ValidationError
from stickslip_schemas.documents.tasks import task_adapter
from stickslip_schemas.logs import configure_logging
from stickslip_schemas.store import open_store, store_place

from stickslip_workers.lease_client import Backoff, CoordinatorError
from stickslip_workers.settings import Settings, default_blender_python

log = logging.getLogger(__name__)

FRAMES_SECONDS = 5.0
"""Time between two reports of a replay's progress [s]."""
STEADY_SECONDS = 60.0
"""Least run time of a dispatcher that resets the growing wait before its next start [s]."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command, and return its exit status."""
    options = _parser().parse_args(arguments)
    if options.command == "dispatch" and not options.once:
        words = sys.argv[1:] if arguments is None else arguments
        command = [sys.executable, "-m", "stickslip_workers", *words, "--once"]
        return run_for_ever(command, Backoff(first=1.0, most=30.0))
    return int(options.run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m stickslip_workers", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    _add_dispatch(commands)

    head = commands.add_parser(
        "head", help="run a Ray of one machine, on loopback, for `dispatch --ray-data`"
    )
    head.add_argument("--ray-data", type=Path, required=True, help="data directory that it is for")
    head.add_argument("--cpus", type=int, help="CPUs to use (default: all)")
    head.set_defaults(run=_head)

    replay = commands.add_parser("replay", help="run one task here, without Ray and coordinator")
    _add_store_and_blender(replay)
    replay.add_argument("task", type=Path, help="the task as JSON")
    replay.set_defaults(run=_replay)

    certify = commands.add_parser(
        "certify", help="run the physical protocols of a preset with this build"
    )
    certify.add_argument("--preset", required=True, help="name of the preset; rods: the rod solver")
    certify.add_argument("--out", type=Path, required=True, help="folder for certificate.json")
    few = "measure a few points only; such a certificate does not count"
    certify.add_argument("--quick", action="store_true", help=few)
    certify.set_defaults(run=_certify)

    preview = commands.add_parser(
        "preview", help="draw a scene, as `stickslip scene preview` hands it over"
    )
    _add_store_and_blender(preview)
    preview.add_argument("scene", type=Path, help="the scene as JSON")
    preview.add_argument("--out", type=Path, required=True, help="directory for the pictures")
    preview.set_defaults(run=_preview)

    lab = commands.add_parser("lab", help="test a fabric, as `stickslip lab` hands it over")
    lab.add_argument("request", type=Path, help="the test, the fabric and options as JSON")
    lab.set_defaults(run=_lab)

    fit = commands.add_parser("fit", help="fit parameters, as `stickslip fit` hands them over")
    fit.add_argument("scene", type=Path, help="the scene as JSON")
    fit.add_argument("--store", required=True, help="store of the files that it names")
    fit.add_argument("--observations", type=Path, required=True, help="NPZ file")
    fit.add_argument("--request", required=True, help="parameters and options as JSON")
    fit.set_defaults(run=_fit)

    rods = commands.add_parser(
        "rods", help="measure threads in photographs, as `stickslip rods measure` asks for it"
    )
    rods.add_argument("request", type=json.loads, help="photographs and options as JSON")
    rods.set_defaults(run=_rods)

    describe = commands.add_parser("describe", help="print the builds of this environment")
    describe.set_defaults(run=_describe)
    return parser


def _add_dispatch(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    dispatch = commands.add_parser(
        "dispatch", help="lease tasks from a coordinator and run them on Ray"
    )
    _add_store_and_blender(dispatch)
    urls = "base URL of the coordinator; repeatable, the next if one is away"
    dispatch.add_argument("--url", required=True, action="append", help=urls)
    dispatch.add_argument("--name", required=True, help="name of this dispatcher, one per cluster")
    dispatch.add_argument(
        "--key-file", type=Path, help="file with the key of the worker API (DATA/worker-key)"
    )
    dispatch.add_argument(
        "--tls-certificate", type=Path, help="trust a coordinator with this very certificate"
    )
    dispatch.add_argument(
        "--max-cpus", type=int, help="the most CPUs of the cluster to use (default: all)"
    )
    dispatch.add_argument(
        "--render-gpus", type=float, default=1.0, help="GPUs for a render (default: %(default)s)"
    )
    cluster = dispatch.add_mutually_exclusive_group()
    cluster.add_argument(
        "--ray-address",
        help="the Ray cluster (default: RAY_ADDRESS, else one for this machine alone)",
    )
    cluster.add_argument(
        "--ray-data", type=Path, help="use the head that `head` runs for this data directory"
    )
    dispatch.add_argument("--once", action="store_true", help="end when the cluster is gone")
    dispatch.set_defaults(run=_dispatch)


def _add_store_and_blender(parser: argparse.ArgumentParser) -> None:
    python = Path(os.environ.get("STICKSLIP_BLENDER_PYTHON") or default_blender_python())
    parser.add_argument(
        "--store", type=_store, required=True, help="directory of the store, or s3://BUCKET/PREFIX"
    )
    parser.add_argument("--blender-python", type=Path, default=python, help="default: %(default)s")


def _head(options: argparse.Namespace) -> int:
    from stickslip_workers.cluster import head_directory, run_head

    run_head(head_directory(options.ray_data), options.cpus)
    return 0


def _describe(_options: argparse.Namespace) -> int:
    from stickslip_workers.stages.run import StageActor

    sys.stdout.write(json.dumps(StageActor(os.devnull).describe(), indent=2) + "\n")
    return 0


def _store(place: str) -> str:
    """Return the place of a store.

    Raises ArgumentTypeError if the store cannot be opened.
    """
    try:
        open_store(place)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return store_place(place)


def _dispatch(options: argparse.Namespace) -> int:
    configure_logging()
    logging.getLogger("httpx").setLevel(logging.WARNING)  # it logs every request
    if not options.blender_python.exists():
        log.error(
            "blender-python must be an interpreter; %s does not exist", options.blender_python
        )
        return 2
    if options.key_file is not None and not options.key_file.is_file():
        log.error(
            "key-file must be a file with the coordinator's worker key; %s does not exist",
            options.key_file,
        )
        return 2
    settings = Settings(
        urls=tuple(options.url),
        store=options.store,
        name=options.name,
        key_file=options.key_file,
        tls_certificate=options.tls_certificate,
        max_cpus=options.max_cpus,
        render_gpus=options.render_gpus,
        # Do not resolve the path: Python knows a virtual environment by the path of its link.
        blender_python=options.blender_python.absolute(),
    )
    from stickslip_workers.cluster import RayCluster, head_directory
    from stickslip_workers.dispatcher import Dispatcher
    from stickslip_workers.ray_calls import StartError

    address = options.ray_address or os.environ.get("RAY_ADDRESS")
    data = options.ray_data
    if address is None and data is None:
        data = Path(settings.name)
        command = [sys.executable, "-m", "stickslip_workers", "head", "--ray-data", str(data)]
        command += [] if settings.max_cpus is None else ["--cpus", str(settings.max_cpus)]
        # The head ends after this process. Ray aborts a driver whose head ends at the same time.
        subprocess.Popen(command, process_group=0, preexec_fn=_die_with_parent)
    if data is None:
        cluster = RayCluster(address or "")
    else:
        cluster = RayCluster(head_directory(data), log=data / "logs" / "ray.log")
    dispatcher: Dispatcher | None = None

    def stop(number: int, _frame: object) -> None:
        if dispatcher is None or dispatcher.stopping:
            raise SystemExit(128 + number)  # nothing runs yet, or this is the second signal
        if not dispatcher.stop():
            raise SystemExit(0)

    try:
        dispatcher = Dispatcher(settings, cluster)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        dispatcher.run()
    except (StartError, CoordinatorError) as error:
        log.exception("the dispatcher has ended: %s", error)
        return 1
    return 0


def run_for_ever(command: list[str], backoff: Backoff) -> int:
    """Run a dispatcher, start it again if it fails, and return its status after a stop.

    A driver of Ray may die with its cluster in any state, and it cannot connect to another cluster.
    """
    stopped: list[int] = []
    child: subprocess.Popen[bytes] | None = None

    def stop(number: int, _frame: object) -> None:
        stopped.append(number)
        if child is not None:
            child.send_signal(number)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    while True:
        began = time.monotonic()
        # The child has its own process group. It gets the signal of Ctrl-C once, from this process,
        # and not also from the terminal.
        child = subprocess.Popen(command, process_group=0, preexec_fn=_die_with_parent)
        status = child.wait()
        if stopped or status in (0, 2):  # 2: its arguments are wrong
            return status
        if time.monotonic() - began > STEADY_SECONDS:
            backoff.succeeded()
        backoff.failed()
        wait = max(backoff.next_try - time.monotonic(), 0.0)
        sys.stderr.write(
            f"the dispatcher ended with status {status}; it starts again in {wait:.1f} s\n"
        )
        deadline = time.monotonic() + wait
        while not stopped and time.monotonic() < deadline:
            time.sleep(0.1)
        if stopped:
            return 128 + stopped[0]


def _die_with_parent() -> None:
    """Let the kernel end this process when its parent dies for any reason [prctl(2)]."""
    ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGTERM)


def _replay(options: argparse.Namespace) -> int:
    from stickslip_workers.commands import replay

    try:
        task = task_adapter.validate_json(options.task.read_bytes())
    except OSError as error:
        sys.stderr.write(f"error: {options.task} cannot be read: {error.strerror}\n")
        return 2
    except ValidationError as error:
        sys.stderr.write(
            f"error: {options.task} is not a task as GET /v1/tasks/ID returns it: {error}\n"
        )
        return 2
    over = threading.Event()
    threading.Thread(target=_show_frames, args=(over,), daemon=True).start()
    result = replay(task, store=options.store, blender_python=options.blender_python.absolute())
    over.set()
    sys.stdout.write(result.model_dump_json(indent=2) + "\n")
    return 1 if result.outcome == "failed" else 0


def _show_frames(over: threading.Event) -> None:
    """Write the progress of the simulation in this process to standard error."""
    from stickslip_workers.stages import run

    while not over.wait(FRAMES_SECONDS):
        if (frames := run.frames) is not None:
            sys.stderr.write(f"{frames[0]} of {frames[1]} frames\n")


def _certify(options: argparse.Namespace) -> int:
    """Return 0 if the preset passed, 1 if it did not, and 2 if an error ended the run."""
    from stickslip_workers.commands import certify

    # Long protocols may log their progress.
    logging.basicConfig(level=logging.INFO, format="    %(message)s")
    logging.getLogger("matplotlib").setLevel(logging.WARNING)

    def say(message: str) -> None:
        sys.stderr.write(message + "\n")
        sys.stderr.flush()

    try:
        certificate = certify(options.preset, options.out, quick=options.quick, say=say)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        say(f"error: {error}")
        return 2
    sys.stdout.write(certificate.digest + "\n")
    return 0 if certificate.passed else 1


def _lab(options: argparse.Namespace) -> int:
    """Return 0 if the fabric was tested, and 2 if not."""
    from stickslip_workers.laboratory import run_test

    try:
        answer = run_test(json.loads(options.request.read_text(encoding="utf-8")))
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


def _rods(options: argparse.Namespace) -> int:
    """Return 0 if the photographs were measured, and 2 if not."""
    try:
        from stickslip_workers.photographs import measure_photographs
    except ModuleNotFoundError as error:
        # A module of an installed package is a bug, and no missing extra.
        if error.name not in ("cv2", "scipy"):
            raise
        sys.stderr.write(
            f"error: photographs need OpenCV and SciPy, and {error.name} is not installed: run "
            "`pip install './sim_core[photographs]'`\n"
        )
        return 2
    try:
        answer = measure_photographs(options.request)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


def _fit(options: argparse.Namespace) -> int:
    """Return 0 if there is an answer, and 2 if not."""
    import numpy as np
    from stickslip_schemas.scene.document import Scene

    from stickslip_workers.fitting import fit_scene

    try:
        scene = Scene.model_validate_json(options.scene.read_bytes())
        with np.load(options.observations, allow_pickle=False) as arrays:
            observed = dict(arrays)
        answer = fit_scene(scene, observed, json.loads(options.request), open_store(options.store))
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


def _preview(options: argparse.Namespace) -> int:
    """Return 0 if the scene was drawn, and 2 if not."""
    from stickslip_schemas.scene.document import Scene

    from stickslip_workers.commands import preview

    try:
        scene = Scene.model_validate_json(options.scene.read_bytes())
        names = preview(
            scene, open_store(options.store), options.out, options.blender_python.absolute()
        )
    except (ValueError, OSError, RuntimeError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(json.dumps({"pictures": names}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
