"""Bytes that a download sends again when it is killed: `stickslip pull` through a proxy that counts.

python benchmarks/interrupted_pull.py URL DATASET [--kills 5] [--rate 50]

URL is that of a coordinator, and DATASET a dataset of it. The pull is killed with SIGKILL each time another equal share
of the dataset's bytes has passed, and started again. What passed beyond what one pull without interruption needs was
sent again. The proxy lets through RATE MB/s, as a network does. Without a limit the server would be faster than the
client, and each kill would lose what the kernel holds for it, megabytes for each of four connections.
"""

import argparse
import asyncio
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit


class CountingProxy:
    """Passes TCP on to one server, and counts what comes back from it [bytes]."""

    def __init__(self, host: str, port: int, rate: float) -> None:
        """Pass on to a host and port, at most `rate` bytes/s over all connections."""
        self._upstream = host, port
        self._rate = rate
        self._free = 0.0
        self.received = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on one connection until either side closes it."""
        up_reader, up_writer = await asyncio.open_connection(*self._upstream)
        try:
            await asyncio.gather(self._pass(reader, up_writer, count=False), self._pass(up_reader, writer, count=True))
        except ConnectionError:
            pass  # the client was killed
        finally:
            writer.close()
            up_writer.close()

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, count: bool) -> None:
        while data := await source.read(2**16):
            if count:
                self.received += len(data)
                now = asyncio.get_running_loop().time()
                self._free = max(self._free, now) + len(data) / self._rate
                await asyncio.sleep(self._free - now)
            sink.write(data)
            await sink.drain()
        sink.close()


async def measure(url: str, dataset: str, kills: int, rate: float) -> None:
    parts = urlsplit(url)
    assert parts.hostname is not None
    proxy = CountingProxy(parts.hostname, parts.port or 80, rate)
    server = await asyncio.start_server(proxy.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    with tempfile.TemporaryDirectory(prefix="stickslip-pull-") as scratch:
        target = Path(scratch, "dataset")
        command = [sys.executable, "-m", "stickslip_services.cli", "pull", dataset, str(target)]
        command += ["--url", f"http://127.0.0.1:{port}"]
        ended = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL)
        assert await ended.wait() == 0
        size = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    whole, proxy.received = proxy.received, 0
    print(f"{dataset}: {size / 1e6:.1f} MB in files; {whole / 1e6:.1f} MB come through the proxy in one go")
    with tempfile.TemporaryDirectory(prefix="stickslip-pull-") as scratch:
        target = Path(scratch, "dataset")
        command[5] = str(target)
        for number in range(kills):
            process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL)
            while proxy.received < (number + 1) * whole / (kills + 1) and process.returncode is None:
                await asyncio.sleep(0.002)
            assert process.returncode is None, "the pull ended before it was killed"
            process.kill()
            await process.wait()
            await asyncio.sleep(0.5)  # what is on its way is counted
        process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL)
        assert await process.wait() == 0
        assert sum(path.stat().st_size for path in target.rglob("*") if path.is_file()) == size
    again = proxy.received - whole
    print(f"{kills} kills: {again / 1e6:.2f} MB were sent again, {again / whole:.2%}")
    server.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("dataset")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--rate", type=float, default=50.0, help="of the proxy [MB/s]")
    options = parser.parse_args()
    asyncio.run(measure(options.url, options.dataset, options.kills, 1e6 * options.rate))


if __name__ == "__main__":
    main()
