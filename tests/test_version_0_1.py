"""What version 0.1 recorded, with this version; `fixtures_0_1/README.md` says what it is."""

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from bhd_lerobot.cli import record, replay
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.datasets.loader.loader import make_loader
from tests.apps.view.support import served


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the fixtures, as the working directory."""
    copy = Path(shutil.copytree(Path(__file__).parent / "fixtures_0_1", tmp_path / "old"))
    monkeypatch.chdir(copy)
    return copy


def test_everything_reads_a_dataset(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = folder / "dataset"
    stock = LeRobotDataset("bhd/recorded_by_0_1", root=root)
    assert (stock.num_episodes, stock.num_frames) == (2, 60)
    make_loader("bhd/recorded_by_0_1", LoaderConfig(batch_size=2), root=root)
    assert data.main(["check", "dataset"]) == 0
    assert "valid, no errors" in capsys.readouterr().out
    assert data.main(["info", "dataset"]) == 0
    assert "2 episodes" in capsys.readouterr().out
    with served(root) as server:
        assert [server.ask(f"/api/episodes/{index}")[0] for index in range(2)] == [200, 200]
    assert replay.main(["--dataset.root=dataset", "--tolerance_m=0.01"]) == 0


def test_a_dataset_is_resumed_with_the_brain_that_has_another_name(folder: Path) -> None:
    before = pq.read_table(folder / "dataset/data").slice(0, 60)
    resume = ["--config_path=record.yaml", "--resume=true", "--dataset.num_episodes=3"]
    assert record.main(resume) == 0
    after = pq.read_table(folder / "dataset/data")
    assert (len(after), after.slice(0, 60).equals(before)) == (90, True)
    brains = [json.loads(episode.metadata["brain"])["type"] for episode in dataset_info(folder / "dataset").episodes]
    assert brains == ["corrected", "corrected", "dagger"]
    assert data.main(["check", "dataset"]) == 0
    assert record.main(resume) == 0
