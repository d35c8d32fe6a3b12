"""What version 0.1 recorded, trained and configured, with this version; `fixtures_0_1/README.md` says what it is."""

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bhd_lerobot import renames
from bhd_lerobot.cli import evaluate, record, replay, train
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from bhd_lerobot.training.rl.config import RlConfig
from tests.apps.view.support import served

FIXTURES = Path(__file__).parent / "fixtures_0_1"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the fixtures, as the working directory."""
    copy = Path(shutil.copytree(FIXTURES, tmp_path / "old"))
    monkeypatch.chdir(copy)
    return copy


def renamed(path: Path) -> str:
    """Return a configuration of 0.1 with the names of today, in a file of its own."""
    new = path.with_name(f"new_{path.name}")
    new.write_text(path.read_text().replace("type: corrected", "type: dagger"))
    return f"--config_path={new}"


def add_column(root: Path) -> None:
    """Add a column that this program does not know."""
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    table = table.append_column("wind", pa.array([0.5] * len(table), pa.float32()))
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["wind"] = {"dtype": "float32", "shape": [1], "names": None}
    (root / "meta/info.json").write_text(json.dumps(info))
    pq.write_table(table.replace_schema_metadata(None), path)


@pytest.mark.parametrize("column", [None, "wind"])
def test_a_dataset_loads_and_trains(folder: Path, column: str | None) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = folder / "dataset"
    if column:
        add_column(root)
    stock = LeRobotDataset("bhd/recorded_by_0_1", root=root)
    assert (stock.num_episodes, stock.num_frames) == (2, 60)
    assert stock[7]["action"].shape == (2,)
    run = ["--steps=2", "--output_dir=run", "--save_freq=2", "--log_freq=1"]
    assert train.main(["--config_path=train.yaml", *run]) == 0
    assert (folder / "run/checkpoints/000002").is_dir()


def test_bhd_data_reads_a_dataset(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert data.main(["check", "dataset"]) == 0
    assert "valid, no errors" in capsys.readouterr().out
    assert data.main(["info", "dataset"]) == 0
    assert "2 episodes" in capsys.readouterr().out
    with served(folder / "dataset") as server:
        assert [server.ask(f"/api/episodes/{index}")[0] for index in range(2)] == [200, 200]


def test_a_dataset_is_replayed(folder: Path) -> None:
    assert replay.main(["--dataset.root=dataset", "--tolerance_m=0.01"]) == 0


def test_a_dataset_is_resumed_with_the_brain_that_has_another_name(folder: Path) -> None:
    before = pq.read_table(folder / "dataset/data").slice(0, 60)
    assert record.main([renamed(folder / "record.yaml"), "--resume=true", "--dataset.num_episodes=3"]) == 0
    after = pq.read_table(folder / "dataset/data")
    assert (len(after), after.slice(0, 60).equals(before)) == (90, True)
    brains = [json.loads(episode.metadata["brain"])["type"] for episode in dataset_info(folder / "dataset").episodes]
    assert brains == ["corrected", "corrected", "dagger"]
    assert data.main(["check", "dataset"]) == 0
    assert record.main([renamed(folder / "record.yaml"), "--resume=true", "--dataset.num_episodes=3"]) == 0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (["--brain.hold_s=2.0"], "recording.brain.hold_s: recorded 1.0, requested 2.0"),
        (["--seed=3"], "recording.seed: recorded 2, requested 3"),
        ([], "features.wind: recorded"),
    ],
)
def test_a_dataset_that_cannot_be_resumed_is_refused_with_the_reason(
    folder: Path, change: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if not change:
        add_column(folder / "dataset")
    files = {path: path.read_bytes() for path in (folder / "dataset").rglob("*") if path.is_file()}
    assert record.main([renamed(folder / "record.yaml"), "--resume=true", "--dataset.num_episodes=3", *change]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert "brain.type" not in error
    assert files == {path: path.read_bytes() for path in (folder / "dataset").rglob("*") if path.is_file()}


def test_a_configuration_with_old_names_is_refused_in_one_message(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert record.main(["--config_path=record.yaml"]) == 2
    assert "brain.type = corrected -> dagger" in capsys.readouterr().err
    # Two keys that could be renamed one day, beside what is.
    monkeypatch.setitem(renames.KEYS, "episodes_count", "n_episodes")
    monkeypatch.setitem(renames.KEYS, "*.old_threads", "set threads instead")
    assert evaluate.main(["--config_path=eval.yaml", "--episodes_count=3", "--robot.old_threads=2"]) == 2
    assert capsys.readouterr().err.splitlines()[1:] == [
        "  robot.old_threads was removed: set threads instead",
        "  brains.careful.type = corrected -> dagger",
        "  brains.bold.type = corrected -> dagger",
        "  episodes_count -> n_episodes",
    ]
    as_json = folder / "eval.json"
    as_json.write_text(json.dumps({"brain": {"type": "corrected"}}))
    with pytest.raises(ConfigError, match=r"brain.type = corrected -> dagger"):
        parse(EvalConfig, ["--config_path=eval.json"])


def test_removed_options_of_ppo_are_named_together() -> None:
    with pytest.raises(ConfigError, match=r"anchor was removed: .*\n.*start_action was removed: .*first action"):
        parse(RlConfig, ["--anchor.coef=0.1", "--start_action=2"])


def test_a_configuration_with_the_new_names_is_read(folder: Path) -> None:
    config = parse(EvalConfig, [renamed(folder / "eval.yaml")])
    assert [brain.get_choice_name(type(brain)) for brain in config.brains.values()] == ["gap_follower", *["dagger"] * 2]


def test_a_checkpoint_drives(folder: Path) -> None:
    new = ["--dataset.root=driven", "--dataset.num_episodes=1", "--dataset.episode_time_s=1"]
    learned = ["--brain.learner.type=learned", "--brain.learner.path=checkpoint"]
    without = (folder / "record.yaml").read_text().replace("    type: avoidance\n    safe_distance_m: 0.15\n", "")
    (folder / "record.yaml").write_text(without.replace("  learner:\n", ""))
    assert record.main([renamed(folder / "record.yaml"), *new, *learned]) == 0
    assert dataset_info(folder / "driven").frames == 10


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["push", "dataset", "me/d", "--replace_card"], "--replace_card was removed: a README.md beside the dataset"),
        (["push", "dataset", "me/d", "--replace-card"], "--replace-card was removed: a README.md beside the dataset"),
        (["import", "bag", "--repo_id=a/b", "--resample"], "--resample was removed: bags of bhd-data export"),
    ],
)
def test_a_removed_option_names_what_replaces_it(
    arguments: list[str], remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert data.main(arguments) == 2
    assert remedy in capsys.readouterr().err
