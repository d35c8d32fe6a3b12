"""`bhd-record --resume=true` on a dataset that was edited: why not, and commands that do what was meant."""

import shlex
from pathlib import Path

from bhd_lerobot.cli import record
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.edit.edits import delete
from bhd_lerobot.datasets.edit.mark import mark
from bhd_lerobot.datasets.format.summary import dataset_info
from tests.recording.support import options


def seeds(root: Path) -> list[str]:
    return [episode.metadata["seed"] for episode in dataset_info(root).episodes]


def test_the_commands_that_are_told_do_what_was_meant(tmp_path: Path, capsys) -> None:
    short = {"dataset__num_episodes": 3, "dataset__episode_time_s": 1}
    root = tmp_path / "my data"
    assert record.main(options(root, **short)) == 0
    mark(root, [0], outcome="stuck")
    assert record.main(options(root, **short, resume="true")) == 0  # marks do not matter
    delete(root, [1])
    before = seeds(root)
    capsys.readouterr()
    arguments = [part for one in options(root, **short) for part in one.split("=", 1)]
    assert record.main([*arguments, "--resume", "true"]) == 2
    error, *lines = (line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning:"))
    assert "was edited after its recording (delete), so it cannot be continued" in error
    assert len(lines) == 2
    for line, main in zip(lines, (record.main, data.main), strict=True):
        program, *arguments = shlex.split(line)
        assert program == {record.main: "bhd-record", data.main: "bhd-data"}[main]
        assert main(arguments) == 0
    assert seeds(root) == before
    merged = seeds(tmp_path / "my data_all")
    assert merged[:2] == before
    assert len(set(merged)) == 3
    # A merged dataset cannot be continued either, and nothing that is there is proposed as a new place or seed.
    capsys.readouterr()
    more = {"dataset__num_episodes": 5, "dataset__episode_time_s": 1, "resume": "true"}
    assert record.main(options(tmp_path / "my data_all", **more)) == 2
    error = capsys.readouterr().err
    assert "was edited after its recording (merge)" in error
    assert "--seed=2 " in error.replace("\n", " ")
    assert "--dataset.num_episodes=2 " in error
    assert record.main(options(root, **short, resume="true")) == 2
    assert "my data_more2" in capsys.readouterr().err
