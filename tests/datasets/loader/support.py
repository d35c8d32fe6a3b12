"""Datasets for the loader, of our recorder and of stock LeRobot, and the law that every batch is LeRobot's."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.collate import lerobot_collate_fn
from torch.utils.data import default_collate

from bhd_lerobot.datasets.format.schema import LANGUAGE
from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.tasks.task import Event

FPS = 10
FRONT, WRIST, PHOTO = "observation.images.front", "observation.images.wrist", "observation.images.photo"
SIZE = (64, 80)
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "c.pos"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x.vel", "theta.vel"]},
    "control.time": {"dtype": "float64", "shape": (1,), "names": None},
    "simulation.state": {"dtype": "float64", "shape": (2,), "names": None},
    "event": {"dtype": "int64", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "subtask": {"dtype": "string", "shape": (1,), "names": None},
}
OUTCOMES = ("success", "success", "collision", "timeout", "success")


def length(episode: int) -> int:
    """Return how many frames an episode has."""
    return 6 + 5 * episode % 7


def images(episode: int, key: str, count: int) -> np.ndarray:
    """Return images with edges and noise, so that a wrong frame or a wrong conversion shows."""
    rng = np.random.default_rng([episode, len(key)])
    coarse = rng.integers(0, 256, (count, SIZE[0] // 8, SIZE[1] // 8, 3), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 8, axis=1), 8, axis=2)


def columns(episode: int, action: float | None = None) -> dict[str, np.ndarray]:
    """Return an episode's columns; `action` fills one number of the action in its third frame."""
    i = np.arange(length(episode))
    rng = np.random.default_rng(episode)
    actions = rng.normal(size=(len(i), 2)).astype(np.float32)
    if action is not None:
        actions[2, 1] = action
    return {
        "observation.state": rng.normal(size=(len(i), 3)).astype(np.float32),
        "action": actions,
        "control.time": i / 3,
        "simulation.state": rng.normal(size=(len(i), 2)),
        "event": np.where((i == 1) & (episode == 2), int(Event.INTERVENTION), 0),
        "next.done": i == len(i) - 1,
        "subtask": np.array([f"{episode}/{frame}" for frame in i], dtype=object),
    }


def said(count: int) -> np.ndarray:
    """Return a language column: the same row in every frame."""
    row = {"role": "assistant", "content": "pick it up", "style": "plan", "timestamp": 0.0, "camera": None}
    column = np.empty(count, dtype=object)
    column[:] = [[{**row, "tool_calls": None}]] * count
    return column


def record_ours(
    root: Path,
    episodes: int = 5,
    cameras: tuple[str, ...] = (),
    video: VideoSettings | None = None,
    *,
    language: bool = False,
) -> Path:
    """Record with our recorder: episodes of two tasks, with outcomes and scores."""
    camera = {"dtype": "video", "shape": (*SIZE, 3), "names": ["height", "width", "channels"]}
    features = {**FEATURES, **dict.fromkeys(cameras, camera)}
    if language:
        features[LANGUAGE] = {"dtype": "language", "shape": (1,), "names": None}
    options = {} if video is None else {"video": video}
    recorder = DatasetRecorder.create("t/ours", FPS, features, robot_type="toy", root=root, recording={}, **options)
    for episode in range(episodes):
        writer = recorder.begin_episode()
        writer.set_columns(columns(episode))
        if language:
            writer.set_columns({LANGUAGE: said(length(episode))})
        for key in cameras:
            for image in images(episode, key, length(episode)):
                writer.add_image(key, image)
        # Of 100 frames 29 may be late, though 0.29 * 100 is less than that.
        timing = json.dumps({"frames": 100, "late_frames": 28 + episode % 3, "tolerated": {"late_frames": 0.29}})
        metadata = {"outcome": OUTCOMES[episode % 5], "score": episode / 4, "timing": timing}
        recorder.save(writer, task=f"task {episode % 2}", metadata=metadata)
    recorder.finalize()
    return root


def record_light(root: Path, *args: Any, **options: Any) -> Path:
    """Record with our recorder, and leave out the statistics of each episode.

    LeRobot reads them, a hundred columns, whenever it opens a dataset, which takes most of the time of that, and
    discards them.
    """
    record_ours(root, *args, **options)
    for path in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.select([key for key in table.column_names if not key.startswith("stats/")]), path)
    return root


def record_stock(root: Path, *, cameras: bool = False) -> Path:
    """Record with nothing but LeRobot: AV1 video by its defaults, images in the data files, a matrix column."""
    features: dict[str, dict[str, Any]] = {
        "observation.state": FEATURES["observation.state"],
        "action": FEATURES["action"],
        "grid": {"dtype": "int64", "shape": (2, 3), "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    }
    if cameras:
        names = ["height", "width", "channels"]
        features[FRONT] = {"dtype": "video", "shape": (*SIZE, 3), "names": names}
        features[PHOTO] = {"dtype": "image", "shape": (*SIZE, 3), "names": names}
    dataset = LeRobotDataset.create("t/stock", FPS, features, root=root, use_videos=cameras)
    for episode in range(3):
        front, photo = (images(episode, key, length(episode)) for key in (FRONT, PHOTO))
        rng = np.random.default_rng(episode)
        for i in range(length(episode)):
            frame: dict[str, Any] = {
                "observation.state": rng.normal(size=3).astype(np.float32),
                "action": rng.normal(size=2).astype(np.float32),
                "grid": rng.integers(0, 9, (2, 3)),
                "next.reward": np.array([i / 7], dtype=np.float32),
                "task": f"task {episode % 2}",
            }
            dataset.add_frame({**frame, FRONT: front[i], PHOTO: photo[i]} if cameras else frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def stock(root: Path, **options: Any) -> LeRobotDataset:
    """Return LeRobot's own dataset."""
    return LeRobotDataset("t/t", root=root, video_backend="pyav", **options)


def collated(dataset: LeRobotDataset, indices: list[int]) -> dict[str, Any]:
    """Return what LeRobot's training would make of some samples."""
    samples = [dataset[i] for i in indices]
    return lerobot_collate_fn(samples) if dataset.meta.has_language_columns else default_collate(samples)


def assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Compare two batches or samples: keys and their order, types, shapes, every bit."""
    assert list(ours) == list(theirs)
    for key, value in theirs.items():
        if isinstance(value, torch.Tensor):
            assert (ours[key].dtype, ours[key].shape) == (value.dtype, value.shape), key
            assert torch.equal(ours[key], value), key
        else:
            assert ours[key] == value, key
