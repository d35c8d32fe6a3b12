"""The demo runs without further input and names files that exist."""

import re
from pathlib import Path

from PIL import Image

from bhd_lerobot.runs import demo


def test_the_demo_records_replays_and_summarises(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "EPISODES", 2)
    monkeypatch.setattr(demo, "PICKS", 2)
    monkeypatch.setattr(demo, "SECONDS", 4)
    monkeypatch.setenv("COLUMNS", "300")
    assert demo.main([str(tmp_path / "demo")]) == 0
    text = capsys.readouterr().out
    for part in ("2 episodes", "Features", "LeRobotDataset: 2 episodes", "subtask:", "2 of 2"):
        assert part in text
    assert text.count("identical") == 4  # two robots, two modes
    named = [Path(line.strip()) for line in re.findall(r"^  (\S+\.(?:png|mp4|yaml))$", text, re.MULTILINE)]
    assert all(path.exists() for path in named)
    assert {path.parent.name for path in named} == {"turtlebot3", "ur5"}
    pictures = [path for path in named if path.name == "episode.png"]
    for picture in pictures:  # none where nothing can be rendered
        assert min(Image.open(picture).size) > 400
