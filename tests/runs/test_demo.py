"""The demo runs without further input and names files that exist."""

from bhd_lerobot.runs import demo


def test_the_demo_records_replays_and_summarises(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "EPISODES", 2)
    monkeypatch.setattr(demo, "SECONDS", 4)
    monkeypatch.setenv("COLUMNS", "200")
    assert demo.main([str(tmp_path / "demo")]) == 0
    text = capsys.readouterr().out
    for part in ("2 episodes", "identical", "Features", "LeRobotDataset: 2 episodes", "trajectories.png"):
        assert part in text
    assert (tmp_path / "demo" / "trajectories.png").exists()
