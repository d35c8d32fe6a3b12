"""The folder of a run: there before anything is recorded, and gone if the run is refused."""

from pathlib import Path

import pytest

from bhd_lerobot.errors import BhdError
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
