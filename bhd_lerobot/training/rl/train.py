"""`bhd-train` with `algorithm: ppo`: a policy learns by trial and error."""

import json
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from rich.console import Console
from rich.markup import escape

import bhd_lerobot.plugin  # noqa: F401  registers our policies and environments
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import BhdError, ConfigError, install_extra, quoted
from bhd_lerobot.rollout import configuration
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals
from bhd_lerobot.training.log import METRICS_NAME, MetricsFile, read_metrics
from bhd_lerobot.training.rl import checkpoint as checkpoints
from bhd_lerobot.training.rl.config import RlConfig, parse_rl
from bhd_lerobot.training.rl.features import ActionUnits, FeatureStack
from bhd_lerobot.training.rl.folder import remove_empty, run_folder, write_config
from bhd_lerobot.training.rl.log import PLOT_NAME, Episodes, RlProgress, Row, draw_curve
from bhd_lerobot.training.rl.parts import RlParts, make_parts
from bhd_lerobot.training.rl.shaping import Shaping
from bhd_lerobot.training.rl.validation import Level, Validation, level


@dataclass
class RlResult:
    """What became of a run.

    Attributes:
        output_dir: the run's folder.
        step: environment steps that were done.
        checkpoint: the last checkpoint.
        best: the checkpoint that was best on the validation episodes.
        rows: rows of `metrics.jsonl`.
        rule: level of the rule on the validation episodes.
        stopped_by: the signal that ended it, if one did.
    """

    output_dir: Path
    step: int = 0
    checkpoint: Path | None = None
    best: Path | None = None
    rows: list[Row] = field(default_factory=list)
    rule: Level | None = None
    stopped_by: StopRequest = field(default_factory=StopRequest)


def require_sb3() -> None:
    """Raise unless stable-baselines3 is installed.

    Raises:
        ConfigError: it is not; the message says how to install it.
    """
    # A module that is None in sys.modules is blocked, and find_spec raises ValueError for it.
    try:
        found = find_spec("stable_baselines3") is not None
    except ValueError:
        found = False
    if not found:
        raise ConfigError(
            f"Reinforcement learning needs stable-baselines3, which is not installed. {install_extra('rl')}"
        )


def train(config: RlConfig, console: Console | None = None) -> RlResult:
    """Learn what a configuration asks for.

    Args:
        config: the configuration.
        console: where progress is shown; standard error if None.

    Raises:
        BhdError: the configuration cannot be honoured, or training failed. Checkpoints saved before are intact.
    """
    require_sb3()
    folder = run_folder(config)
    threads = torch.get_num_threads()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    try:
        with closing(Validation(config)) as validation, stop_on_signals() as stop:
            return _Run(config, folder, console or Console(stderr=True), validation, stop).go()
    except OSError as error:
        raise BhdError(
            f"The run in {folder} cannot be written: {error.strerror or error}. Checkpoints saved before are intact. "
            f"Make room, and go on with --resume=true --config_path={quoted(folder)}."
        ) from error
    finally:
        torch.set_num_threads(threads)
        if not config.resume:
            remove_empty(folder)


