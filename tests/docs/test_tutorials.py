"""The tutorials run as they stand: each notebook is its tutorial, and every cell of it works."""

import re
from pathlib import Path

import pytest

from tests.docs.run_notebook import run
from tests.docs.support import ROOT, load_script
from tests.forks import Fork

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
# Something that the output has to contain, because it is what the tutorial is about.
SHOWN = {
    "record_and_look": [
        *("Look at it with: bhd-data view data/first", "400 frames in 4 episodes", "valid, no errors"),
        "identical in 100 frames",
    ],
    "train_and_evaluate": [" of 3 episodes succeeded", "step   20", "difference: "],
    "cameras": ["12 tables in", "chose an object: ", "rule: 2 of 2"],
    "from_a_ros2_bag": ["Look at it with: bhd-data view data/drives", "control.applied_action", "valid, no errors"],
    "from_the_articles": [
        *("valid, no errors", "Hz; interval: mean", " messages in ", " messages published"),
        *("test_move_001 True", "test_move_002 False"),
    ],
    "your_own": ["4 of 4 episodes succeeded", "gap_follower 4 of 4"],
}
# Its outputs are not kept: it takes a quarter of an hour.
LONG = {"cameras"}
# The short form of what takes longer than a few seconds.
SHORTER = {
    "cameras": {
        '"num_episodes": 1500': '"num_episodes": 12',
        '"camera_width": 320, "camera_height": 240': '"camera_width": 96, "camera_height": 72',
        '"eval_split": 0.05': '"eval_split": 0.25',
        '{"type": "bhd_perception"}': '{"type": "bhd_perception", "channels": 8, "hidden": 8, "context": 8}',
        "batch_size=16": "batch_size=4",
        "steps=2400": "steps=4",
        "eval_steps=1200": "eval_steps=4",
        "n_episodes=200": "n_episodes=4",
        "n_episodes=20,": "n_episodes=2,",
        "videos=1,": "videos=0,",
    },
    "from_the_articles": {
        "--n_envs=4 --preview_video=false": "--n_envs=4 --preview_video=false --dataset.episode_time_s=10",
        "--steps=200": "--steps=10",
        "--n_episodes=2": "--n_episodes=2 --task.duration_s=5",
        "--seconds=3": "--seconds=1.5",
    },
    "train_and_evaluate": {
        '"num_episodes": 16}': '"num_episodes": 3, "episode_time_s": 10}',
        "n_envs=16": "n_envs=3",
        "steps=1000": "steps=20",
        "n_episodes=16": "n_episodes=2, videos=0",
        'task="avoid",\n    brains': 'task={"type": "avoid", "duration_s": 10},\n    brains',
    },
}


def test_every_tutorial_is_known_and_its_notebook_is_up_to_date() -> None:
    script = load_script("make_notebooks")
    assert {path.stem for path in TUTORIALS} == set(SHOWN)
    for path in TUTORIALS:
        written = path.parent / "notebooks" / f"{path.stem}.ipynb"
        assert written.read_text(encoding="utf-8") == script.notebook(path), "run: python scripts/make_notebooks.py"


def test_outputs_are_those_of_the_whole_tutorial() -> None:
    for path in TUTORIALS:
        text = path.read_text(encoding="utf-8")
        outputs = "".join(re.findall(r"^```output\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
        assert path.stem in LONG or outputs, path
        if path.stem not in SHORTER:
            assert [shown for shown in SHOWN[path.stem] if shown not in outputs] == [], path


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_it_runs(tutorial: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    notebook = tutorial.parent / "notebooks" / f"{tutorial.stem}.ipynb"
    status = Fork(run, notebook, folder, SHORTER.get(tutorial.stem, {}), output=tmp_path / "out").wait()
    printed = (tmp_path / "out").read_text(encoding="utf-8")
    assert status == 0, printed
    for text in SHOWN[tutorial.stem]:
        assert text in printed, printed
