"""A few columns of many episodes: the same values as reading each episode whole, wherever their files are."""

from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.data.columns import read_columns
from bhd_lerobot.data.read import read_episode
from bhd_lerobot.data.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetCorruptError, DatasetError

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


@pytest.mark.parametrize("compact", [True, False])
def test_columns_are_those_of_the_episodes(tmp_path: Path, compact: bool) -> None:
    root = tmp_path / "d"
    recorder = record(root)
    if compact:
        recorder.finalize()
    found = read_columns(root, ["x", "late", "not_there"])
    assert [len(columns["x"]) for columns in found] == list(LENGTHS)
    for index, columns in enumerate(found):
        whole = read_episode(root, index)
        assert set(columns) == {"x", "late"}
        assert all(np.array_equal(columns[key], whole[key]) for key in columns)
        (alone,) = read_columns(root, ["x"], index)
        assert np.array_equal(alone["x"], whole["x"])
    recorder.finalize()


@pytest.mark.parametrize("episode", [-1, 3])
def test_an_episode_that_is_not_there_is_named(tmp_path: Path, episode: int) -> None:
    record(tmp_path / "d").finalize()
    with pytest.raises(DatasetError, match=f"no episode {episode} .* has 3, from 0 to 2"):
        read_columns(tmp_path / "d", ["x"], episode)


def test_a_damaged_page_is_found(tmp_path: Path) -> None:
    record(tmp_path / "d").finalize()
    path = next((tmp_path / "d" / "data").rglob("*.parquet"))
    content = bytearray(path.read_bytes())
    content[4:60] = bytes(56)
    path.write_bytes(content)
    with pytest.raises(DatasetCorruptError, match=path.name):
        read_columns(tmp_path / "d", ["x", "late", "wide"])
