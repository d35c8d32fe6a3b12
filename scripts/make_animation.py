r"""Make an animation of a recorded episode, docs/images/pick.gif for example.

`bhd-record` makes the episode, with a camera; the caption is its instruction.

    bhd-record --config_path=configs/record/ur5_pick.yaml --brain.type=language --robot.camera=true \
        --robot.camera_width=480 --robot.camera_height=360 --dataset.root=data/animation --dataset.num_episodes=4 \
        --task.language=en --seed=7
    python scripts/make_animation.py data/animation 1 docs/images/pick.gif

With --view it is rendered from outside, from the recorded states:

    bhd-record --robot.type=turtlebot3_manipulation --task.type=fetch --brain.type=fetch --dataset.root=data/fetch \
        --dataset.num_episodes=4 --seed=3
    python scripts/make_animation.py data/fetch 0 docs/images/fetch.gif --view=0.7 --speed=4 --fps=6
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.rollout.preview import Preview
from bhd_lerobot.rollout.replay.simulated import Replay

MOST_BYTES = 2_000_000
BAR, MARGIN, SIZE = 34, 12, 15  # of the caption [px]
INK, PAPER = (240, 240, 240), (32, 36, 42)


def main() -> None:
    """Write the file.

    Raises:
        SystemExit: it would be larger than 2 MB.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="folder of the dataset")
    parser.add_argument("episode", type=int)
    parser.add_argument("file", type=Path, help="the GIF")
    parser.add_argument("--camera", default="observation.images.scene")
    parser.add_argument("--view", type=float, help="show it from outside, with this share of that camera's angle")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than the robot was")
    parser.add_argument("--fps", type=float, default=12.5, help="of the animation")
    parser.add_argument("--colors", type=int, default=96)
    options = parser.parse_args()
    if not (options.root / "meta/info.json").is_file():
        parser.error(f"{options.root} is not a LeRobot dataset: record one as above")
    dataset = LeRobotDataset("local/animation", root=options.root, episodes=[options.episode], video_backend="pyav")
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), SIZE)
    pictures = []
    outside = from_outside(options.root, options.episode, options.view) if options.view else None
    for row in range(0, len(dataset), max(1, round(dataset.fps * options.speed / options.fps))):
        frame = dataset[row]
        image = outside(row) if outside else (frame[options.camera].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
        picture = Image.new("RGB", (image.shape[1], image.shape[0] + BAR), PAPER)
        picture.paste(Image.fromarray(image), (0, BAR))
        draw = ImageDraw.Draw(picture)
        draw.text((MARGIN, BAR / 2), frame["task"], INK, font, anchor="lm")
        seconds = f"{frame['timestamp']:.1f} s"
        draw.text((picture.width - MARGIN, BAR / 2), seconds, INK, font, anchor="rm")
        pictures.append(picture)
    palette = pictures[len(pictures) // 2].quantize(options.colors, dither=Image.Dither.NONE)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    durations = [round(1000 / options.fps)] * (len(pictures) - 1) + [2000]
    first, rest = pictures[0], pictures[1:]
    first.save(options.file, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    if (size := options.file.stat().st_size) > MOST_BYTES:
        raise SystemExit(f"{options.file} has {size:,} bytes, more than {MOST_BYTES:,}: fewer --fps or --colors.")
    print(f"{options.file}: {len(pictures)} images, {size:,} bytes")


def from_outside(root: Path, episode: int, share: float) -> Callable[[int], NDArray[np.uint8]]:
    """Return what renders a recorded frame from outside, shape (480, 640, 3)."""
    replayed = Replay(root, episode)
    simulation, states = replayed.simulation, np.asarray(replayed.columns[keys.PHYSICS_STATE], np.float64)
    world = simulation.world
    world.model_field("cam_fovy")[:, world.model.camera(simulation.view).id] *= share
    preview = Preview(simulation)
    return lambda row: preview.image(replayed.scene, states[row])


if __name__ == "__main__":
    main()
