from pathlib import Path

import pytest

from bhd_lerobot.cli import record


@pytest.mark.parametrize("text", ["ur5_pik", "turtlebot"])
def test_the_name_of_no_configuration_is_refused_with_the_valid_ones(text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert record.main([f"--config_path={text}"]) == 2
    message = capsys.readouterr().err
    assert repr(text) in message
    assert "Valid: turtlebot3_avoid, " in message


def test_a_file_goes_before_the_configuration_of_the_same_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("ur5_pick").write_text("robot: {type: turtlebot3, color: red}\n")
    assert record.main(["--config_path=ur5_pick"]) == 2
    assert "robot.color" in capsys.readouterr().err
