"""Every configuration in `configs/train` for `bhd-train` is one, and its policy can be built for its robot's data."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from lerobot.policies.factory import make_policy

from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options import parse as configuration
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_robot
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.tasks.pick import ENVIRONMENT
from bhd_lerobot.training.arguments import parse_train
from bhd_lerobot.training.dagger.config import command, parse_aggregation, read_stages
from bhd_lerobot.training.rl.config import parse_rl

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "train"
KINDS = ("bc_", "act_", "cnn_", "diffusion_", "smolvla_")
CONFIGS = sorted(one for one in FOLDER.glob("*.yaml") if one.name.startswith(KINDS))


def described(name: str) -> dict[str, dict]:
    """Return the features of the robot's datasets."""
    config = TurtleBot3Config(beams=36, odometry="cnn" in name) if "turtlebot3" in name else UR5Config(tool_pose=True)
    environment = ["goal_x", "goal_y"]
    if "servo" in name:
        config, environment = UR5Config(tool_pose=True, action_space="tool"), list(ENVIRONMENT)
    robot = make_robot(config)
    state, action = list(robot.observation_names), list(robot.action_names)
    vectors = {"observation.state": state, "observation.environment_state": environment, "action": action}
    if "avoid" in name:
        del vectors["observation.environment_state"]
    features = {key: {"dtype": "float32", "shape": (len(one),), "names": one} for key, one in vectors.items()}
    if any(one in name for one in ("camera", "pixels", "smolvla", "cnn")):
        names, shape = ["height", "width", "channels"], (120, 160, 3) if "pixels" in name else (240, 320, 3)
        for camera in ("front",) if "turtlebot3" in name else ("scene", "wrist"):
            features[f"observation.images.{camera}"] = {"dtype": "video", "shape": shape, "names": names}
    return features


@pytest.mark.thorough(but=4)
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_configuration_is_valid_and_its_policy_can_be_built(path: Path, tmp_path: Path) -> None:
    overrides = [f"--output_dir={tmp_path / 'run'}", "--policy.device=cpu"]
    if path.stem.startswith(("act_", "diffusion_")):
        overrides.append("--policy.pretrained_backbone_weights=null")  # they would be downloaded
    config = parse_train([f"--config_path={path}", *overrides])
    config.validate()
    assert config.policy is not None
    assert config.env_eval_freq == 0
    assert not config.policy.push_to_hub
    if config.policy.type == "smolvla":
        return  # building it loads a model from the Hub
    meta = SimpleNamespace(features=described(path.stem), stats={}, fps=25)
    policy = make_policy(config.policy, ds_meta=meta)
    if "cameras" in path.stem or "pixels" in path.stem:
        assert "observation.environment_state" not in policy.config.input_features  # it would tell what is to be seen
    assert sum(one.numel() for one in policy.parameters()) > 1000


def test_ppo_has_the_robot_of_the_recordings_that_its_start_learned_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FOLDER.parents[1])
    recorded = ["--config_path=configs/record/ur5_reach.yaml", "--robot.action_space=tool", "--robot.tool_pose=true"]
    learning = ["--config_path=configs/train/ppo_ur5_reach.yaml", "--start_from=x", "--output_dir=x"]
    robots = [make_robot(one.robot) for one in (configuration.parse(RecordConfig, recorded), parse_rl(learning))]
    assert robots[0].action_names == robots[1].action_names
    assert robots[0].observation_names == robots[1].observation_names


@pytest.mark.parametrize("path", sorted(FOLDER.glob("dagger_*.yaml")), ids=lambda path: path.stem)
def test_the_stages_of_aggregation_fit_together(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FOLDER.parents[1])
    config = parse_aggregation([f"--config_path={path}"])
    stages = read_stages(config)
    assert stages.has_advice
    robots, tasks = set(), set()
    for stage, kind in ((config.expert, RecordConfig), (config.learner, RecordConfig), (config.evaluation, EvalConfig)):
        parsed = configuration.parse(kind, command(stage, {}))
        robots.add(str(parsed.robot))
        tasks.add(str(parsed.task))
    assert len(robots) == len(tasks) == 1


def test_no_configuration_for_a_cpu_counts_on_a_second_processor() -> None:
    for path in FOLDER.glob("*.yaml"):
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        if values.get("algorithm") == "dagger":
            continue  # it runs the configurations of other files
        if "gpu" not in path.stem and values.get("policy", {}).get("device", "cpu") == "cpu":
            assert values["threads"] == 1, path