class _Run:
    """One run, from its configuration to its result."""

    def __init__(
        self, config: RlConfig, folder: Path, console: Console, validation: Validation, stop: StopRequest
    ) -> None:
        self._config, self._console, self._validation, self._stop = config, console, validation, stop
        self._result = RlResult(folder, stopped_by=stop)
        self._episodes = Episodes()
        self._best = -float("inf")
        self._saved = -1
        self._before_s = 0.0  # how long the run had taken when it was resumed

    def go(self) -> RlResult:
        config, result = self._config, self._result
        self._started = time.perf_counter()
        episodes = (
            [] if config.validation.rule is None else self._validation.run(config.validation.rule, self._stop.__bool__)
        )
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
            first_episode=self._first_episode(),
            episode_stride=config.env.n_envs,
        )
        with closing(env):
            parts = make_parts(config, env, episodes)
            learner = self._learner(parts, env)
            self._learn(learner, parts, env)
        return result

    def _first_episode(self) -> int:
        if not self._config.resume:
            return 0
        path = self._result.output_dir / "checkpoints/last/training_state" / checkpoints.RUN
        try:
            return int(json.loads(path.read_text(encoding="utf-8"))["next_episode"])
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(f"There is no run to resume in {self._result.output_dir}: {error}") from error

    def _learner(self, parts: RlParts, env: BhdVectorEnv) -> Any:
        from bhd_lerobot.training.rl.adapter import RlVecEnv
        from bhd_lerobot.training.rl.build import make_learner

        config = self._config
        stack = FeatureStack(parts.front, parts.before, env.num_envs)
        shaping = Shaping(config.reward, config.ppo.gamma, env.num_envs)
        adapter = RlVecEnv(env, stack, ActionUnits(parts.after), shaping)
        adapter.on_episode = self._episodes.add
        return make_learner(config, parts, adapter, self._done)

    def _done(self, step: int) -> float:
        """Return how much of the run is done, from 0 to 1."""
        minutes = self._config.max_minutes
        passed = 0.0 if minutes is None else self._minutes() / minutes
        return min(1.0, max(passed, step / self._config.steps))

    def _minutes(self) -> float:
        return (time.perf_counter() - self._started + self._before_s) / 60

    def _learn(self, learner: Any, parts: RlParts, env: BhdVectorEnv) -> None:
        config, result = self._config, self._result
        metrics = result.output_dir / METRICS_NAME
        rows: list[Row] = []
        if config.resume:
            result.step, run = checkpoints.load(result.output_dir, learner)
            self._best = -float("inf") if run["best"] is None else run["best"]
            self._before_s = run["seconds"]
            rows = read_metrics(metrics, result.step)
            result.checkpoint = (result.output_dir / "checkpoints/last").resolve()
            best = result.output_dir / "checkpoints" / checkpoints.BEST
            result.best = best.resolve() if best.exists() else None
            self._saved = result.step
        if result.step >= config.steps:
            raise ConfigError(
                f"The run has done {result.step} of {config.steps} steps. To go on, set more with --steps."
            )
        write_config(config, result.output_dir)
        self._file, self._parts, self._env = MetricsFile(metrics, rows), parts, env
        result.rows = self._file.rows
        self._judged = result.step
        with RlProgress(self._console) as self._progress:
            from bhd_lerobot.training.rl.build import learn

            if not config.resume:
                self._judge(learner, {"step": 0, "minutes": self._minutes()})
            try:
                learn(learner, config.steps, self._updated, self._is_over)
            except ValueError as error:
                raise self._diverged(learner) or error from None
            result.step = int(learner.num_timesteps)
            self._judge_or_save(learner)
        self._tell()

    def _diverged(self, learner: Any) -> BhdError | None:
        """Return what to say if the weights are no numbers any more; the learner only says so of their product."""
        if all(bool(torch.isfinite(one).all()) for one in learner.policy.parameters()):
            return None
        kept = "there is none yet" if self._result.checkpoint is None else f"{self._result.checkpoint} is intact"
        return BhdError(
            f"The policy's weights are not finite any more after {self._result.step} steps. Training stops; of the "
            f"checkpoints, {kept}. Lower the learning rate (--ppo.lr) or the rewards (--reward.…)."
        )

    def _is_over(self) -> bool:
        minutes = self._config.max_minutes
        return bool(self._stop) or (minutes is not None and self._minutes() >= minutes)

    def _updated(self, learner: Any, row: Row) -> None:
        """Log an update; validate when it is time to."""
        self._result.step = int(learner.num_timesteps)
        row = {"step": self._result.step, "minutes": self._minutes(), **self._episodes.take(), **row}
        if self._result.step - self._judged >= self._config.validation.freq and not self._stop:
            self._judge(learner, row)
        else:
            self._log(row)

    def _judge_or_save(self, learner: Any) -> None:
        if self._stop or self._saved == self._result.step:
            if self._saved != self._result.step:
                self._save(learner)
            self._draw()
        else:
            self._judge(learner, {"step": self._result.step, "minutes": self._minutes()})

    def _judge(self, learner: Any, row: Row) -> None:
        """Save, and find out how good the policy is."""
        self._judged = self._result.step
        folder = self._save(learner)
        found = self._validation.checkpoint(folder / PRETRAINED_MODEL_DIR, self._stop.__bool__)
        if found is not None and not self._stop:
            row = {**row, **found.row()}
            value = {"score": found.score, "success": found.success, "return": found.reward}[
                self._config.validation.select
            ]
            if value >= self._best:
                self._best, self._result.best = value, folder
                checkpoints.point(folder, checkpoints.BEST)
        self._log(row)
        self._draw()

    def _save(self, learner: Any) -> Path:
        following = max(member.course.following for member in self._env.members)
        best = None if self._best == -float("inf") else self._best
        run = {"next_episode": following, "best": best, "seconds": self._minutes() * 60}
        folder = checkpoints.save(self._result.output_dir, self._result.step, self._parts, learner, run)
        self._result.checkpoint, self._saved = folder, self._result.step
        return folder

    def _log(self, row: Row) -> None:
        self._file.append(row)
        self._progress.show(row, self._done(self._result.step))

    def _draw(self) -> None:
        config, result = self._config, self._result
        rule: Any = config.validation.rule
        shown = None if result.rule is None else (rule.get_choice_name(type(rule)), result.rule.row())
        heading = f"PPO, {config.environment}, {result.step:,} environment steps"
        draw_curve(result.rows, result.output_dir / PLOT_NAME, heading, shown)

    def _tell(self) -> None:
        result, lines = self._result, []
        lines.append(f"{result.step:,} environment steps in {self._minutes():.1f} min")
        if result.rule is not None:
            lines.append(f"rule on the validation episodes: {_text(result.rule.row())}")
        judged = [row for row in result.rows if row.get("val_score") is not None]
        if judged and result.best is not None:
            best = next((row for row in judged if row["step"] == int(result.best.name)), judged[-1])
            lines.append(f"best, after {best['step']:,} steps: {_text(best)}")
            lines.append(f"best checkpoint: {result.best / PRETRAINED_MODEL_DIR}")
        lines.append(f"curve: {result.output_dir / PLOT_NAME}")
        if self._stop:
            lines.append(
                f"Stopped by {self._stop.name}. Go on with: bhd-train --resume=true "
                f"--config_path={quoted(result.output_dir)}"
            )
        self._console.print(escape("\n".join(lines)), soft_wrap=True, highlight=False)


def _text(row: Row) -> str:
    return f"score {row['val_score']:.4f}, success {row['val_success']:.3f}, return {row['val_return']:.4f}"


def main(arguments: Sequence[str]) -> int:
    """Run `bhd-train` with `algorithm: ppo`; return the exit status: 0, 2 after an error, 130 after Ctrl-C."""
    if any(one in ("-h", "--help") for one in arguments):
        print(configuration.describe(RlConfig))
        return 0
    try:
        return train(parse_rl(arguments)).stopped_by.exit_status
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # before the run began, or a second time while it was ending
        print("Interrupted; checkpoints that were written before are complete.", file=sys.stderr)
        return 128 + signal.SIGINT
