#!/bin/sh
# LeRobot's split by fractions gives the last split every episode that is left, whatever its fraction is.
#
# Versions: lerobot 0.6.1; Python 3.12, Linux, x86-64.
#
# A dataset of 20 episodes is split with the fractions {"train": 0.5, "val": 0.1}. The documentation of split_dataset asks
# for fractions with a sum of at most 1, so that 8 episodes belong to no split. "val" gets 10 episodes in place of 2. The
# same fractions in the other order give 18 episodes to "train" in place of 10.
#
# Expected: 10 and 2 episodes, in either order.
#
# Output seen:
#   lerobot 0.6.1, 20 episodes
#   {'train': 0.5, 'val': 0.1}: {'train': 10, 'val': 10}
#   {'val': 0.1, 'train': 0.5}: {'val': 2, 'train': 18}
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check "lerobot[dataset]==0.6.1"
export HF_HUB_OFFLINE=1 HF_HOME="$folder/home" HF_LEROBOT_HOME="$folder/home/lerobot"
"$folder/venv/bin/python" - "$folder" <<'PY' 2>/dev/null
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

folder = Path(sys.argv[1])
features = {"observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}}
dataset = LeRobotDataset.create("me/whole", 10, features, root=folder / "whole", use_videos=False)
for episode in range(20):
    for frame in range(3):
        dataset.add_frame({"observation.state": np.array([episode, frame], np.float32), "task": "wait"})
    dataset.save_episode()
dataset.finalize()
dataset = LeRobotDataset("me/whole", root=folder / "whole")
print(f"lerobot {version('lerobot')}, {dataset.meta.total_episodes} episodes")
found = []
for number, fractions in enumerate(({"train": 0.5, "val": 0.1}, {"val": 0.1, "train": 0.5})):
    parts = split_dataset(dataset, fractions, folder / str(number))
    found.append({name: part.meta.total_episodes for name, part in parts.items()})
    print(f"{fractions}: {found[-1]}")
sys.exit(found != [{"train": 10, "val": 10}, {"val": 2, "train": 18}])
PY
