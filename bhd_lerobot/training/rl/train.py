"""`bhd-train` with `algorithm: ppo`: a policy learns by trial and error."""

import json
import tempfile
import time
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from rich.console import Console
from rich.markup import escape

import bhd_lerobot.plugin  # noqa: F401  registers our policies and environments
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import BhdError, ConfigError, install_extra, quoted
from bhd_lerobot.options import parse as configuration
from bhd_lerobot.options.command import Program
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.policies.learned.inference import use_threads
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals
from bhd_lerobot.training.checkpoint import clean, point
from bhd_lerobot.training.log import METRICS_NAME, MetricsFile, RunProgress, format_numbers, read_metrics
from bhd_lerobot.training.rl import checkpoint as checkpoints
from bhd_lerobot.training.rl.config import RlConfig, parse_rl
from bhd_lerobot.training.rl.log import PLOT_NAME, SHOWN, Row, draw_curve
from bhd_lerobot.training.rl.parts import make_parts
from bhd_lerobot.training.rl.validation import Validation, level


@dataclass
class RlResult:
    """The outcome of a run.

    Attributes:
        output_dir: the run's folder.
        step: environment steps that were done.
        checkpoint: the last checkpoint.
        best: the checkpoint that was best on the validation episodes.
        rows: rows of `metrics.jsonl`.
        rule: level of the rule on the validation episodes, with the keys of a row.
        stopped_by: the signal that ended it, if one did.
    """

    output_dir: Path
    step: int = 0
    checkpoint: Path | None = None
    best: Path | None = None
    rows: list[Row] = field(default_factory=list)
    rule: Row = field(default_factory=dict)
    stopped_by: StopRequest = field(default_factory=StopRequest)


def require_sb3() -> None:
    """Raise unless stable-baselines3 is installed."""
    try:
        import stable_baselines3  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"Reinforcement learning needs stable-baselines3, which is not installed. {install_extra('rl')}"
        ) from error


def train(config: RlConfig, console: Console | None = None) -> RlResult:
    """Learn what a configuration asks for."""
    require_sb3()
    folder = _run_folder(config)
    try:
        with use_threads(config.threads), closing(Validation(config)) as validation, stop_on_signals() as stop:
            return _Run(config, folder, console or Console(stderr=True), validation, stop).go()
    except OSError as error:
        raise BhdError(
            f"The run in {folder} cannot be written: {error.strerror or error}. Checkpoints saved before are intact. "
            f"Make room, and continue with --resume=true --config_path={quoted(folder)}."
        ) from error
    finally:
        if not config.resume:
            with suppress(OSError):  # a run that failed before it wrote anything can be started again
                folder.rmdir()


