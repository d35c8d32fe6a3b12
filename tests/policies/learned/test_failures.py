"""Checkpoints that cannot be used and robots that do not fit: refused, and the message says what to do."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ActionError, ConfigError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.learned.contract import CONTRACT_FILE, PolicyContract
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import action_names_of, brains_for, make_brain, robot_of_brain
from tests.cases import each_case
from tests.policies.learned import rig


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig.save_policy(tmp_path_factory.mktemp("policies") / "mlp")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "policy"))


def refused(path: Path, **options: Any) -> str:
    with pytest.raises(ConfigError) as error:
        rig.make_brain(path, **options)
    return str(error.value)


@pytest.mark.parametrize(
    "name",
    [
        "model.safetensors",
        "config.json",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
        "policy_preprocessor_step_3_normalizer_processor.safetensors",
    ],
)
def test_a_file_is_missing_or_half_written(folder: Path, name: str) -> None:
    file = folder / name
    data = file.read_bytes()
    for share in (0.0, 0.5):
        file.write_bytes(data[: int(share * len(data))])
        message = refused(folder)
        assert "opy" in message  # copy it again
        assert str(folder) in message
    file.unlink()
    if "step" not in name:
        assert name in refused(folder)


def test_weights_that_are_not_there_are_not_made_up(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    name = next(iter(weights))
    del weights[name]
    save_file(weights, folder / "model.safetensors")
    assert name in refused(folder)


def test_what_a_checkpoint_needs_and_this_machine_has_not(folder: Path) -> None:
    for device in ("cuda:7", "abacus"):
        message = refused(folder, device=device)
        assert device in message
        assert "--brain.device=cpu" in message
    config = json.loads((folder / "config.json").read_text())
    for changed, message in (
        ({"type": "telepathy"}, "'telepathy', which is not installed"),
        ({"use_peft": True}, "Merge it into its base model"),
    ):
        (folder / "config.json").write_text(json.dumps({**config, **changed}))
        assert message in refused(folder)


@each_case(
    ("options", "message"),
    [
        ({"n_action_steps": 7}, "brain.n_action_steps is 7; this 'bhd_mlp' predicts chunks of 6"),
        ({"sample": True}, "brain.sample is true, but this policy has no distribution"),
        ({"stream": True, "n_action_steps": 1}, "brain.stream is true"),
    ],
)
def test_options_that_cannot_be_honoured(folder: Path, options: dict[str, Any], message: str) -> None:
    assert message in refused(folder, **options)


def test_an_average_over_chunks_looks_at_every_frame(tmp_path: Path) -> None:
    folder = rig.save_policy(tmp_path / "act", "act_average")
    assert "temporal_ensemble_coeff" in refused(folder, n_action_steps=2)


def test_a_robot_or_a_task_that_does_not_fit(folder: Path) -> None:
    """What does not fit is the contract's affair (`test_contract.py`)."""
    brain = LearnedBrain(LearnedBrainConfig(str(folder)))
    for arguments, what in (
        ((rig.STATE[::-1], rig.ACTIONS, 10, rig.ENVIRONMENT), "other observation features"),
        ((rig.STATE, rig.ACTIONS[::-1], 10, rig.ENVIRONMENT), "other action features"),
        ((rig.STATE, rig.ACTIONS, 25, rig.ENVIRONMENT), "10 frames a second"),
        ((rig.STATE, rig.ACTIONS, 10, ()), "other environment features"),
    ):
        with pytest.raises(ConfigError, match=rf"{folder}.*{what}"):
            brain.bind(RobotFeatures(*arguments))


def test_without_a_contract_the_shapes_are_checked_and_it_says_so(folder, caplog):
    (folder / CONTRACT_FILE).unlink()
    with caplog.at_level(logging.WARNING):
        rig.make_brain(folder)
    assert "only the number of its inputs is checked" in caplog.text
    brain = LearnedBrain(LearnedBrainConfig(str(folder)))
    for arguments, what in (
        ((rig.STATE[1:], rig.ACTIONS, 10, rig.ENVIRONMENT), "14 numbers in 'observation.state'"),
        ((rig.STATE, ("a",), 10, rig.ENVIRONMENT), "2 numbers in 'action'"),
        ((rig.STATE, rig.ACTIONS, 10, ()), "2 numbers in 'observation.environment_state'"),
    ):
        with pytest.raises(ConfigError, match=what):
            brain.bind(RobotFeatures(*arguments))


@pytest.mark.parametrize("is_known", [True, False])
def test_a_camera_that_the_robot_does_not_have(is_known: bool, tmp_path: Path) -> None:
    """Also where only the policy itself tells which images it takes."""
    folder = rig.save_policy(tmp_path / "act", "act_image")
    if not is_known:
        (folder / CONTRACT_FILE).unlink()
    brain = rig.make_brain(folder)
    brain.reset(np.arange(1), [0], 1)
    seen = next(rig.observations(1, 1))
    small = {"front": seen.images["front"][:, ::2, ::2]}
    for images, message in (
        ({}, r"camera 'front'.*There is: none.*--robot.camera=true.*camera_width=48"),
        (small, r"48 x 32 px.*24 x 16 px"),
    ):
        with pytest.raises(ConfigError, match=message):
            brain.act(Observation(seen.names, seen.state, images, seen.environment_state))
        shapes = {name: several.shape[1:] for name, several in images.items()}
        with pytest.raises(ConfigError, match=message):
            brain.bind(RobotFeatures(rig.STATE, rig.ACTIONS, 10, rig.ENVIRONMENT, cameras=shapes))
    shapes = {name: several.shape[1:] for name, several in seen.images.items()}
    brain.bind(RobotFeatures(rig.STATE, rig.ACTIONS, 10, rig.ENVIRONMENT, cameras=shapes))


