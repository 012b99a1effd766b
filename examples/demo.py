"""The main job, from POST /v1/jobs to a training batch, with a service of its own: `make demo`.

Everything is left in demo-out/: the dataset, a contact sheet, the trained network, and the
service's data.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from stickslip_services.client.http import Client
from stickslip_training.data.samples import Samples

BIN = Path(sys.executable).parent
RODS = Path(__file__).with_name("demo-rods.yaml")
CLOTH = Path(__file__).with_name("friction-cloth.yaml")  # a dataset that the network knows
MORE_RODS = Path(__file__).with_name("sampled-rods.yaml")
OUT = Path("demo-out")
START_SECONDS = 60
SHEET_COLUMNS = 4
CLIP_FRAMES = 10
TRAINING_STEPS = 300
"""Steps of the network of rods: enough to beat splines on the mean square, not to rest on.

The thesis's network takes thousands of steps. A step costs 0.16 CPU s.
"""

console = Console()


def main() -> None:
    """Run the demo; raise where anything is not as it should be."""
    started = time.monotonic()
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir()
    with service(OUT / "service") as url:
        rods = submit(RODS, url)
        console.rule("the same spec again: nothing is simulated, nothing is rendered")
        assert submit(RODS, url) == rods
        run("stickslip", "pull", rods, OUT / "dataset", "--url", url)
        run("stickslip", "verify", OUT / "dataset")
        look_at(OUT / "dataset")
        cloth = submit(CLOTH, url)
        run("stickslip", "pull", cloth, OUT / "cloth-dataset", "--url", url)
        look_at_cloth(OUT / "cloth-dataset")
        run("stickslip-train", "cloth", "predict", OUT / "cloth-dataset")
        console.rule("2,500 more rods, without pictures, to learn from")
        more_rods = submit(MORE_RODS, url)
        run("stickslip", "pull", more_rods, OUT / "training-dataset", "--url", url)
    train(OUT / "training-dataset", OUT / "training")
    console.rule(f"done in {time.monotonic() - started:.0f} s")
    console.print(f"contact sheets {OUT / 'contact-sheet.png'}, {OUT / 'cloth-sheet.png'}")
    console.print(f"training       {OUT / 'training' / 'report.json'}")
    console.print(
        f"datasets       {OUT / 'dataset'}, {OUT / 'cloth-dataset'}, {OUT / 'training-dataset'}"
    )


def submit(spec: Path, url: str) -> str:
    """Run a job, in sight, and return the id of its dataset."""
    run("stickslip", "submit", spec, "--watch", "--url", url)
    with Client(url) as client:
        job = next(client.jobs())
    if job.dataset is None:
        raise SystemExit(f"{job.id} is {job.state}: {job.message}")
    return job.dataset.dataset


@contextmanager
def service(data: Path) -> Iterator[str]:
    """Run `stickslip up` on a free port and yield its URL; stop all of it at the end."""
    console.rule("stickslip up")
    process = subprocess.Popen([BIN / "stickslip", "up", "--data", data, "--port", "0"])
    try:
        yield wait_for_url(data / "url", process)
    finally:
        process.terminate()
        process.wait(timeout=60)


def wait_for_url(file: Path, process: subprocess.Popen[bytes]) -> str:
    """Return the URL that the service writes when it answers."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        if file.exists() and (url := file.read_text().strip()):
            return url
        time.sleep(0.1)
    raise SystemExit(
        f"the service did not start within {START_SECONDS} s; "
        f"its logs are in {file.parent / 'logs'}"
    )


def run(command: str, *arguments: str | Path) -> None:
    """Run one of the project's commands as a user would, in sight."""
    console.rule(" ".join([command, *map(str, arguments)]))
    subprocess.run([BIN / command, *arguments], check=True)


def train(dataset: Path, out: Path) -> None:
    """Train a network on rods: a short training, which says how many minutes are left."""
    console.rule(f"a short training of {TRAINING_STEPS} steps, to see that a network learns")
    # One thread: two of them wait for one another and cost three times as much.
    settings = ["--steps", str(TRAINING_STEPS), "--threads", "1"]
    run("stickslip-train", "curvature", dataset, "--out", out, *settings)


def look_at(directory: Path) -> None:
    """Draw batches as a training loop does, and lay pictures out on a sheet: four views a rod."""
    console.rule("batches")
    rods = Samples(directory, arrays=["centerline", "curvature", "views"])
    rows = []
    for batch in rods.loader(16):
        rows += [np.concatenate(list(views), axis=1) for views in batch["views"].numpy()]
    shapes = {name: tuple(tensor.shape) for name, tensor in batch.items()}
    console.print(f"{len(rods)} rods in batches of {shapes}")
    rows += [np.zeros_like(rows[0])] * (-len(rows) % SHEET_COLUMNS)
    lines = [
        np.concatenate(rows[i : i + SHEET_COLUMNS], axis=1)
        for i in range(0, len(rows), SHEET_COLUMNS)
    ]
    save_half_size(np.concatenate(lines), OUT / "contact-sheet.png")


def look_at_cloth(directory: Path) -> None:
    """Draw a batch of clips with their meshes, and lay frames out on a sheet: one clip a row."""
    console.rule("clips")
    clips = Samples(directory, arrays=["video", "positions"])
    (batch,) = clips.loader(len(clips))
    shapes = {name: tuple(tensor.shape) for name, tensor in batch.items()}
    console.print(f"{len(clips)} clips in one batch of {shapes}")
    video = batch["video"].numpy()
    frame_numbers = np.linspace(0, video.shape[1] - 1, CLIP_FRAMES).round().astype(int)
    rows = [np.concatenate(list(clip[frame_numbers]), axis=1) for clip in video]
    save_half_size(np.concatenate(rows), OUT / "cloth-sheet.png")


def save_half_size(picture: np.ndarray, path: Path) -> None:
    """Save a picture (height, width, 3) at half its size."""
    image = Image.fromarray(picture)
    image.resize((image.width // 2, image.height // 2), Image.Resampling.LANCZOS).save(path)


if __name__ == "__main__":
    main()
