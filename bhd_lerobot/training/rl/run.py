"""A run of PPO, which one callback of stable-baselines3 logs, validates, saves and ends.

Import this only where stable-baselines3 is known to be there.
"""

import json
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR
from rich.console import Console
from rich.markup import escape
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import save_to_zip_file

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import BhdError, ConfigError, quoted
from bhd_lerobot.options import parse as configuration
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.signals import StopRequest
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.stock import load_rng_state, save_rng_state
from bhd_lerobot.tasks.task import Event, episode_seed
from bhd_lerobot.training.checkpoint import clean, last_checkpoint, point, writing
from bhd_lerobot.training.log import (
    METRICS_NAME,
    MetricsFile,
    Row,
    RunProgress,
    format_numbers,
    read_metrics,
    write_config,
)
from bhd_lerobot.training.plots import draw_learning
from bhd_lerobot.training.rl.config import RlConfig
from bhd_lerobot.training.rl.environment import RlVecEnv
from bhd_lerobot.training.rl.learner import make_learner
from bhd_lerobot.training.rl.parts import RlParts, make_parts
from bhd_lerobot.training.rl.train import PLOT_NAME, RlResult

BEST = "best"
LEARNER, RUN = "learner.zip", "run.json"
"""In `training_state`: parameters of actor, critic and optimizer, in stable-baselines3's format; where the run was."""

_LOGGED = {
    "train/approx_kl": "kl",
    "train/clip_fraction": "clip_fraction",
    "train/explained_variance": "explained_variance",
    "train/value_loss": "value_loss",
    "train/policy_gradient_loss": "policy_loss",
    "train/std": "std",
    "train/learning_rate": "lr",
}
_SHOWN = (
    ("return", "return"),
    ("success", "success"),
    ("score", "score"),
    ("val_success", "validation success"),
    ("val_score", "validation score"),
    ("kl", "kl"),
    ("std", "std"),
    ("frames_per_s", "frames/s"),
)
_NEVER = 2**62  # updates between two outputs of stable-baselines3's own log


