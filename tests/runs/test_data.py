"""bhd-data: what it shows, and what it says about what is broken."""

import json
import shutil

import pytest

from bhd_lerobot.runs import data
from tests.runs.support import run_record


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "d"
    run_record(root, n_envs=2, seed=4)
    return root


def test_info_shows_outcome_and_timing_of_every_episode(recorded, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    assert data.main(["info", str(recorded)]) == 0
    text = capsys.readouterr().out
    for part in ("turtlebot3, 10 frames/s", "finalised", "avoidance", "late p99", "overruns", "control.applied_action"):
        assert part in text
    assert "since the episode's start [s]" in text  # square brackets are not markup


def test_info_as_json_holds_everything(recorded, capsys):
    assert data.main(["info", "--root", str(recorded), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert [episode["index"] for episode in summary["episodes"]] == [0, 1, 2]
    for episode in summary["episodes"]:
        assert json.loads(episode["metadata"]["timing"])["overruns"] == 0
        assert len(episode["metadata"]["initial_state"]) > 20
        assert set(json.loads(episode["metadata"]["versions"])) == {"bhd_lerobot", "lerobot", "mujoco", "numpy"}
    assert summary["recording"]["brain"]["type"] == "avoidance"


def test_repair_of_a_sound_dataset_has_nothing_to_do(recorded, capsys):
    assert data.main(["repair", str(recorded)]) == 0
    assert "nothing to do" in capsys.readouterr().out


def test_repair_reports_what_it_dropped(recorded, tmp_path, capsys):
    root = tmp_path / "d"
    shutil.copytree(recorded, root)
    leftover = root / "data" / "chunk-000" / "file-007.parquet"
    leftover.write_bytes(b"half an episode")
    assert data.main(["repair", str(root)]) == 0
    assert "file-007.parquet" in capsys.readouterr().out
    assert not leftover.exists()


@pytest.mark.parametrize("command", ["info", "repair"])
def test_a_corrupted_file_is_named_and_left_alone(recorded, tmp_path, capsys, command):
    root = tmp_path / "d"
    shutil.copytree(recorded, root)
    path = next((root / "data").rglob("*.parquet"))
    content = bytearray(path.read_bytes())
    content[-50:] = bytes(50)
    path.write_bytes(content)
    assert data.main([command, str(root)]) == 2
    error = capsys.readouterr().err
    assert path.name in error
    assert path.read_bytes() == content


def test_no_dataset_and_no_argument(tmp_path, capsys):
    assert data.main(["info", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        data.main(["info"])
    assert stop.value.code == 2
