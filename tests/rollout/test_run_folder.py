"""The folder of a run: there before anything is recorded, and gone if the run is refused."""

from pathlib import Path

import pytest

from bhd_lerobot.errors import BhdError, ConfigError, DatasetError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.run_folder import run_folder
from tests.evaluation.test_evaluate import run_eval
from tests.recording.support import options, run_record


def everything(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_a_refused_run_leaves_no_folder_and_a_started_run_leaves_its_configuration(tmp_path: Path) -> None:
    config = parse(RecordConfig, options(tmp_path / "d", output_dir=tmp_path / "a/b/c"))
    with run_folder(config, "record") as folder:
        assert folder == tmp_path / "a/b/c"
    assert everything(tmp_path / "a") == ["b", "b/c", "b/c/config.yaml"]

    config.output_dir = str(tmp_path / "a/new")
    with pytest.raises(DatasetError), run_folder(config, "record"):
        raise DatasetError("refused")
    assert everything(tmp_path / "a") == ["b", "b/c", "b/c/config.yaml"]

    config.output_dir = str(tmp_path / "a/b/c")
    (tmp_path / "a/b/c/config.yaml").write_text("of another run")
    (tmp_path / "a/b/c/notes").touch()
    with pytest.raises(DatasetError), run_folder(config, "record"):
        raise DatasetError("refused")
    assert (tmp_path / "a/b/c/config.yaml").read_text() == "of another run"
    assert (tmp_path / "a/b/c/notes").exists()

    (tmp_path / "file").touch()
    config.output_dir = str(tmp_path / "file/x")
    with pytest.raises(ConfigError, match="Set --output_dir"), run_folder(config, "record"):
        pass


def test_commands_that_are_refused_leave_no_folder(tmp_path: Path) -> None:
    run_record(tmp_path / "d", dataset__num_episodes=1, output_dir=tmp_path / "first")
    before = everything(tmp_path)
    refused = tmp_path / "second"
    for more in (
        {},  # the dataset exists
        {"resume": "true", "seed": 99},  # another recording
        {"resume": "true", "brain__type": "learned", "brain__path": tmp_path / "nowhere"},
    ):
        with pytest.raises(BhdError):
            run_record(tmp_path / "d", **{"dataset__num_episodes": 2, "output_dir": refused, **more})
        assert everything(tmp_path) == before, more
    with pytest.raises(BhdError):
        run_eval(refused, only="[nobody]")
    assert everything(tmp_path) == before