class Run(BaseCallback):
    """One run; an update is reported before the next samples are gathered."""

    def __init__(self, config: RlConfig, folder: Path, console: Console, stop: StopRequest) -> None:
        super().__init__()
        self._config, self._console, self._stop = config, console, stop
        self._result = RlResult(folder, stopped_by=stop)
        self._started = time.perf_counter()
        self._saved = -1
        self._simulations = min(config.validation.n_envs, config.validation.n_episodes)
        self._simulation = make_simulation(config.robot, self._simulations, config.env.threads)

    def go(self) -> RlResult:
        """Learn, and return the result."""
        config, result = self._config, self._result
        with closing(self._simulation):
            first_episode = read_next_episode(result.output_dir) if config.resume else 0
            episodes = [] if config.validation.rule is None else self._validate(config.validation.rule)
            result.rule = level(episodes)
            if self._stop:
                return result
            self._env = BhdVectorEnv(
                config.env.n_envs,
                config.environment,
                config.robot,
                config.task,
                seed=config.seed,
                cameras=False,  # nothing looks through them
                autoreset_mode="Disabled",
                threads=config.env.threads,
                first_episode=first_episode,
                episode_stride=config.env.n_envs,
            )
            with closing(self._env):
                self._parts = make_parts(config, self._env, episodes)
                privileged = config.policy.privileged_critic
                adapter = RlVecEnv(self._env, self._parts, config.reward, config.ppo.gamma, privileged=privileged)
                self._learn(make_learner(config, self._parts, adapter))
        return result

    def _learn(self, learner: Any) -> None:
        config, result = self._config, self._result
        self.model = learner
        rows: list[Row] = []
        if config.resume:
            load(result.output_dir, learner)
            result.step = self._saved = int(learner.num_timesteps)
            result.checkpoint = _folder_of(result.output_dir, result.step)
            rows = read_metrics(result.output_dir / METRICS_NAME, result.step)
            clean(result.output_dir)
        if result.step >= config.steps:
            raise ConfigError(
                f"The run has done {result.step} of {config.steps} steps. To continue, set more with --steps."
            )
        write_config(result.output_dir, {**configuration.encode(config), "resume": False})
        self._metrics = MetricsFile(result.output_dir / METRICS_NAME, rows)
        self._minutes_before = rows[-1]["minutes"] if rows else 0.0
        result.rows = self._metrics.rows
        self._point_to_best()
        left = max(0, config.steps - learner.num_timesteps)
        with RunProgress(self._console, "learning", config.steps, result.step) as self._progress:
            if not any(row["step"] == result.step and "val_score" in row for row in rows):
                self._judge({})  # also what a kill, or a stop, kept from being judged
            try:
                learner.learn(left, callback=self, log_interval=_NEVER, reset_num_timesteps=False)
            except ValueError as error:
                raise self._diverged() or error from None
            result.step = int(learner.num_timesteps)
            if self._saved != result.step:
                self._judge({})
            self._draw()
        self._print_summary()

    # --- stable-baselines3's callback --------------------------------------------------------------------------------

    def _on_training_start(self) -> None:
        self._gathered, self._since, self._gathering_s = self.model.num_timesteps, time.perf_counter(), 0.0
        self._episodes: list[dict[str, Any]] = []

    def _on_rollout_start(self) -> None:
        self._report()
        self._rollout_started = time.perf_counter()

    def _on_step(self) -> bool:
        self._episodes += [info for info in self.locals["infos"] if "episode" in info]
        minutes = self._config.max_minutes
        return not self._stop and (minutes is None or self._minutes() < minutes)

    def _on_rollout_end(self) -> None:
        self._gathering_s = time.perf_counter() - self._rollout_started
        learns: Any = self.model.policy
        for parameter in learns.actor_parameters():  # frozen while the critic warms up
            parameter.requires_grad_(self.model.num_timesteps > self._config.critic_warmup)

    def _on_training_end(self) -> None:
        self._report()

    def _report(self) -> None:
        """Log the last update, if there was one since the last report; validate when it is time to."""
        frames, values = self.model.num_timesteps - self._gathered, self.model.logger.name_to_value
        if frames and self._gathering_s:
            took = time.perf_counter() - self._since
            row = _means(self._episodes) | {name: float(values[key]) for key, name in _LOGGED.items() if key in values}
            row |= {"frames_per_s": frames / took}
            row |= {"gathering_s": self._gathering_s, "update_s": took - self._gathering_s}
            self._result.step = int(self.model.num_timesteps)
            if self._result.step - self._saved >= self._config.validation.freq and not self._stop:
                self._judge(row)
                self._draw()
            else:
                self._log(row)
        self._on_training_start()

    # --- validation, checkpoints, reports ----------------------------------------------------------------------------

    def _validate(self, brain: BrainConfig) -> list[Episode]:
        """Return a brain's episodes of the validation; those that a stop cut short are left out."""
        own, simulation = self._config.validation, self._simulation
        specs = [EpisodeSpec(i, episode_seed(own.seed, i, "train")) for i in range(own.n_episodes)]
        task = make_task(self._config.task, self._simulations, simulation.rates.fps, simulation.body)
        return list(EpisodeLoop(simulation, task, make_brain(brain)).run(specs, self._stop.__bool__))

    def _judge(self, row: Row) -> None:
        """Save what is not saved yet, and, unless the run is to stop, find out how good the policy is."""
        result = self._result
        if self._saved != result.step:
            following = max(member.sequence.following for member in self._env.members)
            result.checkpoint = save(result.output_dir, self._parts, self.model, following)
            self._saved = result.step
        policy = LearnedBrainConfig(path=str(_folder_of(result.output_dir, result.step) / PRETRAINED_MODEL_DIR))
        found = {} if self._stop else level(self._validate(policy))
        if row := {**row, **({} if self._stop else found)}:
            self._log(row)
        self._point_to_best()

    def _best(self) -> Row | None:
        """Return the row that judges the best checkpoint, the latest of equals."""
        names = (f"val_{self._config.validation.select}", "val_score", "step")
        judged = [row for row in self._result.rows if row.get(names[0]) is not None]
        return max(judged, key=lambda row: [row[name] for name in names], default=None)

    def _point_to_best(self) -> None:
        best = self._best()
        folder = None if best is None else _folder_of(self._result.output_dir, best["step"])
        if folder is not None and folder.is_dir():
            self._result.best = folder
            point(folder, BEST)

    def _diverged(self) -> BhdError | None:
        """Return the error if the weights are no numbers any more; the learner's own is about their product only."""
        if all(bool(torch.isfinite(parameter).all()) for parameter in self.model.policy.parameters()):
            return None
        kept = "there is none yet" if self._result.checkpoint is None else f"{self._result.checkpoint} is intact"
        return BhdError(
            f"The policy's weights are not finite any more after {self._result.step} steps. Training stops; of the "
            f"checkpoints, {kept}. Lower the learning rate (--ppo.lr) or the rewards (--reward.…)."
        )

    def _minutes(self) -> float:
        return (time.perf_counter() - self._started) / 60

    def _log(self, row: Row) -> None:
        row = {"step": self._result.step, "minutes": self._minutes_before + self._minutes(), **row}
        self._metrics.append(row)
        self._progress.advance(row["step"])
        prefix = f"step {row['step']:,}  {row['minutes']:.1f} min" if "val_score" in row else ""
        self._progress.log(prefix, format_numbers(row, _SHOWN))

    def _draw(self) -> None:
        result, rule = self._result, self._config.validation.rule
        shown = (str(rule.get_choice_name(type(rule))), result.rule) if rule is not None and result.rule else None
        heading = f"PPO, {self._config.environment}, {result.step:,} environment steps"
        draw_learning(result.rows, result.output_dir / PLOT_NAME, heading, shown)

    def _print_summary(self) -> None:
        result, text = self._result, "score {val_score:.4f}, success {val_success:.3f}, return {val_return:.4f}"
        lines = [f"{result.step:,} environment steps in {self._minutes():.1f} min"]
        if result.rule:
            lines.append(f"rule on the validation episodes: {text.format_map(result.rule)}")
        best = self._best()
        if best is not None and result.best is not None:
            lines.append(f"best, after {best['step']:,} steps: {text.format_map(best)}")
            lines.append(f"best checkpoint: {result.best / PRETRAINED_MODEL_DIR}")
        lines.append(f"curve: {result.output_dir / PLOT_NAME}")
        if self._stop and result.step < self._config.steps:
            lines.append(
                f"Stopped by {self._stop.name}. Continue with: bhd-train --resume=true "
                f"--config_path={quoted(result.output_dir)}"
            )
        self._console.print(escape("\n".join(lines)), soft_wrap=True, highlight=False)


