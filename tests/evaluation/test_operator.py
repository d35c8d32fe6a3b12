"""Real runs: brains in turns, in an order that nothing shows, judged by a person's keys, continued after any end."""

import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.cli.evaluate import main
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.evaluation.operator import drawn_orders
from tests.forks import Fork, Terminal
from tests.recording.support import command_line

LABELS = ("quixote", "zeppelin")
CAMERAS = "{front: {type: mock_camera}}"


def options(folder: Path, **overrides: object) -> list[str]:
    values = {
        "robot.discover_packages_path": "tests.robots.external.mock_devices",
        "robot.type": "mock_arm",
        "robot.calibration_dir": folder / "calibration",
        "task.type": "free",
        "task.instruction": "wave",
        "task.duration_s": 60,
        "brains.quixote.type": "noop",
        "brains.zeppelin.type": "teleop",
        "brains.zeppelin.teleop.type": "mock_leader",
        "brains.zeppelin.teleop.calibration_dir": folder / "calibration",
        "n_episodes": 3,
        "seed": 5,
        "output_dir": folder / "e",
    }
    return command_line(values, overrides)


class Judged(Terminal):
    """bhd-eval as a program of its own, with a terminal at which a script sits."""

    def __init__(self, folder: Path, **overrides: object) -> None:
        super().__init__(main, options(folder, **overrides), log=folder / "log")

    def prompted(self, number: int) -> str:
        """Wait for the prompt before an episode, and return it."""
        prompt = rf"Episode {number} of \d+, scene .*press Enter"
        self.expect(prompt)
        (found,) = re.findall(prompt, self.text())
        return str(found)

    def begin(self, number: int) -> None:
        """Set up a scene: Enter, and wait until the episode runs."""
        self.prompted(number)
        self.type(b"\r")
        self.expect(rf"Episode {number} of \d+ runs")

    def judge(self, keys: str, first: int = 1) -> None:
        """Judge episodes, from a number on, by a key each."""
        for number, key in enumerate(keys, first):
            self.begin(number)
            self.type(key.encode())


def outcomes(folder: Path) -> dict[str, list[str]]:
    """Return how the episodes of each brain ended, in the order of their numbers."""
    episodes = json.loads((folder / "e" / "results.json").read_text())["episodes"]
    return {label: [one["outcome"] for one in episodes if one["brain"] == label] for label in LABELS}


def orders(folder: Path) -> dict[str, list[str]]:
    """Return the order in which the brains run each episode."""
    return dict(json.loads((folder / "e" / "order.json").read_text()))


