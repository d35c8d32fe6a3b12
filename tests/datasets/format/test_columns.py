"""Columns of episodes are what was recorded, wherever their files are."""

from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.datasets.format.columns import read_episodes
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetError

FEATURES = {
    "x": {"dtype": "float64", "shape": (1,), "names": None},
    "late": {"dtype": "bool", "shape": (1,), "names": None},
    "wide": {"dtype": "float32", "shape": (3,), "names": None},
}
LENGTHS = (4, 1, 7)


def record(root: Path) -> DatasetRecorder:
    recorder = DatasetRecorder.create("t/t", 10, FEATURES, robot_type="toy", root=root)
    for index, length in enumerate(LENGTHS):
        episode = recorder.begin_episode()
        values = np.arange(length) + 100.0 * index
        episode.set_columns({"x": values, "late": values % 2 == 1, "wide": np.zeros((length, 3), np.float32)})
        recorder.save(episode, task="x", metadata={})
    return recorder


def test_columns_are_those_of_the_episodes(tmp_path: Path) -> None:
    root = tmp_path / "d"
    recorder = record(root)
    for _ in range(2):  # before the files are merged, and after it
        for index, columns in enumerate(read_episodes(root, range(3))):
            values = np.arange(LENGTHS[index]) + 100.0 * index
            assert np.array_equal(columns["x"], values)
            assert np.array_equal(columns["late"], values % 2 == 1)
            assert columns["wide"].shape == (LENGTHS[index], 3)
        recorder.finalize()
    for episode in (-1, 3):
        with pytest.raises(DatasetError, match=f"no episode {episode} .* has 3, from 0 to 2"):
            list(read_episodes(root, [episode]))
