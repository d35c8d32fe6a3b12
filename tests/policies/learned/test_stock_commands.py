"""Checkpoints do the same in bhd-eval, lerobot-eval and lerobot-rollout, and what a robot cannot give is named."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset

import bhd_lerobot
from bhd_lerobot.cli import train
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.contract import CONTRACT_FILE
from bhd_lerobot.robots.simulated_robot import connected_robots
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.task import episode_seed
from tests.policies.learned.rig import save_policy
from tests.policies.learned.stock_rig import (
    arguments,
    run_stock,
    trace_bhd_eval,
    trace_lerobot_eval,
    trace_lerobot_rollout,
)
from tests.recording.support import run_record

SEED = episode_seed(0, 0, "held_out")  # of the first episode of bhd-eval and of lerobot-eval
BEAMS = 12


class Trained(NamedTuple):
    """A checkpoint and where it is tried: the options of the three programs."""

    checkpoint: Path
    bhd_eval: list[str]
    lerobot_eval: list[str]
    lerobot_rollout: list[str]


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Let all programs infer with one thread: the last bits of an action depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def by_lerobot_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Return a TurtleBot3's `bhd_mlp`, trained by lerobot-train, which evaluates it in between."""
    folder = tmp_path_factory.mktemp("turtlebot3")
    run_record(folder / "data", robot__beams=BEAMS, dataset__num_episodes=2)
    env = arguments(
        env__type="bhd",
        env__task="TurtleBot3Avoid-v0",
        env__robot=f"{{beams: {BEAMS}}}",
        env__task_options="{duration_s: 1.0}",
    )
    options = arguments(
        dataset__repo_id="test/avoid",
        dataset__root=folder / "data",
        policy__type="bhd_mlp",
        policy__device="cpu",
        policy__push_to_hub="false",
        policy__n_obs_steps=2,
        policy__chunk_size=4,
        policy__n_action_steps=2,
        policy__hidden_dims="[16]",
        policy__scan__transform="inverse",
        batch_size=16,
        steps=4,
        save_freq=4,
        num_workers=0,
        env_eval_freq=4,
        eval__n_episodes=1,
        eval__batch_size=1,
        output_dir=folder / "run",
    )
    run_stock("lerobot-train", [*options, *env])
    assert list((folder / "run" / "eval").glob("videos_step_*/**/*.mp4"))
    robot = arguments(robot__type="turtlebot3", robot__beams=BEAMS)
    return Trained(
        folder / "run" / "checkpoints" / "last" / "pretrained_model",
        [*robot, *arguments(task__type="avoid", task__duration_s=1.0)],
        env,
        [*robot, *arguments(robot__arena="random", robot__seed=SEED)],
    )


@pytest.fixture(scope="module")
def by_bhd_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Return a UR5's ACT on its joints and one of its cameras, trained by bhd-train."""
    folder = tmp_path_factory.mktemp("ur5")
    robot = arguments(robot__type="ur5", robot__camera="true", robot__camera_width=32, robot__camera_height=32)
    of_ur5: dict[str, Any] = {"robot__type": "ur5", "robot__beams": None, "task__type": "reach", "brain__type": "reach"}
    camera = {"robot__camera": "true", "robot__camera_width": 32, "robot__camera_height": 32}
    run_record(
        folder / "data", **of_ur5, **camera, dataset__episode_time_s=0.4, dataset__fps=25, dataset__num_episodes=2
    )
    small = {f"policy__{name}": 1 for name in ("n_encoder_layers", "n_vae_encoder_layers", "n_heads")}
    options = arguments(
        dataset__repo_id="test/avoid",
        dataset__root=folder / "data",
        policy__type="act",
        policy__device="cpu",
        policy__input_features="{observation.state: {type: STATE, shape: [14]}, "
        "observation.images.scene: {type: VISUAL, shape: [3, 32, 32]}}",
        policy__pretrained_backbone_weights="null",
        policy__chunk_size=6,
        policy__n_action_steps=3,
        policy__dim_model=16,
        policy__dim_feedforward=16,
        policy__latent_dim=4,
        **small,
        batch_size=4,
        steps=1,
        save_freq=1,
        threads=1,
        output_dir=folder / "run",
    )
    assert train.main(options) == 0
    return Trained(
        folder / "run" / "checkpoints" / "last" / "pretrained_model",
        [*robot, *arguments(task__type="reach", task__duration_s=0.4)],
        arguments(
            env__type="bhd",
            env__task="UR5Reach-v0",
            env__cameras="true",
            env__robot="{camera_width: 32, camera_height: 32}",
            env__task_options="{duration_s: 0.4}",
        ),
        [*robot, *arguments(robot__scene="reach", robot__seed=SEED)],
    )