def _means(episodes: list[dict[str, Any]]) -> Row:
    """Return the means of episodes that ended, and the share of each failure; nothing if none did."""
    if not episodes:
        return {}
    values = {
        "return": [episode["episode"]["r"] for episode in episodes],
        "success": [episode["is_success"] for episode in episodes],
        "score": [episode["score"] for episode in episodes],
        "length": [episode["episode"]["l"] for episode in episodes],
    }
    row: Row = {"episodes": len(episodes)} | {key: float(np.mean(each)) for key, each in values.items()}
    failures = [episode["event"] for episode in episodes if not episode["is_success"]]
    return row | {cause: failures.count(cause) / len(episodes) for cause in sorted(set(failures))}


def level(episodes: Sequence[Episode]) -> Row:
    """Return how good a brain was: mean score, share of successes, mean return, share of each cause of failure."""
    if not episodes:
        return {}
    n = len(episodes)
    causes = Counter(episode.outcome.event.cause for episode in episodes if episode.outcome.event != Event.SUCCESS)
    return {
        "val_score": float(np.mean([episode.outcome.score for episode in episodes])),
        "val_success": float(np.mean([episode.outcome.success for episode in episodes])),
        "val_return": float(np.mean([np.sum(episode.columns[keys.REWARD]) for episode in episodes])),
        **{f"val_{cause}": count / n for cause, count in sorted(causes.items())},
    }


def _folder_of(output_dir: Path, step: int) -> Path:
    return output_dir / CHECKPOINTS_DIR / f"{step:09d}"


def save(output_dir: Path, parts: RlParts, learner: Any, next_episode: int) -> Path:
    """Write a checkpoint, a policy and the learner's state beside it; point `last` at it, and return its folder."""
    final = _folder_of(output_dir, learner.num_timesteps)
    with writing(final) as part:
        export(part / PRETRAINED_MODEL_DIR, parts, learner.policy.log_std)
        state = part / TRAINING_STATE_DIR
        state.mkdir()
        save_to_zip_file(state / LEARNER, params=learner.get_parameters())
        save_rng_state(state)
        (state / RUN).write_text(json.dumps({"next_episode": next_episode}), encoding="utf-8")
    return final


def export(folder: Path, parts: RlParts, log_std: torch.Tensor) -> None:
    """Write the policy in LeRobot's form: configuration, weights, processors, and the contract."""
    folder.mkdir(parents=True, exist_ok=True)
    if parts.actor.log_std is not None:
        with torch.no_grad():
            parts.actor.log_std.copy_(log_std.expand_as(parts.actor.log_std))
    for one in (parts.actor, parts.before, parts.after):
        one.save_pretrained(folder)
    parts.contract.save(folder)


def read_next_episode(output_dir: Path) -> int:
    """Return the number of the episode that a resumed run begins with."""
    try:
        run = json.loads((_last(output_dir) / TRAINING_STATE_DIR / RUN).read_text(encoding="utf-8"))
        return int(run["next_episode"])
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"There is no run to resume in {output_dir}: {error}") from error


def load(output_dir: Path, learner: Any) -> None:
    """Load the last checkpoint of a run into a learner."""
    folder = _last(output_dir)
    try:
        learner.set_parameters(str(folder / TRAINING_STATE_DIR / LEARNER), device="cpu")  # tensors only, no pickle
        learner.num_timesteps = int(folder.name)
        load_rng_state(folder / TRAINING_STATE_DIR)
    except Exception as error:  # zip, PyTorch, safetensors: each has its own
        raise ConfigError(
            f"The run in {output_dir} cannot be resumed: {' '.join(str(error).split())[:300]}. Resume with the "
            "configuration that it was started with, or start a new one in another --output_dir."
        ) from error


def _last(output_dir: Path) -> Path:
    if (last := last_checkpoint(output_dir)) is None:
        raise ConfigError(f"There is no run to resume in {output_dir}: it has no checkpoint.")
    return last
