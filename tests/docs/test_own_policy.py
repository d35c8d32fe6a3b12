"""The page about an own policy type is true: its files train and drive as it says."""

import os
import re
import sys
from pathlib import Path

from bhd_lerobot.cli import evaluate, train
from tests.docs.support import ROOT
from tests.forks import Fork
from tests.recording.support import run_record

PAGE = ROOT / "docs" / "how_to" / "own_policy.md"


def run(folder: Path) -> int:
    """Record, and train and evaluate the page's policy, in a folder where its files are."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))  # PYTHONPATH=. of an interpreter that has started already
    run_record(folder / "data" / "avoid", robot__beams=36, dataset__num_episodes=2, dataset__episode_time_s=1)
    text = PAGE.read_text(encoding="utf-8").replace("\\\n", " ")
    commands = dict(re.findall(r"^(bhd-\w+) (.*) …$", text, re.MULTILINE))
    shorter = {
        "bhd-train": ["--steps=5", "--batch_size=4", "--policy.device=cpu"],
        "bhd-eval": ["--robot.beams=36", "--task.duration_s=1", "--n_episodes=2", "--n_envs=2", "--videos=0"],
    }
    mains = {"bhd-train": train.main, "bhd-eval": evaluate.main}
    assert commands.keys() == mains.keys()
    return max(mains[name]([*commands[name].split(), *shorter[name]]) for name in mains)


def test_its_files_train_and_drive(tmp_path: Path) -> None:
    files = re.findall(
        r'^```python title="(\S+)"\n(.*?)^```', PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert len(files) == 4
    for name, text in files:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    process = Fork(run, tmp_path, output=tmp_path / "log")
    assert process.wait() == 0, (tmp_path / "log").read_text()[-3000:]
    assert (tmp_path / "outputs/linear/checkpoints/last/pretrained_model/config.json").is_file()
