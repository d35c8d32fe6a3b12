"""`bhd-data check`: what it prints, and with what status it ends."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bhd_lerobot.bodies.registry import OF_FILES
from bhd_lerobot.cli.data import check, main, repair
from bhd_lerobot.cli.data.check import limits_of
from bhd_lerobot.registry import robot_configs


def broken(drives: Path, tmp_path: Path, value: float) -> Path:
    """A copy with an applied forward speed that is not what was recorded."""
    root = Path(shutil.copytree(drives, tmp_path / "d"))
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    rows = table.to_pydict()
    rows["control.applied_action"][5][0] = value
    pq.write_table(pa.table(rows, schema=table.schema), path)
    return root


def test_errors_and_with_strict_warnings_end_with_status_1(drives: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    root = broken(drives, tmp_path, 0.5)
    assert main.main(["check", str(root)]) == 1  # statistics are not those of the data
    text = capsys.readouterr().out
    assert "the robot's limits are -0.22 and 0.22" in text
    assert "not valid, 1 error, " in text
    shutil.rmtree(root)
    root = Path(shutil.copytree(drives, tmp_path / "d"))
    (root / "data/chunk-000/file-009.parquet").write_bytes(b"left")
    assert main.main(["check", str(root)]) == 0
    assert main.main(["check", str(root), "--strict"]) == 1
    assert "file-009" in capsys.readouterr().out


def test_every_robot_of_ours_has_the_limits_of_its_configuration() -> None:
    for name, kind in robot_configs().items():
        if name in OF_FILES:  # others record an SO-101 in degrees under that name
            assert limits_of(name) == {}
            continue
        body = kind().body()
        limits = body.limits
        ranges = limits_of(name)["control.applied_action"]
        assert list(ranges) == list(limits.names)
        for index, (low, high) in enumerate(ranges.values()):
            is_speed = np.isinf(limits.upper[index])
            assert high == (limits.velocity if is_speed else limits.upper)[index]
            assert low == (-high if is_speed else limits.lower[index])
    assert limits_of("turtlebot3")["control.applied_action"]["x.vel"] == (-0.22, 0.22)
    assert limits_of("ur5")["observation.state"]["gripper.pos"] == (0.0, 0.085)
    assert limits_of("so101_follower") == limits_of(None) == {}


@pytest.mark.parametrize(
    ("command", "message"), [("check", "nothing was changed"), ("repair", "run it again to finish")]
)
def test_ctrl_c_is_a_line_and_status_130(drives: Path, capsys, monkeypatch, command: str, message: str) -> None:
    def interrupted(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    module = {"check": check, "repair": repair}[command]
    monkeypatch.setattr(module, command, interrupted)
    assert main.main([command, str(drives)]) == 130
    assert capsys.readouterr().err == f"Stopped; {message}.\n"