def _run_folder(config: RlConfig) -> Path:
    """Return the run's folder, made if it was not there; without `output_dir`, a new one."""
    if config.output_dir is None:
        config.output_dir = f"outputs/train/{datetime.now():%Y-%m-%d/%H-%M-%S}_ppo_{config.robot.type}"
    folder = Path(config.output_dir).expanduser()
    try:
        if folder.exists() and not config.resume:
            resume = f", or continue its run with --resume=true --config_path={quoted(folder)}"
            is_run = (folder / "checkpoints").is_dir()
            raise ConfigError(
                f"The output folder {folder} exists{'' if is_run else ' and holds no run to continue'}. Set another "
                f"--output_dir{resume if is_run else ''}."
            )
        if config.resume and not folder.is_dir():
            raise ConfigError(f"There is no run to resume in {folder}.")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:  # also a name that is too long
        raise ConfigError(f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error
    return folder


def _write_config(config: RlConfig, folder: Path) -> None:
    """Write the resolved configuration."""
    values = {**configuration.encode(config), "resume": False}
    text = yaml.safe_dump(json.loads(json.dumps(values)), sort_keys=False, default_flow_style=None, width=110)
    (folder / configuration.RUN_CONFIG).write_text(text, encoding="utf-8")


class _Run:
    """One run, from its configuration to its result."""

    def __init__(
        self, config: RlConfig, folder: Path, console: Console, validation: Validation, stop: StopRequest
    ) -> None:
        self._config, self._console, self._validation, self._stop = config, console, validation, stop
        self._result = RlResult(folder, stopped_by=stop)
        self._started = time.perf_counter()
        self._saved = -1

    def go(self) -> RlResult:
        config, result = self._config, self._result
        first_episode = checkpoints.read_next_episode(result.output_dir) if config.resume else 0
        rule = config.validation.rule
        episodes = [] if rule is None else self._validation.run(rule, self._stop.__bool__)
        result.rule = level(episodes)
        if self._stop:
            return result
        env = BhdVectorEnv(
            config.env.n_envs,
            config.environment,
            config.robot,
            config.task,
            seed=config.seed,
            autoreset_mode="Disabled",
            threads=config.env.threads,
            first_episode=first_episode,
            episode_stride=config.env.n_envs,
        )
        with closing(env):
            from bhd_lerobot.training.rl.environment import RlVecEnv
            from bhd_lerobot.training.rl.learner import make_learner

            self._env, self._parts = env, make_parts(config, env, episodes)
            privileged = config.policy.privileged_critic
            adapter = RlVecEnv(env, self._parts, config.reward, config.ppo.gamma, privileged=privileged)
            self._learn(make_learner(config, self._parts, adapter))
        return result

    def _learn(self, learner: Any) -> None:
        from bhd_lerobot.training.rl.learner import learn

        config, result = self._config, self._result
        metrics = result.output_dir / METRICS_NAME
        rows: list[Row] = []
        if config.resume:
            checkpoints.load(result.output_dir, learner)
            result.step = self._saved = int(learner.num_timesteps)
            result.checkpoint = checkpoints.folder_of(result.output_dir, result.step)
            rows = read_metrics(metrics, result.step)
            clean(result.output_dir)
        if result.step >= config.steps:
            raise ConfigError(
                f"The run has done {result.step} of {config.steps} steps. To continue, set more with --steps."
            )
        _write_config(config, result.output_dir)
        self._metrics = MetricsFile(metrics, rows)
        self._minutes_before = rows[-1]["minutes"] if rows else 0.0
        result.rows = self._metrics.rows
        self._point_to_best()
        with RunProgress(self._console, "learning", config.steps, result.step) as self._progress:
            if not config.resume:
                self._judge(learner, {})
            try:
                learn(learner, config.steps, self._updated, self._is_over)
            except ValueError as error:
                raise self._diverged(learner) or error from None
            result.step = int(learner.num_timesteps)
            if self._saved != result.step:
                self._judge(learner, {})
            self._draw()
        self._print_summary()

    def _diverged(self, learner: Any) -> BhdError | None:
        """Return the error if the weights are no numbers any more; the learner's own is about their product only."""
        if all(bool(torch.isfinite(parameter).all()) for parameter in learner.policy.parameters()):
            return None
        kept = "there is none yet" if self._result.checkpoint is None else f"{self._result.checkpoint} is intact"
        return BhdError(
            f"The policy's weights are not finite any more after {self._result.step} steps. Training stops; of the "
            f"checkpoints, {kept}. Lower the learning rate (--ppo.lr) or the rewards (--reward.…)."
        )

    def _minutes(self) -> float:
        return (time.perf_counter() - self._started) / 60

    def _is_over(self) -> bool:
        minutes = self._config.max_minutes
        return bool(self._stop) or (minutes is not None and self._minutes() >= minutes)

    def _updated(self, learner: Any, row: Row) -> None:
        """Log an update; validate when it is time to."""
        self._result.step = int(learner.num_timesteps)
        if self._result.step - self._saved >= self._config.validation.freq and not self._stop:
            self._judge(learner, row)
            self._draw()
        else:
            self._log(row)

    def _judge(self, learner: Any, row: Row) -> None:
        """Save, and, unless the run is to stop, find out how good the policy is."""
        result = self._result
        following = max(member.course.following for member in self._env.members)
        result.checkpoint = checkpoints.save(result.output_dir, self._parts, learner, following)
        self._saved = result.step
        policy = LearnedBrainConfig(path=str(result.checkpoint / PRETRAINED_MODEL_DIR))
        found = {} if self._stop else level(self._validation.run(policy, self._stop.__bool__))
        if not self._stop:
            row = {**row, **found}
        if row:
            self._log(row)
        self._point_to_best()

    def _best(self) -> Row | None:
        """Return the row that judges the best checkpoint, the latest of equals."""
        keys = (f"val_{self._config.validation.select}", "val_score", "step")
        judged = [row for row in self._result.rows if row.get(keys[0]) is not None]
        return max(judged, key=lambda row: [row[key] for key in keys], default=None)

    def _point_to_best(self) -> None:
        best = self._best()
        folder = None if best is None else checkpoints.folder_of(self._result.output_dir, best["step"])
        if folder is not None and folder.is_dir():
            self._result.best = folder
            point(folder, checkpoints.BEST)

    def _log(self, row: Row) -> None:
        row = {"step": self._result.step, "minutes": self._minutes_before + self._minutes(), **row}
        self._metrics.append(row)
        self._progress.advance(row["step"])
        prefix = f"step {row['step']:,}  {row['minutes']:.1f} min" if "val_score" in row else ""
        self._progress.log(prefix, format_numbers(row, SHOWN))

    def _draw(self) -> None:
        config, result = self._config, self._result
        rule: Any = config.validation.rule
        shown = (rule.get_choice_name(type(rule)), result.rule) if result.rule else None
        heading = f"PPO, {config.environment}, {result.step:,} environment steps"
        draw_curve(result.rows, result.output_dir / PLOT_NAME, heading, shown)

    def _print_summary(self) -> None:
        result, lines = self._result, []
        lines.append(f"{result.step:,} environment steps in {self._minutes():.1f} min")
        if result.rule:
            lines.append(f"rule on the validation episodes: {_text(result.rule)}")
        best = self._best()
        if best is not None and result.best is not None:
            lines.append(f"best, after {best['step']:,} steps: {_text(best)}")
            lines.append(f"best checkpoint: {result.best / PRETRAINED_MODEL_DIR}")
        lines.append(f"curve: {result.output_dir / PLOT_NAME}")
        if self._stop:
            lines.append(
                f"Stopped by {self._stop.name}. Continue with: bhd-train --resume=true "
                f"--config_path={quoted(result.output_dir)}"
            )
        self._console.print(escape("\n".join(lines)), soft_wrap=True, highlight=False)


def _text(row: Row) -> str:
    return "score {val_score:.4f}, success {val_success:.3f}, return {val_return:.4f}".format_map(row)


PROGRAM = Program(
    RlConfig,
    lambda config: train(config).stopped_by.exit_status,
    parse_rl,
    "Stopped; checkpoints that were written before are complete.",
)
