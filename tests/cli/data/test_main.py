"""bhd-data: what it shows, and what it says about what is broken."""

import json
import signal
import sys

import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from tests.cli.test_start import run_unread
from tests.datasets import foreign, support
from tests.recording.support import run_record


def test_each_command_is_found_in_the_module_that_has_it(capsys: pytest.CaptureFixture[str]) -> None:
    for command in main.MODULES:
        with pytest.raises(SystemExit) as end:
            main.main([command, "--help"])
        assert (end.value.code, capsys.readouterr().out.split()[:3]) == (0, ["usage:", "bhd-data", command])


def test_info_shows_outcome_and_timing_of_every_episode(drives, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    assert main.main(["info", str(drives)]) == 0
    text = capsys.readouterr().out
    for part in ("turtlebot3, 10 frames/s", "finalised", "avoidance", "late p99", "overruns", "control.applied_action"):
        assert part in text
    assert "since the episode's start [s]" in text  # square brackets are not markup


def test_ten_times_the_episodes_take_at_most_twice_the_work(tmp_path, capsys):
    """Counted in calls of Python's functions, which no other load changes."""
    counts = []
    for episodes in (30, 30, 300):  # what the first needs is imported now
        root = foreign.write(tmp_path / f"d{len(counts)}", (2,) * episodes)
        counts.append(0)

        def count(frame, event, argument):
            counts[-1] += event == "call"

        sys.setprofile(count)
        try:
            assert main.main(["info", str(root)]) == 0
        finally:
            sys.setprofile(None)
        text = capsys.readouterr().out
        assert len(text.splitlines()) > episodes
        assert "timing" not in text  # another program measured none
    assert counts[2] < 2 * counts[1]


def test_info_of_several_datasets(drives, tmp_path, capsys):
    other = tmp_path / "[b]other"  # square brackets are not markup
    run_record(other, dataset__num_episodes=1, robot__beams=18)
    assert main.main(["info", "--short", str(drives), str(other)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{drives}: turtlebot3, 3 episodes, 90 frames, 9 s, ")
    assert first.endswith(" MB, timeout 3")
    assert second.startswith(f"{other}: turtlebot3, 1 episode, 30 frames, 3 s, ")
    # One that is none does not hide the others.
    assert main.main(["info", str(tmp_path / "none"), str(drives), "--short"]) == 2
    captured = capsys.readouterr()
    assert captured.out == first + "\n"
    assert "does not exist" in captured.err
    assert main.main(["info", "--json", str(drives), str(other)]) == 0
    assert [one["root"] for one in json.loads(capsys.readouterr().out)] == [str(drives), str(other)]
    assert main.main(["check", str(other)]) == 0
    assert f"{other}: 1 episode, 30 frames: valid" in capsys.readouterr().out
    assert main.main(["info", str(other), str(drives)]) == 0
    output = capsys.readouterr().out
    assert str(other) in output.replace("\n", "")
    assert output.count("Features") == 2


def test_an_empty_dataset_is_called_empty(tmp_path, capsys):
    features = {"action": {"dtype": "float32", "shape": (1,), "names": ["x"]}}
    root = tmp_path / "d"
    DatasetRecorder.create("t/none", 10, features, robot_type="toy", root=root, recording={}).finalize()
    new = ["--output", str(tmp_path / "new")]
    for status, command in (
        *((0, ["info"]), (0, ["info", "--short"]), (1, ["check"]), (0, ["repair"]), (1, ["check", "--strict"])),
        *((2, ["filter", "--outcome", "all", *new]), (2, ["split", "--parts", "a=0.5", *new])),
        *((2, ["delete", "--episodes", "0"]), (2, ["mark", "--episodes", "0", "--outcome", "failure"])),
    ):
        assert main.main([command[0], str(root), *command[1:]]) == status
        captured = capsys.readouterr()
        assert "empty" in captured.out + captured.err, command
    assert not (tmp_path / "new").exists()


def test_a_dataset_is_named_in_one_of_three_ways(drives, monkeypatch):
    monkeypatch.setenv("HF_LEROBOT_HOME", str(drives.parent))
    for arguments in (["--repo_id", drives.name], ["--root", str(drives)], [str(drives)]):
        assert main.main(["repair", *arguments]) == 0


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("arguments", [["info"], ["check", "--json"]])
def test_a_closed_output_ends_the_command_without_a_message(drives, arguments):
    done = run_unread("-m", "bhd_lerobot.cli.data.main", *arguments, str(drives))
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


def test_a_recording_in_progress_is_not_called_interrupted(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    root = tmp_path / "d"
    recorder = support.create(root)
    support.record(recorder)
    message = "not finalised: it is being recorded or changed at this moment"
    for command in (["info"], ["info", "--short"]):
        assert main.main([*command, str(root)]) == 0
        assert message in capsys.readouterr().out
    for command in ("check", "repair", "view"):
        assert main.main([command, str(root)]) == 2
        assert "being" in capsys.readouterr().err
    recorder._lock.release()  # as if it had been killed
    assert main.main(["info", "--short", str(root)]) == 0
    assert "an interrupted recording; `bhd-data repair` finishes it" in capsys.readouterr().out
    assert main.main(["repair", str(root)]) == 0
    assert main.main(["check", str(root)]) == 0
    capsys.readouterr()
    assert main.main(["info", "--short", str(root)]) == 0
    assert "not finalised" not in capsys.readouterr().out
