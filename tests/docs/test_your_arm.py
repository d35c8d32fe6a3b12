"""The page about an arm from a file is true: its commands work with a file, and so does its plug-in."""

import os
import re
import shlex
import shutil
import sys
from importlib import resources
from pathlib import Path

from bhd_lerobot.cli import doctor, evaluate, record, train
from tests.docs.support import ROOT
from tests.forks import Fork

PAGE = ROOT / "docs" / "how_to" / "your_arm.md"
SHORTER = {
    "bhd-doctor": [],
    "bhd-record": ["--dataset.num_episodes=2", "--n_envs=2"],
    "bhd-train": ["--steps=5", "--batch_size=4"],
    "bhd-eval": ["--n_episodes=2", "--n_envs=2", "--videos=0", "--task.duration_s=2"],
}
MAINS = {"bhd-doctor": doctor.main, "bhd-record": record.main, "bhd-train": train.main, "bhd-eval": evaluate.main}


def run(folder: Path) -> int:
    """Run the page's commands, in short, in a folder with the file."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    text = PAGE.read_text(encoding="utf-8").partition("## From simulation to your arm")[0].replace("\\\n", " ")
    commands = re.findall(r"^(bhd-\w+) (.*)$", text, re.MULTILINE)
    assert [name for name, _ in commands] == list(SHORTER)
    for name, line in commands:
        shorter = {option.partition("=")[0] for option in SHORTER[name]}
        kept = [option for option in shlex.split(line) if option.partition("=")[0] not in shorter]
        assert MAINS[name]([*kept, *SHORTER[name]]) == 0, name
    [plugin] = re.findall(r"^PYTHONPATH=. bhd-record (.*) …$", text, re.MULTILINE)
    task = ["--task.type=reach", "--brain.type=reach", "--dataset.repo_id=me/mine", "--dataset.root=data/mine"]
    return record.main([*plugin.split(), *task, "--dataset.num_episodes=1"])


def test_its_commands_work(tmp_path: Path) -> None:
    model = resources.files("bhd_lerobot.bodies").joinpath("so101.xml").read_text(encoding="utf-8")
    for name in ("robot.xml", "my_arm.xml"):
        (tmp_path / name).write_text(model, encoding="utf-8")
    shutil.copy(ROOT / "examples" / "arm" / "lerobot_robot_my_arm.py", tmp_path)
    process = Fork(run, tmp_path, output=tmp_path / "log")
    assert process.wait() == 0, (tmp_path / "log").read_text()[-3000:]
    assert (tmp_path / "robot.png").stat().st_size > 1000
