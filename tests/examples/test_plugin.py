"""The plug-in of `examples/plugin`, built and unpacked where Python finds it, and used in every program."""

import json
import sys
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_teleoperate

from bhd_lerobot.apps.view.dataset import ViewedDataset
from bhd_lerobot.apps.view.packing import unpack
from bhd_lerobot.cli import evaluate, record
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.options.parse import parse
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.rollout.replay.simulated import replay
from tests.forks import Fork
from tests.wheels import wheel_of

PLUGIN = Path(__file__).resolve().parents[2] / "examples" / "plugin"


def use(folder: Path) -> int:
    """Use the plug-in in a process that finds it as if it were installed."""
    sys.path.insert(0, str(folder / "site"))
    assert "lerobot_robot_corridor" not in sys.modules
    chosen = ["--robot.type=rover", "--robot.beams=36", "--task.type=corridor"]
    recorded = ["--dataset.repo_id=me/corridor", f"--dataset.root={folder / 'd'}", "--dataset.num_episodes=3"]
    options = [*recorded, f"--output_dir={folder / 'run'}", "--n_envs=3", "--preview_video=false"]
    assert record.main([*chosen, "--brain.type=wall_follower", *options]) == 0
    again = [f"--dataset.root={folder / 'd'}", "--dataset.episode=1", f"--output_dir={folder / 'replay'}"]
    replayed = replay(parse(ReplayConfig, again))
    assert replayed
    assert all(one.identical for one in replayed)
    brains = ["--brains.mine.type=wall_follower", "--brains.gaps.type=gap_follower"]
    few = ["--n_episodes=2", "--n_envs=2", f"--output_dir={folder / 'eval'}", "--videos=0"]
    assert evaluate.main([*chosen, *brains, *few]) == 0
    for command in (["check"], ["info"], ["export", "--output", str(folder / "bag"), "--episodes=0"]):
        assert data.main([command[0], str(folder / "d"), *command[1:]]) == 0, command
    about, arrays = unpack(ViewedDataset(folder / "d").packed(0))
    (folder / "found.json").write_text(json.dumps({"about": about, "base": arrays["view.base"].tolist()}))
    driven = ["--teleop.type=bhd_brain", "--teleop.brain.type=wall_follower", "--teleop_time_s=0.5"]
    sys.argv = ["lerobot-teleoperate", "--robot.type=rover", *driven]
    lerobot_teleoperate.main()
    return 0


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder in which every program has used the plug-in."""
    folder = tmp_path_factory.mktemp("plugin")
    with wheel_of(PLUGIN, folder) as wheel:
        wheel.extractall(folder / "site")
    process = Fork(use, folder, output=folder / "log")
    assert process.wait() == 0, (folder / "log").read_text()
    return folder


def test_it_is_recorded_replayed_bit_for_bit_and_evaluated(used: Path) -> None:
    results = json.loads((used / "eval" / "results.json").read_text())
    assert set(results["brains"]) == {"mine", "gaps"}
    assert results["brains"]["mine"]["successes"] == 2


def test_the_viewer_draws_its_outline_and_knows_its_units(used: Path) -> None:
    found = json.loads((used / "found.json").read_text())
    about = found["about"]
    assert about["scene"]["kind"] == "arena"
    assert about["views"]["base"]["radius"] == pytest.approx(0.16, abs=0.03)
    assert about["views"]["scan"]["beams"] == 36
    assert "m/s" in json.dumps(about["sections"])
    x = [pose[0] for pose in found["base"]]
    assert x[0] == pytest.approx(-2.4, abs=0.01)
    assert x[-1] > 1.9
