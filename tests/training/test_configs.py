"""Every configuration in `configs/train` for `bhd-train` is one, and its policy can be built for its robot's data."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from lerobot.policies.factory import make_policy

from bhd_lerobot.registry import make_robot
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.training.arguments import parse_train
from tests.training.support import MLP, make_dataset, options, run_train

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "train"
CONFIGS = sorted(one for one in FOLDER.glob("*.yaml") if one.name.startswith(("bc_", "act_", "diffusion_", "smolvla_")))


def described(name: str) -> dict[str, dict]:
    """Return the features of the robot's datasets."""
    config = TurtleBot3Config(beams=36) if "turtlebot3" in name else UR5Config(tool_pose=True)
    robot = make_robot(config)
    state, action = list(robot.observation_names), list(robot.action_names)
    vectors = {"observation.state": state, "observation.environment_state": ["goal_x", "goal_y"], "action": action}
    if "avoid" in name:
        del vectors["observation.environment_state"]
    features = {key: {"dtype": "float32", "shape": (len(one),), "names": one} for key, one in vectors.items()}
    if any(one in name for one in ("camera", "pixels", "smolvla")):
        names, shape = ["height", "width", "channels"], (120, 160, 3) if "pixels" in name else (240, 320, 3)
        for camera in ("scene", "wrist"):
            features[f"observation.images.{camera}"] = {"dtype": "video", "shape": shape, "names": names}
    return features


def test_there_are_configurations() -> None:
    assert len(CONFIGS) == 11


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_configuration_is_valid_and_its_policy_can_be_built(path: Path, tmp_path: Path) -> None:
    overrides = [f"--output_dir={tmp_path / 'run'}", "--policy.device=cpu"]
    if path.stem.startswith(("act_", "diffusion_")):
        overrides.append("--policy.pretrained_backbone_weights=null")  # they would be downloaded
    config = parse_train([f"--config_path={path}", *overrides]).config
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


def test_no_configuration_for_a_cpu_counts_on_a_second_processor() -> None:
    for path in FOLDER.glob("*.yaml"):
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        if "gpu" not in path.stem and values.get("policy", {}).get("device", "cpu") == "cpu":
            assert values["threads"] == 1, path


def test_the_configuration_for_fine_tuning_takes_its_policy_from_the_checkpoint(tmp_path: Path) -> None:
    data = make_dataset(tmp_path / "set", episodes=2)
    run_train(options(data, tmp_path / "before", MLP, steps=2))
    path = FOLDER / "fine_tune_ur5_pick.yaml"
    request = parse_train([f"--config_path={path}", f"--fine_tune={tmp_path / 'before'}"])
    request.config.validate()
    assert request.config.policy.type == "bhd_mlp"
    assert request.config.policy.optimizer_lr == 1e-4
    assert request.config.optimizer.lr == 1e-4
    assert request.contract == str((tmp_path / "before/checkpoints/last/pretrained_model").resolve())
