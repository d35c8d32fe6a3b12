"""Checkpoints do the same in bhd-eval, lerobot-eval and lerobot-rollout, and what a robot cannot give is named."""

import functools
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
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
from bhd_lerobot.robots.robot import connected_robots
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


_CAMERA = {"robot__camera": "true"}
_SMALL_ACT = {
    **{f"policy__{name}": 1 for name in ("n_encoder_layers", "n_vae_encoder_layers", "n_heads")},
    **{f"policy__{name}": 16 for name in ("dim_model", "dim_feedforward")},
    **{"policy__latent_dim": 4, "policy__chunk_size": 6, "policy__n_action_steps": 3},
    "policy__pretrained_backbone_weights": "null",
    "policy__input_features": "{observation.state: {type: STATE, shape: [14]}, "
    "observation.images.scene: {type: VISUAL, shape: [3, 32, 32]}}",
}
KINDS: dict[str, tuple[str, str, dict[str, Any], dict[str, Any]]] = {
    "bhd_mlp": (
        "turtlebot3",
        "avoid",
        {},
        {"policy__n_obs_steps": 2, "policy__chunk_size": 4, "policy__n_action_steps": 2, "policy__hidden_dims": "[16]"}
        | {"policy__scan__transform": "inverse"},
    ),
    "act": ("ur5", "reach", {**_CAMERA, "robot__camera_width": 32, "robot__camera_height": 32}, _SMALL_ACT),
    # It reads an instruction, and remembers its first image.
    "bhd_pixels": (
        "ur5",
        "pick",
        {**_CAMERA, "robot__camera_width": 96, "robot__camera_height": 72},
        {"policy__hidden_dims": "[16]", "policy__n_action_steps": 3},
    ),
    # It remembers images and odometry.
    "bhd_cnn": (
        "turtlebot3",
        "avoid",
        {"robot__odometry": "true", **_CAMERA, "robot__camera_width": 64, "robot__camera_height": 48},
        {"policy__hidden_dims": "[16]", "policy__n_obs_steps": 3, "policy__obs_stride": 2},
    ),
    "bhd_perception": ("ur5", "pick", {**_CAMERA, "robot__camera_width": 96, "robot__camera_height": 72}, {}),
}
"""By the type of policy: robot, task, options of the robot, and options of the policy."""
ENVIRONMENTS = {"avoid": "TurtleBot3Avoid-v0", "reach": "UR5Reach-v0", "pick": "UR5Pick-v0"}


def training(folder: Path, kind: str, run: str = "run", **overrides: Any) -> list[str]:
    """Record two short episodes, if there are none; return the options of a training of two steps."""
    robot, task, body, policy = KINDS[kind]
    if not (folder / "data").exists():
        of_ur5 = {"robot__type": "ur5", "robot__beams": None, "task__type": task, "brain__type": task}
        of_robot: dict[str, Any] = {"robot__beams": BEAMS} if robot == "turtlebot3" else {**of_ur5, "dataset__fps": 25}
        seconds = 1.0 if robot == "turtlebot3" else 0.4
        run_record(folder / "data", **of_robot, **body, dataset__episode_time_s=seconds, dataset__num_episodes=2)
    common = {"policy__device": "cpu", "policy__push_to_hub": "false", "batch_size": 4, "steps": 2, "save_freq": 2}
    data = {"dataset__repo_id": "test/avoid", "dataset__root": folder / "data", "dataset__use_imagenet_stats": "false"}
    return arguments(policy__type=kind, output_dir=folder / run, **(data | common | policy | overrides))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Trained]:
    """Return a function that trains a type of policy by one of the programs; each once."""

    @functools.cache
    def make(kind: str, program: str) -> Trained:
        folder = tmp_path_factory.mktemp(kind)
        robot, task, body, _ = KINDS[kind]
        seconds = 1.0 if robot == "turtlebot3" else 0.4
        own = {name.removeprefix("robot__"): value for name, value in body.items() if name != "robot__camera"}
        own |= {"beams": BEAMS} if robot == "turtlebot3" else {}
        env = arguments(
            env__type="bhd",
            env__task=ENVIRONMENTS[task],
            env__cameras="true" if body else "false",
            env__robot=f"{{{', '.join(f'{name}: {value}' for name, value in own.items())}}}",
            env__task_options=f"{{duration_s: {seconds}}}",
        )
        if program == "bhd-train":
            assert train.main([*training(folder, kind), "--threads=1"]) == 0
        elif kind == "bhd_mlp":  # evaluated in between
            evaluated = arguments(env_eval_freq=2, eval__n_episodes=1, eval__batch_size=1)
            run_stock("lerobot-train", [*training(folder, kind), "--num_workers=0", *env, *evaluated])
            assert list((folder / "run" / "eval").glob("videos_step_*/**/*.mp4"))
        else:
            run_stock("lerobot-train", [*training(folder, kind), "--num_workers=0", "--env_eval_freq=0"])
        options = arguments(robot__type=robot, **({"robot__beams": BEAMS} if robot == "turtlebot3" else {}), **body)
        scene = {"robot__arena": "random"} if robot == "turtlebot3" else {"robot__scene": task}
        if task == "pick":
            scene["task"] = PickTask(PickConfig(), 1, 25).sample(SEED).instruction
        return Trained(
            folder / "run" / "checkpoints" / "last" / "pretrained_model",
            [*options, *arguments(task__type=task, task__duration_s=seconds)],
            env,
            [*options, *arguments(**scene, robot__seed=SEED)],
        )

    return make


