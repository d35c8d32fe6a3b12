"""Episodes whose content follows from their index, and the law that every dataset of them must obey."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.writer.episode import EpisodeWriter
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

FPS = 10
CAMERA = "observation.images.front"
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "c.pos"]},
    "event": {"dtype": "int64", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
}
VIDEO_FEATURES = {
    **FEATURES,
    CAMERA: {"dtype": "video", "shape": (32, 48, 3), "names": ["height", "width", "channels"]},
}


def length(episode: int) -> int:
    """Return how many frames an episode has."""
    return 5 + episode % 3


def task(episode: int) -> str:
    """Return its instruction."""
    return f"task {episode % 2}"


def columns(episode: int) -> dict[str, np.ndarray]:
    """Return its columns."""
    i = np.arange(length(episode))
    return {
        "observation.state": np.stack([i, i * 0 + episode, np.sin(i + episode)], axis=1).astype(np.float32),
        "event": i + 100 * episode,
        "next.done": i == length(episode) - 1,
        "note": np.array([f"{episode}/{frame}" for frame in i], dtype=object),
    }


def grey(episode: int, frame: int) -> int:
    """Return the grey level of an image."""
    return 20 + (37 * episode + 11 * frame) % 200


def metadata(episode: int) -> dict[str, Any]:
    """Return its metadata."""
    return {"seed": episode, "outcome": "success", "score": episode / 4, "ok": True, "start": [0.5, float(episode)]}


def fill(writer: EpisodeWriter, episode: int, *, video: bool = False) -> EpisodeWriter:
    """Put an episode into a writer."""
    writer.set_columns(columns(episode))
    if video:
        for frame in range(length(episode)):
            writer.add_image(CAMERA, np.full((32, 48, 3), grey(episode, frame), np.uint8))
    return writer


def record(recorder: DatasetRecorder, *, video: bool = False) -> int:
    """Record and save the next episode."""
    episode = recorder.num_episodes
    writer = fill(recorder.begin_episode(), episode, video=video)
    return recorder.save(writer, task=task(episode), metadata=metadata(episode))


def create(root: Path, *, video: bool = False, **options: Any) -> DatasetRecorder:
    """Start a dataset of such episodes."""
    features = VIDEO_FEATURES if video else FEATURES
    return DatasetRecorder.create("t/t", FPS, features, robot_type="toy", root=root, recording={"seed": 1}, **options)


def resume(root: Path, *, video: bool = False, **options: Any) -> DatasetRecorder:
    """Continue it."""
    features = VIDEO_FEATURES if video else FEATURES
    return DatasetRecorder.resume("t/t", FPS, features, robot_type="toy", root=root, recording={"seed": 1}, **options)


def killed(root: Path, episodes: int, *, video: bool = False) -> DatasetRecorder:
    """Leave a recording as a kill does, after so many episodes; return what is no more its recorder."""
    recorder = create(root, video=video)
    for _ in range(episodes):
        record(recorder, video=video)
    recorder._lock.release()
    return recorder


def read_back(root: Path) -> int:
    """Compare the data files with what was recorded, without LeRobot, and return the number of episodes."""
    summary = dataset_info(root)
    assert [episode.frames for episode in summary.episodes] == [length(e) for e in range(len(summary.episodes))]
    for index, episode in enumerate(summary.episodes):
        assert (episode.index, episode.task, episode.metadata) == (index, task(index), metadata(index))
    table = pa.concat_tables([pq.read_table(path) for path in sorted((root / "data").glob("*/*.parquet"))])
    assert table.num_rows == summary.frames
    for key in FEATURES:
        expected = np.concatenate([columns(episode)[key] for episode in range(len(summary.episodes))])
        assert table[key].to_pylist() == expected.tolist(), key
    return len(summary.episodes)


def snapshot(root: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def verify(root: Path, saved: int, *, video: bool = False, exact: bool = True, stats: bool = False) -> int:
    """Load a dataset with stock LeRobot and compare everything in it with what was recorded.

    Args:
        root: the dataset.
        saved: episodes whose `save` returned; one more may be there, which the kill hit after its commit.
        video: it has a camera.
        exact: the data files hold nothing but the committed episodes.
        stats: all statistics must be stored.

    Returns:
        The number of episodes.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("t/t", root=root, video_backend="pyav")
    count = dataset.num_episodes
    assert saved <= count <= saved + 1
    table = dataset.hf_dataset.with_format("arrow")[:]
    frames = sum(length(episode) for episode in range(count))
    assert len(dataset) == frames
    assert table.num_rows == frames if exact else table.num_rows >= frames
    wanted = [columns(episode) for episode in range(count)]
    for key in FEATURES:
        expected = np.concatenate([episode[key] for episode in wanted]).tolist()
        assert table[key].to_pylist()[:frames] == expected, key
    indices = np.concatenate([np.full(length(episode), episode) for episode in range(count)])
    assert table["episode_index"].to_numpy()[:frames].tolist() == indices.tolist()
    assert table["index"].to_numpy()[:frames].tolist() == list(range(frames))
    start = 0
    for episode, row in zip(range(count), dataset.meta.episodes, strict=False):
        assert row["length"] == length(episode)
        assert (row["dataset_from_index"], row["tasks"]) == (start, [task(episode)])
        assert {key: row[f"bhd/{key}"] for key in metadata(episode)} == metadata(episode)
        start += row["length"]
    assert dataset[frames - 1]["task"] == task(count - 1)
    if video:
        start = 0
        for episode in range(count):
            for frame in {0, length(episode) - 1} if count > 6 else range(length(episode)):
                image = dataset[start + frame][CAMERA].numpy() * 255
                assert abs(image.mean() - grey(episode, frame)) < 3, (episode, frame)
            start += length(episode)
    if stats:
        assert dataset.meta.stats["index"]["max"].tolist() == [frames - 1]
        assert dataset.meta.stats["index"]["count"].tolist() == [frames]
    return count