@pytest.fixture(scope="module")
def pixels_by_lerobot_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return from_pixels(tmp_path_factory.mktemp("pixels"), "lerobot-train")


@pytest.fixture(scope="module")
def pixels_by_bhd_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return from_pixels(tmp_path_factory.mktemp("pixels"), "bhd-train")


def from_pixels(folder: Path, program: str) -> Trained:
    """Return a UR5's `bhd_pixels`, which reads an instruction and remembers its first image."""
    robot = arguments(robot__type="ur5", robot__camera="true", robot__camera_width=96, robot__camera_height=72)
    of_ur5: dict[str, Any] = {"robot__type": "ur5", "robot__beams": None, "task__type": "pick", "brain__type": "pick"}
    camera = {"robot__camera": "true", "robot__camera_width": 96, "robot__camera_height": 72}
    run_record(
        folder / "data", **of_ur5, **camera, dataset__episode_time_s=0.4, dataset__fps=25, dataset__num_episodes=2
    )
    options = arguments(
        dataset__repo_id="test/avoid",
        dataset__root=folder / "data",
        dataset__use_imagenet_stats="false",
        policy__type="bhd_pixels",
        policy__device="cpu",
        policy__push_to_hub="false",
        policy__hidden_dims="[16]",
        policy__n_action_steps=3,
        batch_size=4,
        steps=2,
        save_freq=2,
        output_dir=folder / "run",
    )
    if program == "bhd-train":
        assert train.main([*options, "--threads=1"]) == 0
    else:
        run_stock("lerobot-train", [*options, *arguments(num_workers=0, env_eval_freq=0)])
    instruction = PickTask(PickConfig(), 1, 25).sample(SEED).instruction
    return Trained(
        folder / "run" / "checkpoints" / "last" / "pretrained_model",
        [*robot, *arguments(task__type="pick", task__duration_s=0.4)],
        arguments(
            env__type="bhd",
            env__task="UR5Pick-v0",
            env__cameras="true",
            env__robot="{camera_width: 96, camera_height: 72}",
            env__task_options="{duration_s: 0.4}",
        ),
        [*robot, *arguments(robot__scene="pick", robot__seed=SEED, task=instruction)],
    )


@pytest.fixture(scope="module")
def cnn_by_lerobot_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return from_front_camera(tmp_path_factory.mktemp("cnn"), "lerobot-train")


