import os
import subprocess
from pathlib import Path

from tests.arrows import PACKAGE, ROOT
from tests.wheels import install

RECORD = """
import sys
from bhd_lerobot.cli import start
print(sys.modules["bhd_lerobot"].__file__)
sys.exit(start.record())
"""


def test_a_wheel_records_by_the_name_of_a_configuration(tmp_path: Path) -> None:
    python = install(ROOT, tmp_path)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["NUMBA_DISABLE_JIT"] = "1"  # or it would be compiled once more, for this folder
    options = (
        "--config_path=turtlebot3_avoid",
        "--dataset.num_episodes=1",
        "--task.duration_s=1",
        "--task.min_path_m=0",
    )
    command = [python, "-c", RECORD, *options, f"--dataset.root={tmp_path / 'avoid'}", "--preview_video=false"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    installed, package = Path(done.stdout.splitlines()[0]).parent, ROOT / PACKAGE
    assert installed.is_relative_to(tmp_path / "environment")
    files = {path.relative_to(package) for path in package.rglob("*") if path.is_file()}
    left_out = {path for path in files if not (installed / path).exists() and "__pycache__" not in path.parts}
    assert left_out == set()
    assert len(list((tmp_path / "avoid" / "data").rglob("*.parquet"))) == 1