def expected(folder: Path, keys: str) -> dict[str, list[str]]:
    """Return what keys mean, that come in the order in which the brains run."""
    found: dict[str, list[str]] = {label: [] for label in LABELS}
    for index in range(-(-len(keys) // 2)):
        for label, key in zip(orders(folder)[str(index)], keys[2 * index : 2 * index + 2], strict=False):
            found[label].append({"s": "success", "f": "failure"}[key])
    return found


def test_the_order_is_a_permutation_for_each_episode_that_is_drawn_once_for_each_evaluation(tmp_path):
    labels = ["a", "b", "c"]
    folders = tmp_path / "one", tmp_path / "other"
    for folder in folders:
        folder.mkdir()
    one, other = (drawn_orders(folder, labels, range(6000)) for folder in folders)
    assert all(sorted(order) == labels for order in one.values())
    assert one != other
    assert one == drawn_orders(folders[0], labels, range(6000))
    # Each brain is as often the first as any other: 2000 of 6000, with a standard deviation of 37.
    assert all(abs(sum(order[0] == label for order in one.values()) - 2000) < 8 * 37 for label in labels)
    assert np.unique([", ".join(order) for order in one.values()]).size == 6
    # What is left of an evaluation that was killed before its results were there, of other brains or episodes.
    for left in (json.dumps(one), '{"0": ["a", "b"]}', '{"0": ["a"], "1": ["b"]}', '{"0": ["a",', "[]", "null"):
        (folders[0] / "order.json").write_text(left)
        drawn = drawn_orders(folders[0], ["b", "a"], range(2))
        assert {number: sorted(order) for number, order in drawn.items()} == {"0": ["a", "b"], "1": ["a", "b"]}, left
        assert drawn == drawn_orders(folders[0], ["b", "a"], range(2)), left


def test_keys_judge_in_a_blinded_order_and_the_report_says_which_brain_it_was(tmp_path):
    run = Judged(tmp_path, robot__cameras=CAMERAS)
    keys = "sfffss"
    run.judge(keys)
    assert run.wait() == 0, run.text()
    text = run.text()
    assert "Episode 1 of 6, scene 0 (wave): set up the scene, then press Enter" in text
    before, _, after = text.partition("6/6")
    assert "Episode 6 of 6 runs" in before
    for label in LABELS:
        assert label not in before
        assert label in after
    assert outcomes(tmp_path) == expected(tmp_path, keys)
    written = json.loads((tmp_path / "e" / "results.json").read_text())
    assert written["partial"] is False
    assert written["config"]["order"] == orders(tmp_path)
    assert all(one["path_m"] is None for one in written["episodes"])  # nobody knows where the tool was
    page = (tmp_path / "e" / "report.html").read_text(encoding="utf-8")
    assert "no prompt said which one ran" in page
    assert "there is no simulator to render" in page
    assert "rad/s" not in page  # LeRobot's robots say no units


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, "q"], ids=["kill", "term", "q"])
def test_the_same_command_continues_with_what_is_missing_in_the_same_order(tmp_path, end):
    recorded = {"record__repo_id": "me/real", "record__root": tmp_path / "data", "robot__cameras": CAMERAS}
    run = Judged(tmp_path, **recorded)
    keys = "sfsffs"
    run.judge(keys[:3])
    run.begin(4)
    if end == "q":
        run.type(b"q")
    else:
        run.send_signal(end)
    assert run.wait() == {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 128 + signal.SIGTERM, "q": 0}[end]
    if end != signal.SIGKILL:
        text = " ".join(run.text().split())
        assert "The same command runs the missing episodes, and shows the results at the end." in text
        assert not any(label in text for label in LABELS)  # nobody is told how they are doing
        assert outcomes(tmp_path) == expected(tmp_path, keys[:3])
    prompt = run.prompted(4)

    run = Judged(tmp_path, **recorded)
    assert run.prompted(4) == prompt
    assert "Episode 3 of" not in run.text()
    run.judge(keys[3:], first=4)
    assert run.wait() == 0, run.text()
    assert outcomes(tmp_path) == expected(tmp_path, keys)
    assert all(check_dataset(tmp_path / "data" / label).is_valid for label in LABELS)


def test_without_a_terminal_nobody_is_waited_for_and_that_is_said(tmp_path):
    run = Fork(main, options(tmp_path, task__duration_s=0.2, n_episodes=1), output=tmp_path / "log")
    assert run.wait() == 0
    text = (tmp_path / "log").read_text()
    assert "Standard input is not a terminal" in text
    assert "--record.repo_id=me/eval" in text
    assert outcomes(tmp_path) == {label: ["timeout"] for label in LABELS}


def test_an_emergency_stop_while_a_scene_is_set_up_ends_the_run(tmp_path):
    run = Judged(tmp_path)
    run.judge("s")
    run.prompted(2)
    run.type(b" ")
    assert run.wait() == 3
    assert "Emergency stop (key)" in " ".join(run.text().split())
    assert sum(map(len, outcomes(tmp_path).values())) == 1


def test_a_fault_of_the_robot_ends_the_run_and_what_was_judged_is_kept(tmp_path):
    run = Judged(tmp_path, robot__fault="disconnect", robot__fault_at=40)
    run.begin(1)
    assert run.wait() == 4
    assert "the bus does not answer" in " ".join(run.text().split())
    assert json.loads((tmp_path / "e" / "results.json").read_text())["partial"] is True


def test_a_sequential_test_ends_a_real_run(tmp_path):
    """The key after each prompt is for one brain, whichever runs: it wins all of 8 pairs."""
    run = Judged(tmp_path, n_episodes=30, sequential="true")
    run.prompted(1)
    drawn = orders(tmp_path)
    keys = "".join("s" if label == "zeppelin" else "f" for i in range(8) for label in drawn[str(i)])
    run.judge(keys)
    assert run.wait() == 0, run.text()
    assert "The sequential test ended the run after 8 of 30 pairs of episodes" in " ".join(run.text().split())
    written = json.loads((tmp_path / "e" / "results.json").read_text())
    assert written["partial"] is False
    assert written["paired"]["zeppelin"]["e_value"] == pytest.approx(2**8 / 9)