@pytest.fixture(scope="module")
def cnn_by_bhd_train(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return from_front_camera(tmp_path_factory.mktemp("cnn"), "bhd-train")


def from_front_camera(folder: Path, program: str) -> Trained:
    """Return a TurtleBot3's `bhd_cnn`, which remembers images and odometry."""
    body = {"robot__odometry": "true", "robot__camera": "true", "robot__camera_width": 64, "robot__camera_height": 48}
    robot = arguments(robot__type="turtlebot3", robot__beams=BEAMS, **body)
    run_record(folder / "data", robot__beams=BEAMS, **body, dataset__episode_time_s=1.0, dataset__num_episodes=2)
    options = arguments(
        dataset__repo_id="test/avoid",
        dataset__root=folder / "data",
        dataset__use_imagenet_stats="false",
        policy__type="bhd_cnn",
        policy__device="cpu",
        policy__push_to_hub="false",
        policy__hidden_dims="[16]",
        policy__n_obs_steps=3,
        policy__obs_stride=2,
        batch_size=4,
        steps=2,
        save_freq=2,
        output_dir=folder / "run",
    )
    if program == "bhd-train":
        assert train.main([*options, "--threads=1"]) == 0
    else:
        run_stock("lerobot-train", [*options, *arguments(num_workers=0, env_eval_freq=0)])
    return Trained(
        folder / "run" / "checkpoints" / "last" / "pretrained_model",
        [*robot, *arguments(task__type="avoid", task__duration_s=1.0)],
        arguments(
            env__type="bhd",
            env__task="TurtleBot3Avoid-v0",
            env__cameras="true",
            env__robot=f"{{beams: {BEAMS}, odometry: true, camera_width: 64, camera_height: 48}}",
            env__task_options="{duration_s: 1.0}",
        ),
        [*robot, *arguments(robot__arena="random", robot__seed=SEED)],
    )


@pytest.mark.parametrize(
    "which",
    [
        *("by_lerobot_train", "by_bhd_train", "pixels_by_lerobot_train", "pixels_by_bhd_train"),
        *("cnn_by_lerobot_train", "cnn_by_bhd_train"),
    ],
)
def test_a_checkpoint_does_the_same_in_all_three_programs(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    trained: Trained = request.getfixturevalue(which)
    assert (trained.checkpoint / CONTRACT_FILE).exists() == which.endswith("by_bhd_train")
    ours = trace_bhd_eval(tmp_path / "bhd", [*trained.bhd_eval, f"--brain.path={trained.checkpoint}"])
    path = f"--policy.path={trained.checkpoint}"
    theirs = trace_lerobot_eval(tmp_path / "lerobot", [*trained.lerobot_eval, path])
    frames = len(theirs.done)
    robots = trace_lerobot_rollout(frames, [*trained.lerobot_rollout, path])
    assert len(ours.done) == len(robots.done) == frames >= 10
    # The three start alike, so equal actions are what keeps the observations equal to the end.
    assert np.array_equal(ours.seen, theirs.seen)
    assert np.array_equal(ours.done, theirs.done)
    assert np.array_equal(robots.seen, theirs.seen)
    assert np.array_equal(robots.done, theirs.done)
    # and there was something to compare
    assert len(np.unique(robots.seen, axis=0)) == len(np.unique(robots.done, axis=0)) == frames
    assert not connected_robots()


def test_a_process_of_lerobots_loads_every_checkpoint_with_its_processors(request: pytest.FixtureRequest) -> None:
    """It imports our package as a plug-in, and nothing else of it; here, other tests have imported everything."""
    made = ("by_lerobot_train", "by_bhd_train", "pixels_by_bhd_train", "cnn_by_bhd_train")
    paths = [str(request.getfixturevalue(one).checkpoint) for one in made]
    program = f"""
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
for path in {paths!r}:
    make_pre_post_processors(PreTrainedConfig.from_pretrained(path), pretrained_path=path)
print(*ProcessorStepRegistry.list())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    source = "".join(path.read_text(encoding="utf-8") for path in Path(bhd_lerobot.__file__).parent.rglob("*.py"))
    ours = re.findall(r'^@ProcessorStepRegistry\.register\(name="(\w+)"\)', source, re.MULTILINE)
    assert len(ours) >= 5
    assert {*ours} <= {*done.stdout.split()}


def test_lerobot_rollout_ends_after_its_duration_and_what_it_records_is_a_dataset(
    by_lerobot_train: Trained, tmp_path: Path
) -> None:
    options = arguments(
        policy__path=by_lerobot_train.checkpoint,
        strategy__type="sentry",
        fps=10,
        duration=0.5,
        return_to_initial_position="false",
        play_sounds="false",
        dataset__repo_id="test/rollout_avoid",
        dataset__root=tmp_path / "rollout",
        dataset__fps=10,
        dataset__single_task="Roam.",
        dataset__push_to_hub="false",
    )
    run_stock("lerobot-rollout", [*by_lerobot_train.lerobot_rollout, *options])
    dataset = LeRobotDataset("test/rollout_avoid", root=tmp_path / "rollout")
    names = [f"scan_{beam:03}.pos" for beam in range(BEAMS)]
    assert dataset.meta.features["observation.state"]["names"] == ["x.vel", "theta.vel", *names]
    assert dataset.meta.robot_type == "turtlebot3"
    assert 0 < dataset.num_frames <= 6
    assert dataset[0]["action"].abs().max() > 0


def test_what_a_robots_sensors_do_not_tell_is_named(tmp_path: Path) -> None:
    checkpoint = save_policy(tmp_path / "policy")
    options = arguments(robot__type="turtlebot3", robot__beams=BEAMS, policy__path=checkpoint, duration=5)
    with pytest.raises(ConfigError, match=r"observation.environment_state.*lerobot-rollout.*bhd-eval"):
        run_stock("lerobot-rollout", [*options, "--return_to_initial_position=false"])
    assert not connected_robots()