TRAININGS = (
    ("bhd_mlp", "lerobot-train"),
    ("act", "bhd-train"),
    ("bhd_pixels", "bhd-train"),
    ("bhd_cnn", "lerobot-train"),
)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(("kind", "program"), TRAININGS)
def test_a_checkpoint_does_the_same_in_all_three_programs(kind, program, trained, tmp_path):
    made = trained(kind, program)
    assert (made.checkpoint / CONTRACT_FILE).exists() == (program == "bhd-train")
    ours = trace_bhd_eval(tmp_path / "bhd", [*made.bhd_eval, f"--brain.path={made.checkpoint}"])
    path = f"--policy.path={made.checkpoint}"
    theirs = trace_lerobot_eval(tmp_path / "lerobot", [*made.lerobot_eval, path])
    frames = len(theirs.done)
    robots = trace_lerobot_rollout(frames, [*made.lerobot_rollout, path])
    assert len(ours.done) == len(robots.done) == frames >= 10
    # The three start alike, so equal actions are what keeps the observations equal to the end.
    assert np.array_equal(ours.seen, theirs.seen)
    assert np.array_equal(ours.done, theirs.done)
    assert np.array_equal(robots.seen, theirs.seen)
    assert np.array_equal(robots.done, theirs.done)
    # and there was something to compare
    assert len(np.unique(robots.seen, axis=0)) == len(np.unique(robots.done, axis=0)) == frames
    assert not connected_robots()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("kind", ["bhd_cnn", "bhd_pixels", "bhd_perception"])
def test_both_loaders_and_a_resumed_run_give_the_same_weights(kind: str, tmp_path: Path) -> None:
    """Of a policy that sees; `tests/training/test_train.py` has the others."""
    once = {"save_freq": 1, "threads": 1, "num_workers": 0}
    for run, budget in (("whole", 4.0), ("stock_loader", 1e-6)):
        assert train.main(training(tmp_path, kind, run, **once, budget_gib=budget)) == 0
    last = [tmp_path / run / "checkpoints" / "000002" / "pretrained_model" for run in ("whole", "stock_loader")]
    whole, by_stock = ((folder / "model.safetensors").read_bytes() for folder in last)
    assert by_stock == whole
    shutil.rmtree(last[0].parent)
    assert train.main(["--resume=true", f"--config_path={last[0].parents[1] / '000001' / 'pretrained_model'}"]) == 0
    assert (last[0] / "model.safetensors").read_bytes() == whole


@pytest.mark.thorough
def test_a_process_of_lerobots_loads_every_checkpoint_with_its_processors(trained):
    """It imports our package as a plug-in, and nothing else of it; here, other tests have imported everything."""
    paths = [str(trained(*one).checkpoint) for one in TRAININGS]
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
    trained: Callable[[str, str], Trained], tmp_path: Path
) -> None:
    made = trained("bhd_mlp", "lerobot-train")
    options = arguments(
        policy__path=made.checkpoint,
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
    run_stock("lerobot-rollout", [*made.lerobot_rollout, *options])
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
