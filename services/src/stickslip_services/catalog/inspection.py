"""The program that decodes uploaded files: each in a process of its own, with limits.

    python -m stickslip_services.catalog.inspection SOCKET

A decoder may take much time and memory for a hostile file, or crash. This program imports the
decoders once and then forks a process for each file, which costs milliseconds. The process limits
its own memory and CPU time, answers, and ends, so that all of its memory comes back.

A request arrives on the socket with the number SOCKET, as one byte with two file descriptors: one
of a file that holds the data, and one of a socket for the question and the answer, both JSON.
"""

import json
import logging
import mmap
import os
import resource
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stickslip_schemas.format.pictures import UnfitPictureError, read_picture
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.files import counts_of

CPU_SECONDS = 10
"""CPU time of a process [s]. The largest mesh takes 1 to 3 s, the largest picture 0.5 s."""

MEMORY_BYTES = 512 * 2**20
"""Memory that a process may allocate [bytes]. A picture of 4,096 x 4,096 pixels takes 250 MB."""

VALUE_LETTERS = 200
"""Most letters of a value that an answer repeats."""

_STATM = Path("/proc/self/statm")

Answer = dict[str, Any]

logger = logging.getLogger(__name__)


def _inspect_texture(data: bytes, _question: Answer) -> object:
    """Return the side of a texture [px]."""
    return len(read_picture(data))


def _inspect_scene_file(data: bytes, _question: Answer) -> object:
    """Return the numbers of vertices and triangles of a mesh, None for another file."""
    return counts_of(data)


def _inspect_artifact(data: bytes, question: Answer) -> object:
    """Check that a file fits the place in a spec that a pointer names."""
    spec = job_spec_adapter.validate_json(question["spec"])
    place = spec.scene_place(question["pointer"])
    if place is None:
        read_picture(data)
    else:
        spec.check_scene_file(place, data)
    return None


def _inspect_start(data: bytes, question: Answer) -> object:
    """Return why no sample of a spec can work: pointer, rule and value of each fault.

    `data` holds the files of the scene one after the other, as `files` lists them.
    """
    files: dict[str, bytes] = {}
    begin = 0
    for digest, size in question["files"]:
        files[digest] = data[begin : begin + size]
        begin += size
    spec = job_spec_adapter.validate_json(question["spec"])
    faults = spec.start_faults(files.__getitem__)
    return [
        {
            "pointer": "".join(f"/{step}" for step in fault.location),
            "rule": fault.rule,
            "value": json.dumps(fault.value)[:VALUE_LETTERS],
        }
        for fault in faults
    ]


_INSPECTIONS: dict[str, Callable[[bytes, Answer], object]] = {
    "texture": _inspect_texture,
    "scene_file": _inspect_scene_file,
    "artifact": _inspect_artifact,
    "start": _inspect_start,
}


def _answer(question: Answer, data: bytes) -> Answer:
    """Return the result of an inspection, the reason to refuse the file, or a traceback."""
    try:
        return {"result": _INSPECTIONS[question["inspection"]](data, question)}
    except (UnfitPictureError, UnfitFileError) as error:
        return {"unfit": str(error)}
    except MemoryError:
        return {"unfit": f"must need at most {MEMORY_BYTES // 2**20} MiB to be read"}
    # A bug, or a decoder that fails in an unknown way. The coordinator logs it and refuses the
    # file, since nothing is known about it.
    except Exception:
        logger.exception("an inspection failed")
        return {"failure": traceback.format_exc()}


def _limit() -> None:
    """Limit the memory and the CPU time of this process.

    Memory is limited if the kernel tells how much address space the process has already.
    """
    limits = {
        resource.RLIMIT_CPU: CPU_SECONDS,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: 0,
    }
    if _STATM.exists():
        pages = int(_STATM.read_text(encoding="ascii").split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + MEMORY_BYTES
    for limit, value in limits.items():
        resource.setrlimit(limit, (value, value))


def _inspect(file: int, channel: socket.socket) -> None:
    """Answer the question on a channel about a file."""
    with channel:
        with channel.makefile("rb") as reader:
            question = json.loads(reader.read())
        size = os.fstat(file).st_size
        data = b""
        if size:
            with mmap.mmap(file, size, access=mmap.ACCESS_READ) as mapped:
                data = mapped[:]
        channel.sendall(json.dumps(_answer(question, data)).encode())


def serve(requests: socket.socket) -> None:
    """Fork a process for each request, until the coordinator closes its end."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps the processes
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the coordinator, which stops this
    while True:
        message, descriptors, _, _ = socket.recv_fds(requests, 1, maxfds=2)
        if not message:
            return
        file, channel = descriptors
        if os.fork() == 0:
            requests.close()
            _limit()
            _inspect(file, socket.socket(fileno=channel))
            os._exit(0)
        os.close(file)
        os.close(channel)


if __name__ == "__main__":
    # Threads do not survive a fork, and the small matrices here need none.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    serve(socket.socket(fileno=int(sys.argv[1])))
