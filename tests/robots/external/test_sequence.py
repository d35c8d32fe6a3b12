"""The commands of docs/how_to/your_robot.md, one after the other, with a mock robot in the place of a real one."""

import json
import os
import re
import shlex
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.cli import evaluate, record, train
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.tasks.task import Event
from tests.docs.test_documents import quoted_commands
from tests.forks import Fork, Terminal
from tests.recording.support import saved
from tests.waiting import until

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how_to" / "your_robot.md"
PLUGIN = "--robot.discover_packages_path=tests.robots.external.mock_devices"
ROBOT = "--robot.type=mock_arm --robot.cameras={front: {type: mock_camera}, wrist: {type: mock_camera}}"
SHORTER = {
    "--task.duration_s=20": "--task.duration_s=1",
    "--dataset.num_episodes=20": "--dataset.num_episodes=2",
    "--dataset.num_episodes=40": "--dataset.num_episodes=4",
    "--dataset.num_episodes=10": "--dataset.num_episodes=1",
    "--dataset.reset_time_s=15": "--dataset.reset_time_s=0.2",
    "--n_episodes=10": "--n_episodes=2",
}
SMALL = [
    *("--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=16", "--policy.chunk_size=5"),
    *("--policy.n_action_steps=5", "--policy.pretrained_backbone_weights=null", "--steps=2", "--batch_size=2"),
]


def arguments_of(line: str) -> list[str]:
    """Return the arguments of a command of the page, for the mock robot and shorter."""
    arguments = [SHORTER.get(argument, argument) for argument in shlex.split(line)[1:]]
    arguments = [one for one in arguments if not re.match(r"--(robot|teleop)\.", one)]
    if line.startswith(("bhd-record", "bhd-eval")):
        robot = [f"--robot.{part}" for part in ROBOT.removeprefix("--robot.").split(" --robot.")]
        leader = ["--teleop.type=mock_leader"] * line.startswith("bhd-record")
        arguments = [PLUGIN, *robot, *leader, *arguments]
    return arguments + SMALL * line.startswith("bhd-train")


@pytest.mark.thorough
def test_the_commands_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    section = [line for line in quoted_commands(PAGE) if "data/cup" in line]
    first, resumed, check, timing, view, training, corrected, compared = section
    root = tmp_path / "data" / "cup"

    # A kill costs the running episode at most.
    killed = Terminal(record.main, arguments_of(first), log=tmp_path / "first.log")
    until(lambda: saved(root) >= 1 or killed.poll() is not None, "an episode is saved")
    killed.kill()
    before = saved(root)

    # It continues; a take is discarded and recorded again, one is a success.
    person = Terminal(record.main, arguments_of(resumed), log=tmp_path / "resumed.log")
    until(lambda: saved(root) > before or person.poll() is not None, "an episode is added")
    person.expect("Keys:")
    person.type(b"r")
    until(lambda: saved(root) > before + 1 or person.poll() is not None, "another is added")
    time.sleep(0.5)
    person.type(b"s")
    assert person.wait() == 0, person.text()
    info = dataset_info(root)
    assert len(info.episodes) == 4
    for episode in info.episodes:
        columns = read_episode(root, episode.index)
        assert len(columns["action"]) == episode.frames
        assert np.asarray(columns["control.time"])[0] < 0.5  # a discarded take leaves no frame

    assert data.main(arguments_of(check)) == 0
    assert data.main(arguments_of(timing)) == 0
    viewer = Fork(data.main, [*arguments_of(view), "--no-browser", "--port=0"], output=tmp_path / "view.log")
    until(lambda: "http://127.0.0.1" in (tmp_path / "view.log").read_text(), "the viewer serves")
    os.kill(viewer.pid, signal.SIGINT)
    until(lambda: viewer.poll() is not None, "the viewer has ended")

    trained = Fork(train.main, arguments_of(training), output=tmp_path / "train.log")
    until(lambda: trained.poll() is not None, "it is trained")
    assert trained.poll() == 0, (tmp_path / "train.log").read_text()[-2000:]

    # A person takes over from the policy, and gives back.
    longer = [one.replace("duration_s=1", "duration_s=6") for one in arguments_of(corrected)]
    person = Terminal(record.main, longer, log=tmp_path / "corrected.log")
    while person.poll() is None:
        person.expect("not promised")
        person.type(b"i")
        time.sleep(0.7)
    assert person.wait() == 0, person.text()
    (episode,) = dataset_info(tmp_path / "data" / "cup_corrected").episodes
    assert {span[2] for span in json.loads(episode.metadata["interventions"])} == {"person"}
    events = np.asarray(read_episode(tmp_path / "data" / "cup_corrected", 0)["event"])
    assert (events == Event.INTERVENTION).any()

    # Two brains in an order that is not shown: the person judges by keys.
    person = Terminal(evaluate.main, arguments_of(compared), log=tmp_path / "compared.log")
    for number in range(1, 5):
        person.expect(f"Episode {number} of 4, scene")
        person.type(b"\r")
        person.expect(f"Episode {number} of 4 runs")
        person.type(b"s" if number % 2 else b"f")
    assert person.wait() == 0, person.text()
    assert not re.search(r"\b(act|hold)\b", person.text().split("Episode 4 of 4 runs")[0])
    results = json.loads((tmp_path / "outputs" / "eval" / "cup" / "results.json").read_text())
    assert sum(brain["successes"] for brain in results["brains"].values()) == 2