@pytest.mark.parametrize("blind", [False, True])
def test_an_action_that_is_not_finite_names_where_and_when(folder: Path, blind: bool) -> None:
    brain = rig.make_brain(folder)
    brain.reset(np.arange(2), [0, 1], 2)
    seen = list(rig.observations(2, 4))
    for one in seen[:3]:
        brain.act(one)
    if blind:
        seen[3].state[1, 4] = np.nan
    else:
        with torch.no_grad():
            brain.loaded.policy.net[-1].bias[3] = torch.inf  # the second action of the second frame
    with pytest.raises(ActionError) as error:
        brain.act(seen[3])
    parts = ["in frame 3 of the episode"]
    parts += ["simulation 1", "'observation.state' is not finite"] if blind else ["inf for 'theta.vel', 1 frames ahead"]
    assert [part for part in parts if part not in str(error.value)] == []


def options(root: Path, brain: str, robot: str = "turtlebot3", task: str = "avoid") -> list[str]:
    return [
        f"--robot.type={robot}",
        f"--task.type={task}",
        "--dataset.repo_id=a/b",
        f"--dataset.root={root / 'data'}",
        "--brain.type=learned",
        f"--brain.path={brain}",
    ]


def test_the_registry_asks_the_checkpoint_which_robot_it_drives(folder: Path, tmp_path: Path) -> None:
    config = LearnedBrainConfig(str(folder))
    assert robot_of_brain(config) == "turtlebot3"
    assert action_names_of(config) == ("x.vel", "theta.vel")
    assert isinstance(make_brain(config), LearnedBrain)
    assert "learned" in brains_for("turtlebot3")
    assert "learned" in brains_for("ur5")
    assert parse(RecordConfig, options(tmp_path, str(folder))).brain == config
    with pytest.raises(ConfigError, match=r"drives a turtlebot3; robot\.type is 'ur5'"):
        parse(RecordConfig, options(tmp_path, str(folder), "ur5", "reach"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="There is no policy in"):
        parse(RecordConfig, options(tmp_path, str(tmp_path / "empty")))
    replace(PolicyContract.load(folder), robot_type=None).save(folder)
    assert robot_of_brain(config) == ""
    assert action_names_of(config) == ()


def test_a_robot_of_another_type_with_the_same_joints_is_refused(folder: Path) -> None:
    """What is loaded from the Hub is not known when the configuration is read."""
    brain = LearnedBrain(LearnedBrainConfig(str(folder)))
    features = RobotFeatures(rig.STATE, rig.ACTIONS, rig.FPS, rig.ENVIRONMENT, body=turtlebot3_burger())
    brain.bind(replace(features, robot_type="turtlebot3"))
    with pytest.raises(ConfigError, match=r"trained on the robot 'turtlebot3' and would drive a 'ur5'"):
        brain.bind(replace(features, robot_type="ur5"))
    brain.bind(replace(features, robot_type="my_rover", body=None))


def test_a_configuration_is_read_before_its_policy_is_trained(tmp_path: Path) -> None:
    later = parse(RecordConfig, options(tmp_path, str(tmp_path / "later")))
    assert robot_of_brain(later.brain) == ""
    with pytest.raises(ConfigError, match="the folder does not exist"):
        make_brain(later.brain)
    with pytest.raises(ConfigError, match=r"brain\.path is empty"):
        LearnedBrainConfig("")


def rename_statistics(folder: Path, old: str, new: str, *files: str) -> None:
    for file in files or [path.name for path in folder.glob("*normalizer_processor.safetensors")]:
        state = load_file(folder / file)
        save_file({key.replace(old, new): value for key, value in state.items()}, folder / file)


@each_case(
    ("old", "new", "parts"),
    [
        ("action.", "so100.buffer.action.", ("'action' by", "so100.buffer.action")),
        ("observation.state.", "buffer_observation_state.", ("'observation.state' by", "buffer_observation_state")),
        ("observation.environment_state.mean", "other.mean", ("'observation.environment_state'", "no mean of it")),
        ("action.std", "action.deviation", ("'action' by", "no std of it")),
    ],
)
def test_what_is_normalised_without_statistics_of_its_name_is_refused(original, tmp_path, old, new, parts):
    folder = Path(shutil.copytree(original, tmp_path / "policy"))
    rename_statistics(folder, old, new)
    message = refused(folder)
    assert [part for part in parts if part not in message] == []


def test_what_is_not_normalised_needs_no_statistics(tmp_path: Path) -> None:
    identity = {"STATE": "IDENTITY", "ENV": "IDENTITY", "ACTION": "IDENTITY"}
    folder = rig.save_policy(tmp_path / "mlp", normalization_mapping=identity)
    for name in ("observation.state", "observation.environment_state", "action"):
        rename_statistics(folder, f"{name}.", f"buffer.{name}.")
    rig.make_brain(folder)
