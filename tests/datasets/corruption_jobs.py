"""What processes do that leave corrupted datasets: they record with stock LeRobot, and kill themselves."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import dataset_writer
from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERA = "observation.images.top"
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "c.pos"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
    "matrix": {"dtype": "float64", "shape": (2, 2), "names": None},
}


def length(episode: int) -> int:
    """Return how many frames an episode has."""
    return 5 + episode % 3


def frame(episode: int, index: int, video: str) -> dict[str, Any]:
    """Return a frame."""
    seed = 100 * episode + index
    values: dict[str, Any] = {
        "observation.state": np.array([seed, np.sin(seed), episode], np.float32),
        "action": np.array([-seed, index], np.float32),
        "next.done": np.array([index == length(episode) - 1]),
        "note": f"{episode}/{index}",
        "matrix": np.array([[seed, 1.0], [0.5, -seed]]),
        "task": f"task {episode % 3}",
    }
    if video != "none":
        values[CAMERA] = np.full((32, 48, 3), 20 + (37 * episode + 11 * index) % 200, np.uint8)
    return values


def save_again(dataset: LeRobotDataset, episode: int, video: str) -> None:
    """Fail to save an episode at its video, as a full disk does, and record it again, longer."""
    save_video = dataset_writer.DatasetWriter._save_episode_video

    def fail(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    dataset_writer.DatasetWriter._save_episode_video = fail
    try:
        dataset.save_episode()
    except OSError:
        dataset.clear_episode_buffer()
    dataset_writer.DatasetWriter._save_episode_video = save_video
    for index in range(length(episode)):
        dataset.add_frame(frame(episode, index, video))
    dataset.save_episode()


def opened(job: dict[str, Any]) -> LeRobotDataset:
    """Create a dataset, or go on with it."""
    root, video = Path(job["root"]), job["video"]
    streaming = {"streaming_encoding": video == "stream"}
    if root.exists():
        return LeRobotDataset.resume("t/t", root=root, **streaming)
    features = dict(FEATURES)
    if video != "none":
        kind = "image" if video == "image" else "video"
        features[CAMERA] = {"dtype": kind, "shape": (32, 48, 3), "names": ["height", "width", "channels"]}
    return LeRobotDataset.create(
        "t/t", fps=10, features=features, root=root, robot_type="toy",
        use_videos=video in ("video", "stream"), **streaming,
    )  # fmt: skip


def run(job: dict[str, Any]) -> None:
    """Record; `die` says when to go: `never`, `saved`, `frames`, `encoding`, `joining`, or `counting`."""
    dataset, video = opened(job), job["video"]
    progress = os.open(job["progress"], os.O_WRONLY | os.O_CREAT | os.O_APPEND) if "progress" in job else None

    def die(*args: object, **kwargs: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    first = dataset.meta.total_episodes
    for episode in range(first, first + job["episodes"]):
        for index in range(length(episode)):
            dataset.add_frame(frame(episode, index, video))
        if episode == first + job["episodes"] - 1:
            if job["die"] == "joining":
                dataset_writer.concatenate_video_files = die
            if job["die"] == "encoding":
                dataset_writer.DatasetWriter._save_episode_video = die
            if job["die"] == "counting":
                dataset.meta.save_episode = die
        if episode == job.get("again"):
            save_again(dataset, episode, video)
        else:
            dataset.save_episode()
        if progress is not None:
            os.write(progress, f"saved {episode}\n".encode())
    if job["die"] == "saved":
        die()
    if job["die"] == "frames":
        for index in range(3):
            dataset.add_frame(frame(first + job["episodes"], index, video))
        die()
    dataset.finalize()
