import io
import json
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from rich.console import Console

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO

from bhd_lerobot.cli.train import main
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.envs.episodes import SteppedEpisodes
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from bhd_lerobot.training import checkpoint as checkpoints
from bhd_lerobot.training.rl import run as module
from bhd_lerobot.training.rl.config import RlConfig, parse_rl
from bhd_lerobot.training.rl.environment import RlVecEnv, in_units
from bhd_lerobot.training.rl.learner import ActionHead, ActorHead, make_learner
from bhd_lerobot.training.rl.parts import make_parts, single_action
from bhd_lerobot.training.rl.train import RlResult, train
from tests.forks import Fork
from tests.policies.learned.rig import save_policy
from tests.recording.support import command_line

# How much the network's rows may differ when they are computed beside others, in m/s and rad/s.
TOLERANCE = 2e-6

BASE = {
    "algorithm": "ppo",
    "robot.type": "turtlebot3",
    "robot.beams": 36,
    "task.type": "avoid",
    "task.duration_s": 1,
    "env.n_envs": 4,
    "env.threads": 1,
    "policy.n_obs_steps": 2,
    "policy.obs_stride": 2,
    "policy.hidden_dims": [16, 8],
    "policy.critic_dims": [8],
    "policy.scan.transform": "inverse",
    "ppo.n_steps": 8,
    "ppo.batch_size": 16,
    "ppo.n_epochs": 2,
    "validation.freq": 64,
    "validation.n_episodes": 2,
    "validation.n_envs": 2,
    "steps": 96,
    "threads": 1,
}


def options(root: Path | None = None, **overrides: object) -> list[str]:
    return command_line({**BASE, "output_dir": root}, overrides)


def run(root: Path, **overrides: object) -> RlResult:
    return train(parse_rl(options(root, **overrides)), Console(file=io.StringIO()))


def weights(folder: Path) -> bytes:
    return (folder / "pretrained_model" / "model.safetensors").read_bytes()


