"""Draw one clip of each file with the true friction and the answer of a reader.

The last clip is half a leg too late.

    python benchmarks/training/answers.py PICTURE CLIPS.npz ... [--model FILE] [--seed 0]

CLIPS.npz is of `blender_clips.py --segmentation`. Clips are drawn from the seed, each of another
fabric. For docs/figures/answers.webp: the files matt, patterned, bright, oak, room and oak again of
`clip_set.py cloth-2`, seed 1.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from stickslip_training.cloth.clips import clips_of_file
from stickslip_training.cloth.model import WEIGHTS, load_friction
from stickslip_training.cloth.posterior import estimates

INSTANT = 3  # of the six instants that a clip has
LATE = [1, 2, 3, 4, 5, 0]  # the order of its instants in the last clip


def main() -> None:
    """Read a clip of each file, and draw them in two rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("picture", type=Path)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--model", type=Path, default=WEIGHTS)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    model = load_friction(args.model)
    random = np.random.default_rng(args.seed)
    fabrics = set[str]()
    columns = -(-len(args.clips) // 2)
    figure = Figure(figsize=(3.0 * columns, 6.7), dpi=100, layout="constrained")
    for place, path in enumerate(args.clips):
        clips, about = clips_of_file(path, model.materials)
        with np.load(path) as file:
            videos = file["video"]
        clip_number = next(
            clip
            for clip in random.permutation(len(about))
            if about[clip]["material"] not in fabrics
        )
        fabrics.add(about[clip_number]["material"])
        read = clips[np.array([clip_number])]
        if late := place == len(args.clips) - 1:
            read.crops[:] = read.crops[:, LATE]
        estimate = estimates(model.estimate(read).mu, model.bins)
        reason = model.judge(read)[1][0]
        answer = (
            f"{estimate.median[0]:.2f} ({estimate.low[0]:.2f} to {estimate.high[0]:.2f})"
            if reason is None
            else "no answer"
        )
        axes = figure.add_subplot(2, columns, place + 1)
        axes.imshow(videos[clip_number][LATE[INSTANT] if late else INSTANT])
        axes.set_title(
            f"true friction {about[clip_number]['mu']:.2f}\n"
            f"{answer}{f': {reason}' if reason else ''}",
            fontsize=11,
        )
        axes.set_axis_off()
    figure.savefig(args.picture)


if __name__ == "__main__":
    main()
