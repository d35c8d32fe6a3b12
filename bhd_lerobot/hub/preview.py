"""The image that goes with a dataset to the Hub."""

import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episode, video_frames
from bhd_lerobot.datasets.format.state import DatasetState, Row, slot_of
from bhd_lerobot.datasets.format.summary import DatasetSummary
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import BhdError

SHOWN = 12  # episodes in an image from above
FRAMES = 6  # of an episode, in an image from a camera
LINES = 8  # curves in a panel


def draw(summary: DatasetSummary, state: DatasetState) -> tuple[bytes, str] | None:
    """Return an image of a dataset as PNG, and what it shows; None if there is nothing that could be drawn.

    What a camera saw, or else the trajectories of robot or tool from above, or else the curves of an episode.
    """
    for draw in (_camera, _trajectories, _curves):
        try:
            drawn = draw(summary, state)
        except (BhdError, KeyError, IndexError, ValueError):
            continue  # of a robot that this version does not know, or knows otherwise: the next kind of image
        if drawn is not None:
            return drawn
    return None


def _shown(state: DatasetState) -> Row:
    """Return the first successful episode, or the first one."""
    return next((row for row in state.rows if row.get("bhd/success")), state.rows[0])


def _camera(_: DatasetSummary, state: DatasetState) -> tuple[bytes, str] | None:
    if not state.video_keys:
        return None
    key, row = state.video_keys[0], _shown(state)
    path = state.root / layout.video_file(key, slot_of(row, f"videos/{key}"))
    frames = video_frames(path, row[f"videos/{key}/from_timestamp"], row["length"])
    chosen = set(np.linspace(0, row["length"] - 1, FRAMES).round())
    images = [image for index, image in enumerate(frames) if index in chosen]
    images += images[-1:] * (-len(images) % 3)
    rows = [np.concatenate(images[at : at + 3], axis=1) for at in range(0, len(images), 3)]
    return _png(np.concatenate(rows)), f"Episode {row['episode_index']} as `{key}` saw it"


def _trajectories(summary: DatasetSummary, state: DatasetState) -> tuple[bytes, str] | None:
    if keys.PHYSICS_STATE not in summary.features or "robot" not in summary.recording:
        return None
    from bhd_lerobot.bodies.scenes import scene_from_json
    from bhd_lerobot.rollout.plots import Trajectory, draw_trajectories
    from bhd_lerobot.rollout.replay.simulated import Replay

    simulation = Replay(state.root, 0).simulation
    trajectories = []
    for episode in summary.episodes[:SHOWN]:
        states = np.asarray(read_episode(state.root, episode.index)[keys.PHYSICS_STATE], np.float64)
        about = episode.metadata
        title = f"{episode.index}: {about.get('outcome', '')}, score {about.get('score') or 0.0:.2f}"
        success = bool(about.get("success"))
        trajectories.append(
            Trajectory(title, scene_from_json(about["scene"]), simulation.track(states)[:, :2], success, episode.task)
        )
    what = f"The first {len(trajectories)} episodes from above" if len(trajectories) > 1 else "The episode from above"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trajectories.png"
        draw_trajectories(trajectories, path, what)
        return (
            path.read_bytes(),
            f"{what}: the trajectory of {'the base' if simulation.body.drive else 'the tool'}",
        )


def _curves(summary: DatasetSummary, state: DatasetState) -> tuple[bytes, str] | None:
    shown = [key for key in (keys.OBSERVATION_STATE, keys.ACTION) if key in summary.features]
    if not shown:
        return None
    from matplotlib.figure import Figure

    index = _shown(state)["episode_index"]
    columns = read_episode(state.root, index)
    figure = Figure(figsize=(9, 2.6 * len(shown)), layout="constrained")
    for axes, key in zip(np.atleast_1d(figure.subplots(len(shown), 1, sharex=True)), shown, strict=True):
        values: NDArray[Any] = np.asarray(columns[key], np.float64).reshape(len(columns[key]), -1)
        named = keys.numbered_names_of(summary.features[key])
        for column, name in list(zip(values.T, named, strict=True))[:LINES]:
            axes.plot(np.arange(len(column)) / summary.fps, column, linewidth=1.0, label=str(name))
        axes.set_ylabel(key)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=7, ncols=2, loc="upper right")
    axes.set_xlabel("time [s]")
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue(), f"Episode {index}: observations and actions"


def _png(image: NDArray[np.uint8]) -> bytes:
    from matplotlib.image import imsave

    buffer = BytesIO()
    imsave(buffer, image, format="png")
    return buffer.getvalue()