def rows(path: Path) -> list[dict]:
    timing = ("minutes", "frames_per_s", "gathering_s", "update_s")
    lines = (path / "metrics.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k not in timing} for line in lines]


def actions(folder: Path, states: np.ndarray, fps: int = 10) -> np.ndarray:
    """Return what the exported policy does, shape (frames, n, actions), given states of shape (frames, n, width)."""
    contract = PolicyContract.load(folder)
    brain = LearnedBrain(LearnedBrainConfig(path=str(folder)))
    names = contract.observation_names or ()
    brain.bind(RobotFeatures(names, contract.action_names or (), fps, ()))
    n = states.shape[1]
    brain.reset(np.arange(n), [0] * n, n)
    return np.stack([np.asarray(brain.act(Observation(names, state.astype(np.float64), {}))) for state in states])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RlResult:
    return run(tmp_path_factory.mktemp("rl") / "run", validation__rule="{type: gap_follower}")


@pytest.mark.figures
def test_a_run_leaves_checkpoints_metrics_a_curve_and_its_configuration(finished: RlResult) -> None:
    folder = finished.output_dir
    assert finished.step == 96
    names = {one.name for one in (folder / "checkpoints").iterdir()}
    assert {"000000000", "000000064", "000000096", "last", "best"} == names
    found = rows(folder)
    assert [row["step"] for row in found if "val_score" in row] == [0, 64, 96]
    assert all(np.isfinite(row["kl"]) for row in found if "kl" in row)
    assert any("return" in row for row in found)
    assert (folder / "learning_curve.png").stat().st_size > 10_000
    again = parse_rl([f"--config_path={folder}", "--resume=true"])
    assert again.ppo.n_steps == 8
    assert again.output_dir == str(folder)
    contract = PolicyContract.load(folder)
    assert (contract.robot_type, contract.fps) == ("turtlebot3", 10)
    assert contract.action_names == ("x.vel", "theta.vel")


def test_a_run_that_was_moved_is_resumed_where_it_lies_now(finished: RlResult, tmp_path: Path) -> None:
    moved = shutil.copytree(finished.output_dir, tmp_path / "moved", symlinks=True)
    for named in (moved, moved / "config.yaml"):
        assert parse_rl([f"--config_path={named}", "--resume=true"]).output_dir == str(moved)
    elsewhere = [f"--config_path={moved}", "--resume=true", "--output_dir=elsewhere"]
    assert parse_rl(elsewhere).output_dir == "elsewhere"


def test_a_run_is_resumed_whatever_became_of_what_it_started_from(finished: RlResult, tmp_path: Path) -> None:
    start = shutil.copytree(Path(finished.checkpoint) / "pretrained_model", tmp_path / "start")
    run(tmp_path / "run", start_from=start, steps=32)
    shutil.rmtree(start)
    copied = shutil.copytree(tmp_path / "run", tmp_path / "copied")  # which makes folders of links
    again = parse_rl([f"--config_path={copied}", "--resume=true", "--steps=64"])
    assert train(again, Console(file=io.StringIO())).step == 64
    assert (copied / "checkpoints" / "last").readlink().name == "000000064"


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(finished: RlResult, tmp_path: Path) -> None:
    same = run(tmp_path / "same", validation__rule="{type: gap_follower}")
    assert finished.checkpoint is not None
    assert same.checkpoint is not None
    assert weights(same.checkpoint) == weights(finished.checkpoint)
    assert rows(same.output_dir) == rows(finished.output_dir)
    other = run(tmp_path / "other", validation__rule="{type: gap_follower}", seed=1)
    assert other.checkpoint is not None
    assert weights(other.checkpoint) != weights(finished.checkpoint)


def test_what_cannot_be_resumed_is_refused_and_a_torn_checkpoint_is_never_loaded(tmp_path: Path) -> None:
    run(tmp_path / "run", steps=32)
    command = [f"--config_path={tmp_path / 'run'}", "--resume=true", "--steps=64"]
    with pytest.raises(ConfigError, match="has done 32 of 32"):
        train(parse_rl(command[:2]), Console(file=io.StringIO()))
    with pytest.raises(ConfigError, match="cannot be resumed"):
        train(parse_rl([*command, "--policy.critic_dims=[4]"]), Console(file=io.StringIO()))
    state = tmp_path / "run" / "checkpoints" / "last" / "training_state"
    whole = (state / "learner.zip").read_bytes()
    (state / "learner.zip").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match="cannot be resumed"):
        train(parse_rl(command), Console(file=io.StringIO()))


def dying(name: str, calls: int, arguments: list[str]) -> int:
    """Train, and die in a function of the run, or of its checkpoints, after some calls of it."""
    owner: Any = module.Run if hasattr(module.Run, name) else checkpoints
    left, function = iter(range(calls)), getattr(owner, name)

    def die(*values: Any) -> Any:
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*values)

    setattr(owner, name, die)
    return main(arguments)


