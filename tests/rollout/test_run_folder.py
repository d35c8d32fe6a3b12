"""The folder of a run: there before anything is recorded, and gone if the run is refused."""

from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.rollout import run_folder as module
from bhd_lerobot.rollout.run_folder import run_folder
from tests.evaluation.test_evaluate import run_eval
from tests.recording.support import run_record


def everything(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


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


@pytest.mark.law
def test_runs_that_begin_in_the_same_second_have_folders_of_their_own(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "datetime", SimpleNamespace(now=lambda: datetime(2026, 10, 25, 2, 30)))
    monkeypatch.setattr(module, "encode", lambda config: {"n": config.n})
    folders = []
    for number in range(3):
        with run_folder(SimpleNamespace(output_dir=None, n=number), "eval", "one") as folder:
            folders.append(folder)
    assert [folder.name for folder in folders] == ["02-30-00_one", "02-30-00_one_2", "02-30-00_one_3"]
    assert [(folder / "config.yaml").read_text() for folder in folders] == ["n: 0\n", "n: 1\n", "n: 2\n"]
    before = everything(tmp_path)
    with pytest.raises(ConfigError), run_folder(SimpleNamespace(output_dir=None, n=3), "eval", "one"):
        raise ConfigError("refused")
    assert everything(tmp_path) == before
