"""The pages about an own policy type and about an arm from a file are true: their files and commands work, in short."""

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
from tests.recording.support import run_record

MAINS = {"bhd-doctor": doctor.main, "bhd-record": record.main, "bhd-train": train.main, "bhd-eval": evaluate.main}


def page(name: str) -> str:
    return (ROOT / "docs" / "how_to" / f"{name}.md").read_text(encoding="utf-8")


def enter(folder: Path) -> None:
    os.chdir(folder)
    sys.path.insert(0, str(folder))  # PYTHONPATH=. of an interpreter that has started already


def use_a_policy(folder: Path) -> int:
    """Record, and train and evaluate the page's policy, in a folder where its files are."""
    enter(folder)
    run_record(folder / "data" / "avoid", robot__beams=36, dataset__num_episodes=2, dataset__episode_time_s=1)
    commands = dict(re.findall(r"^(bhd-\w+) (.*) …$", page("own_policy").replace("\\\n", " "), re.MULTILINE))
    shorter = {
        "bhd-train": ["--steps=5", "--batch_size=4", "--policy.device=cpu"],
        "bhd-eval": ["--robot.beams=36", "--task.duration_s=1", "--n_episodes=2", "--n_envs=2", "--videos=0"],
    }
    assert commands.keys() == shorter.keys()
    return max(MAINS[name]([*commands[name].split(), *shorter[name]]) for name in commands)


def test_the_files_of_a_policy_train_and_drive(tmp_path: Path) -> None:
    files = re.findall(r'^```python title="(\S+)"\n(.*?)^```', page("own_policy"), re.DOTALL | re.MULTILINE)
    assert len(files) == 4
    for name, text in files:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    process = Fork(use_a_policy, tmp_path, output=tmp_path / "log")
    assert process.wait() == 0, (tmp_path / "log").read_text()[-3000:]
    assert (tmp_path / "outputs/linear/checkpoints/last/pretrained_model/config.json").is_file()


def use_an_arm(folder: Path) -> int:
    """Run the page's commands in a folder with the arm's file, and its plug-in."""
    enter(folder)
    shorter = {
        "bhd-doctor": [],
        "bhd-record": ["--dataset.num_episodes=2", "--n_envs=2"],
        "bhd-train": ["--steps=5", "--batch_size=4"],
        "bhd-eval": ["--n_episodes=2", "--n_envs=2", "--videos=0", "--task.duration_s=2"],
    }
    text = page("your_arm").partition("## From simulation to your arm")[0].replace("\\\n", " ")
    commands = re.findall(r"^(bhd-\w+) (.*)$", text, re.MULTILINE)
    assert [name for name, _ in commands] == list(shorter)
    for name, line in commands:
        replaced = {option.partition("=")[0] for option in shorter[name]}
        kept = [option for option in shlex.split(line) if option.partition("=")[0] not in replaced]
        assert MAINS[name]([*kept, *shorter[name]]) == 0, name
    [plugin] = re.findall(r"^PYTHONPATH=. bhd-record (.*) …$", text, re.MULTILINE)
    task = ["--task.type=reach", "--brain.type=reach", "--dataset.repo_id=me/mine", "--dataset.root=data/mine"]
    return record.main([*plugin.split(), *task, "--dataset.num_episodes=1"])


def test_the_commands_for_an_arm_from_its_file_work(tmp_path: Path) -> None:
    model = resources.files("bhd_lerobot.bodies").joinpath("so101.xml").read_text(encoding="utf-8")
    for name in ("robot.xml", "my_arm.xml"):
        (tmp_path / name).write_text(model, encoding="utf-8")
    shutil.copy(ROOT / "examples" / "arm" / "lerobot_robot_my_arm.py", tmp_path)
    process = Fork(use_an_arm, tmp_path, output=tmp_path / "log")
    assert process.wait() == 0, (tmp_path / "log").read_text()[-3000:]
    assert (tmp_path / "robot.png").stat().st_size > 1000