def test_a_run_that_is_killed_while_it_saves_goes_on_from_the_last_complete_checkpoint(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    again = [f"--config_path={folder}", "--resume=true"]
    # The second checkpoint first before it is renamed, then before `last` leads to it.
    for name, calls, arguments in (("_flush", 1, options(folder)), ("point", 0, again)):
        killed = Fork(dying, name, calls, arguments, output=tmp_path / "log")
        assert killed.wait() == -signal.SIGKILL, (tmp_path / "log").read_text()
        assert (folder / "checkpoints" / "last").readlink().name == "000000000"
    # And where it has not been judged yet: it may be the best one.
    killed = Fork(dying, "_validate", 0, again, output=tmp_path / "log")
    assert killed.wait() == -signal.SIGKILL, (tmp_path / "log").read_text()
    assert (folder / "checkpoints" / "last").readlink().name == "000000064"
    assert main(again) == 0
    assert {one.name for one in (folder / "checkpoints").iterdir()} == {
        *("000000000", "000000064", "000000096"),
        *("last", "best"),
    }
    assert [row["step"] for row in rows(folder) if "val_score" in row] == [0, 64, 96]


@pytest.mark.parametrize(("channels", "privileged"), [([], False), ([4], True)])
def test_the_exported_policy_does_what_the_learners_actor_does(tmp_path, channels, privileged):
    config = parse_rl(options(**{"policy.scan.channels": channels, "policy__layer_norm": "true"}))
    env = BhdVectorEnv(4, config.environment, config.robot, config.task, autoreset_mode="Disabled", threads=1)
    parts = make_parts(config, env)
    adapter = RlVecEnv(env, parts, config.reward, 0.99, privileged=privileged)
    stack = adapter.stack
    hidden = np.zeros((4, adapter.observation_space.shape[0] - stack.size), np.float32)  # type: ignore[index]
    assert (hidden.size > 0) is privileged
    learner = make_learner(config, parts, adapter)
    learner.learn(64, log_interval=2**60)
    assert any(len(p) and p.grad is not None for p in parts.actor.net.parameters())
    module.export(tmp_path, parts, learner.policy.log_std)
    states = np.random.default_rng(0).uniform(0.1, 3.0, (7, 4, 38)).astype(np.float32)
    wanted = []
    for frame, one in enumerate(states):
        state = {"observation.state": one}
        if frame == 0:
            stack.restart(np.arange(4), state)
        else:
            stack.push(state)
        mean, _ = learner.predict(np.hstack([stack.features(), hidden]), deterministic=True)
        wanted.append(in_units(parts.after, mean))
    env.close()
    np.testing.assert_allclose(actions(tmp_path, states), wanted, rtol=0, atol=TOLERANCE)


def test_the_actor_is_frozen_while_the_critic_warms_up(finished: RlResult, tmp_path: Path) -> None:
    frozen = run(tmp_path / "frozen", start_from=finished.checkpoint, critic_warmup=96, policy__hidden_dims=[3])
    assert frozen.checkpoint is not None
    assert finished.checkpoint is not None
    assert weights(frozen.checkpoint) == weights(frozen.output_dir / "checkpoints" / "000000000")
    # So it does what the checkpoint does that it began with, whose architecture it has.
    states = np.random.default_rng(0).uniform(0.1, 3.0, (5, 4, 38)).astype(np.float32)
    np.testing.assert_array_equal(actions(frozen.checkpoint, states), actions(finished.checkpoint, states))


def test_the_learning_rate_follows_the_steps_and_never_the_time(tmp_path, monkeypatch):
    monkeypatch.setattr(module.Run, "_minutes", lambda _: 0.9)
    result = run(tmp_path / "run", max_minutes=1, steps=90)  # the last update is after 96
    found = {row["step"]: row["lr"] for row in rows(result.output_dir) if "lr" in row}
    assert found == {step: pytest.approx(3e-4 * max(0.0, 1 - step / 90)) for step in (32, 64, 96)}


def test_the_best_checkpoint_is_the_one_of_most_successes_and_the_start_is_among_the_candidates(tmp_path, monkeypatch):
    wanted = {"validation__freq": 32, "validation__select": "success"}
    for case, (levels, best) in enumerate(  # success and score, at the start and after each update
        [([(0.8, 0.2), (0.9, 0.3), (1.0, 0.1), (1.0, 0.3)], 96), ([(1.0, 0.3), (0.9, 0.9), (1.0, 0.1), (0.8, 1.0)], 0)]
    ):
        found = iter(levels)

        def level(episodes: Any, found: Iterator = found) -> dict[str, float]:
            success, score = next(found) if episodes else (None, None)
            return {"val_success": success, "val_score": score, "val_return": score} if episodes else {}

        monkeypatch.setattr(module, "level", level)
        result = run(tmp_path / str(case), **wanted)
        assert result.best == result.output_dir / "checkpoints" / f"{best:09d}"


def test_ctrl_c_saves_and_prints_the_resume_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    step = RlVecEnv.step_wait
    count = []

    def interrupted(self: RlVecEnv) -> tuple:
        count.append(1)
        if len(count) == 10:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    monkeypatch.setattr(RlVecEnv, "step_wait", interrupted)
    assert main(options(tmp_path / "run")) == 130
    assert len(count) == 10
    assert "--resume=true" in capsys.readouterr().err
    assert (tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors").is_file()
    monkeypatch.setattr(RlVecEnv, "step_wait", step)
    assert main([f"--config_path={tmp_path / 'run'}", "--resume=true"]) == 0


def test_without_stable_baselines3_the_message_says_how_to_install_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert main(options(tmp_path / "run")) == 2
    assert "pip install -e '.[rl]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


WRONG: list[tuple[dict[str, object], str]] = [
    ({"seed": 2**32}, "seed is 4294967296; it must be from 0 to 4294967295"),
    ({"reward__events": "{colision: -1}"}, "Did you mean 'collision'"),
    ({"reward__potential": "pose"}, "only a task with a target pose"),
    ({"algorithm": "sac"}, "Valid: ppo"),
    ({"validation__seed": 0}, "evaluated on its training episodes"),
    ({"critic_warmup": 10}, "needs --start_from"),
    (
        {"robot__type": "ur5", "robot__beams": None},
        "needs a drive; robot.type is 'ur5', which has none. Valid: turtlebot3",
    ),
    ({"ppo__learning_rate": 1.0}, "Unknown option 'ppo.learning_rate'"),
    ({"resume": "true"}, "resume needs --output_dir"),
    ({"reward.events": "{collision: .inf}"}, "reward.events.collision is inf"),
    ({"policy.activation": "gelul"}, "Did you mean 'gelu'"),
]


def test_nothing_is_rendered_while_nothing_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SteppedEpisodes, "_images", lambda *_: pytest.fail("an image was rendered"))
    assert run(tmp_path / "run", robot__camera="true", steps=32).step == 32


def test_a_robot_and_a_task_without_an_environment_are_refused_by_name() -> None:
    pair = {"robot__type": "ur5e", "robot__beams": None, "task__type": "reach", "policy__scan__transform": None}
    with pytest.raises(ConfigError, match=r"'ur5e' and task.type is 'reach', of which .* There is: .*ur5 with reach"):
        parse_rl(options(**pair))


def test_wrong_values_are_named() -> None:
    for overrides, message in WRONG:
        with pytest.raises(ConfigError, match=message):
            parse_rl(options(**overrides))


def test_a_checkpoint_of_another_robot_is_refused(finished: RlResult, tmp_path: Path) -> None:
    config = {"robot__type": "ur5", "robot__beams": None, "task__type": "reach", "policy__scan__transform": None}
    with pytest.raises(ConfigError, match="trained on the robot 'turtlebot3'"):
        run(tmp_path / "run", start_from=finished.checkpoint, **config)
    with pytest.raises(ConfigError, match="trained on other observation features"):
        run(tmp_path / "beams", start_from=finished.checkpoint, robot__beams=72)
    with pytest.raises(ConfigError, match="sees 2 observations already"):
        run(tmp_path / "history", start_from=finished.checkpoint, see_history=True)


def test_a_checkpoint_of_another_architecture_is_refused(finished: RlResult, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'act'; PPO starts from a 'bhd_mlp'"):
        run(tmp_path / "run", start_from=save_policy(tmp_path / "act", "act"), robot__beams=12)
    residual = {"residual": ["*"], "residual_columns": [-1, -1]}
    for name, changed, message in (
        ("residual", residual, r"policy.residual is \['\*'\]\); PPO learns the actions themselves"),
        ("dropout", {"dropout": 0.1}, "has dropout 0.1; PPO needs a policy without it"),
    ):
        folder = shutil.copytree(Path(finished.checkpoint) / "pretrained_model", tmp_path / name)
        MlpPolicy(replace(MlpPolicy.from_pretrained(folder).config, **changed)).save_pretrained(folder)
        with pytest.raises(ConfigError, match=message):
            run(tmp_path / "run", start_from=folder)


def test_a_folder_that_exists_is_not_overwritten_and_one_without_a_run_not_resumed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="exists"):
        run(tmp_path)
    with pytest.raises(ConfigError, match="no run to resume"):
        run(tmp_path, resume="true")
    with pytest.raises(ConfigError, match="no run to resume"):
        run(tmp_path / "missing", resume="true")


@pytest.mark.parametrize("name", ["ppo_turtlebot3", "ppo_turtlebot3_monitor", "ppo_ur5_reach"])
def test_the_shipped_configurations_are_valid(name: str) -> None:
    config: RlConfig = parse_rl([f"--config_path=configs/train/{name}.yaml", "--start_from=x"])
    assert config.max_minutes is not None
    assert config.max_minutes <= 20


@pytest.mark.parametrize("modes", [1, 3])
def test_the_first_action_of_the_checkpoints_chunk_becomes_the_actors(modes: int) -> None:
    torch.manual_seed(0)
    policy = MlpPolicy(mlp(chunk_size=4, modes=modes))
    actor = single_action(policy)
    batch = {"observation.state": torch.randn(32, 5)}
    chunk = policy.predict_action_chunk(batch)
    torch.testing.assert_close(actor.predict_action_chunk(batch)[:, 0], chunk[:, 0], rtol=0, atol=1e-6)
    assert actor.config.chunk_size == 1
    assert actor.log_std is not None
    # In PPO, too.
    features = actor.features(batch)
    learned = ActionHead(actor)(ActorHead(actor, features.shape[1])(features))
    torch.testing.assert_close(learned, chunk[:, 0], rtol=0, atol=1e-6)


def mlp(**values: object) -> MlpConfig:
    config = MlpConfig(hidden_dims=[8], device="cpu", push_to_hub=False, **values)  # type: ignore[arg-type]
    config.input_features = {"observation.state": PolicyFeature(FeatureType.STATE, (5,))}
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    return config


def test_a_run_that_fails_before_it_began_leaves_nothing(tmp_path: Path, capsys) -> None:
    assert main(options(tmp_path / "run", start_from=tmp_path / "none")) == 2
    assert "There is no policy at" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file" / "run", tmp_path / ("x" * 300)):
        with pytest.raises(ConfigError, match="--output_dir"):
            run(folder)


def test_weights_that_are_not_finite_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(learner: PPO, steps: int, **_: object) -> None:
        for one in learner.policy.parameters():
            one.data.fill_(float("nan"))
        raise ValueError("the distribution's mean is nan")

    monkeypatch.setattr(PPO, "learn", spoil)
    with pytest.raises(BhdError, match=r"weights are not finite .*000000000 is intact.*--ppo\.lr"):
        run(tmp_path / "run")


def test_a_full_disk_leaves_the_configuration_that_a_run_is_resumed_with(tmp_path, monkeypatch):
    run(tmp_path / "run", steps=32)
    before = (tmp_path / "run" / "config.yaml").read_bytes()

    def full(path: Path, *_: Any, **__: Any) -> None:
        path.write_bytes(b"")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    monkeypatch.setattr(Disk, "write", lambda _, path, content: full(path))
    with pytest.raises(BhdError, match="No space left on device"):
        train(parse_rl([f"--config_path={tmp_path / 'run'}", "--resume=true", "--steps=64"]))
    assert (tmp_path / "run" / "config.yaml").read_bytes() == before


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.MetricsFile, "append", full)
    with pytest.raises(BhdError, match=r"No space left on device.*intact.*--resume=true"):
        run(tmp_path / "run")
    assert (tmp_path / "run" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()
