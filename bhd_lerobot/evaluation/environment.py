"""`bhd-eval --env.type=…`: policies in an environment of LeRobot, rolled out by LeRobot as `lerobot-eval` does it."""

import contextlib
import io
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

import bhd_lerobot.envs.config_env  # noqa: F401  registers the type `bhd`
from bhd_lerobot import stock
from bhd_lerobot.errors import BhdError, ConfigError, as_text, unknown_name
from bhd_lerobot.evaluation.config import Comparison, EvalDatasetConfig
from bhd_lerobot.evaluation.evaluate import EvalResult, finish, measured_with, refuse_results
from bhd_lerobot.evaluation.metrics import EnvironmentMetrics
from bhd_lerobot.evaluation.report import NO_SUCCESS, ReportInput
from bhd_lerobot.evaluation.results import ENVIRONMENT_MEANS, summarise
from bhd_lerobot.options.command import Program
from bhd_lerobot.options.declared import Count, LibrarySeed, Share
from bhd_lerobot.options.parse import CommandLine, choices_of, decode, encode
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint, recorded_path, weights_digest
from bhd_lerobot.policies.learned.policy import LoadedPolicy, load_policy
from bhd_lerobot.rollout.progress import progress_bars
from bhd_lerobot.rollout.run_folder import run_folder
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals

Envs = dict[str, dict[int, Any]]  # of LeRobot: vector environments by the group and number of a task


@dataclass
class EnvironmentEvalConfig(Comparison):
    """Compare policies in an environment of LeRobot, on the same seeds: the outcomes are those of `lerobot-eval`.

    Attributes:
        env: the environment, with LeRobot's own options.
        brains: the policies to compare, each under a name of your choice: `--brains.NAME.path=CHECKPOINT`.
        brain: short for one policy: `--brain.path=CHECKPOINT`.
        only: run only these of the brains.
        n_episodes: number of episodes of each brain, of each of the environment's tasks.
        seed: seed of the first episode; that of the i-th is higher by i. It also seeds what policies draw at random.
        baseline: name of the brain with which the others are compared; by default the first.
        n_envs: number of environments that LeRobot steps side by side, its `eval.batch_size`. What a policy draws at
            random, and the last bits of a network's output, depend on it.
        fail_below: end with exit status 1 if the lower end of a brain's 95 % interval of success is below this.
        output_dir: folder for results and report; by default a new one in `outputs/eval`.
    """

    env: EnvConfig
    brains: dict[str, BrainConfig] = field(default_factory=dict)
    brain: BrainConfig | None = None
    only: list[str] | None = None
    n_episodes: Count = 100
    seed: LibrarySeed = 0
    baseline: str | None = None
    n_envs: Count = 16
    fail_below: Share | None = None
    output_dir: str | None = None
    record = EvalDatasetConfig()  # not options: nothing is recorded, and all episodes are run
    sequential = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._name_brains()
        for label, brain in self.brains.items():
            _check_policy(f"brains.{label}", brain)
        if self.env.fps < 1:
            raise ConfigError(f"env.fps is {self.env.fps}; it must be at least 1.")
        self.n_envs = min(self.n_envs, self.n_episodes)

    @property
    def name(self) -> str:
        """The environment, with its task, as text."""
        return f"{self.env.type} {self.env.task or ''}".strip()

    @property
    def heading(self) -> str:
        """Which episodes are run, as text."""
        return f"{self.n_episodes} episodes of {self.name}, seed {self.seed}"

    def again(self, episode: int) -> list[str]:
        """Return the options that run a single episode again."""
        return [f"--seed={self.seed + episode % self.n_episodes}", "--n_episodes=1"]


def _check_policy(key: str, brain: BrainConfig) -> None:
    """Refuse a brain that is not a policy, and options that LeRobot's rollout does not have."""
    if not isinstance(brain, LearnedBrainConfig):
        raise ConfigError(
            f"{key}.type is {brain.get_choice_name(type(brain))!r}; in an environment of LeRobot only policies run: "
            f"set --{key}.path to a checkpoint. For a robot of this package set --robot.type in place of --env.type."
        )
    default = LearnedBrainConfig(brain.path)
    for name in ("sample", "stream", "exact", "threads"):
        if getattr(brain, name) != getattr(default, name):
            raise ConfigError(
                f"{key}.{name} is {getattr(brain, name)!r}, which LeRobot's rollout does not have. Leave it out."
            )


# --- from a command line ---------------------------------------------------------------------------------------------


def read(line: CommandLine) -> EnvironmentEvalConfig:
    """Return the configuration of a command line with `env`."""
    values = line.over(line.file)
    if both := [name for name in ("robot", "task") if name in values]:
        raise ConfigError(
            f"env and {' and '.join(both)} are both given, but an environment of LeRobot has its own robot and task. "
            "Leave out env to use a robot of this package, and robot and task to use the environment."
        )
    env = values["env"]
    chosen = env.get("type") if isinstance(env, dict) else env
    if isinstance(chosen, str) and chosen not in choices_of(EnvConfig):
        raise ConfigError(
            f"{unknown_name('env.type', chosen, choices_of(EnvConfig))} Another package's environments are known once "
            "it is installed, if its name begins with lerobot_env_ (pip install lerobot-env-…); those that a module of "
            "yours registers with --env.discover_packages_path=MODULE."
        )
    for brain in (values.get("brains") or {}, {"brain": values.get("brain")}):
        for one in brain.values() if isinstance(brain, dict) else ():
            if isinstance(one, dict) and "path" in one:
                one.setdefault("type", "learned")
    return decode(EnvironmentEvalConfig, values)


# --- the run ---------------------------------------------------------------------------------------------------------


class _StoppedError(Exception):
    """The run was asked to end in the middle of a batch."""


class _Watched:
    """A vector environment that notes how its episodes end; `says_success`: whether all of them had an `is_success`."""

    def __init__(self, env: Any, stop: StopRequest) -> None:
        self._env, self._stop = env, stop
        self._frames: NDArray[np.int64] = np.zeros(env.num_envs, np.int64)
        self._terminated, self._over = np.zeros((2, env.num_envs), np.bool_)
        self.says_success = True

    def ending(self, i: int) -> tuple[int, bool]:
        """Return the number of steps of an episode, and whether something else than its time ended it."""
        return int(self._frames[i]), bool(self._terminated[i])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, **given: Any) -> Any:
        self._frames[:], self._terminated[:], self._over[:] = 0, False, False
        return self._env.reset(**given)

    def step(self, action: Any) -> Any:
        if self._stop:
            raise _StoppedError
        stepped = self._env.step(action)
        _, _, terminated, truncated, info = stepped
        self.says_success &= "is_success" in info.get("final_info", ("is_success",))
        self._frames += ~self._over
        self._terminated |= terminated & ~self._over
        self._over |= terminated | truncated
        return stepped


@dataclass
class _Policy:
    """A brain of the evaluation: where its policy is, and what it did."""

    label: str
    config: LearnedBrainConfig
    folder: Path
    facts: dict[str, Any] = field(default_factory=dict)
    is_privileged: bool = False
    says_success: bool = True
    episodes: list[EnvironmentMetrics] = field(default_factory=list)
    wall_s: float = 0.0

    def load(self) -> LoadedPolicy:
        try:
            return load_policy(self.folder, self.config.device, self.config.n_action_steps, for_robot=False)
        except ConfigError as error:
            raise ConfigError(f"brains.{self.label}: {error}") from error


def evaluate_in_environment(config: EnvironmentEvalConfig, console: Console | None = None) -> EvalResult:
    """Run every policy on the same seeds, write results and report.

    Raises:
        ConfigError: the environment cannot be made, or a policy cannot be loaded or does not fit it.
        BhdError: a policy or the environment fails in an episode; the batches that were finished are kept.
    """
    console = console or Console(file=sys.stderr)  # by itself, while LeRobot's bars are kept from the terminal
    refuse_results(config)
    policies = [_policy(label, brain) for label, brain in config.chosen.items()]
    tasks = _check(config, policies)
    requested = config.n_episodes * len(tasks)
    torch.backends.cudnn.benchmark = torch.backends.cuda.matmul.allow_tf32 = True  # as lerobot-eval
    failure: BhdError | None = None
    name = config.name.replace(" ", "_").replace("/", "_")
    with run_folder(config, "eval", name) as folder, stop_on_signals() as stop:
        with progress_bars(console, "success") as progress:
            bars = [progress.add_task(escape(one.label), total=requested, success="") for one in policies]
            for one, bar in zip(policies, bars, strict=True):
                try:
                    for _ in () if stop or failure else _run(config, one, stop):
                        good, n = sum(episode.success for episode in one.episodes), len(one.episodes)
                        progress.update(bar, completed=n, success=f"{good}/{n} succeeded")
                except BhdError as error:
                    failure = error
        if failure is not None and not any(one.episodes for one in policies):
            raise failure
    facts = {
        "env": encode(config)["env"],
        "tasks": tasks,
        "brains": {one.label: one.facts for one in policies},
        "baseline": config.reference,
        "seed": config.seed,
        "n_episodes": config.n_episodes,
        "n_envs": config.n_envs,
        "says_success": all(one.says_success for one in policies),
    }
    if not facts["says_success"]:
        console.print(f"[bold]Warning:[/bold] {NO_SUCCESS}", highlight=False)
    results = summarise(
        facts,
        {**measured_with(), "gymnasium": metadata.version("gymnasium")},
        {one.label: one.episodes for one in policies},
        requested,
        config.reference,
        privileged={one.label for one in policies if one.is_privileged},
        means=ENVIRONMENT_MEANS,
    )
    timing: dict[str, Any] = {
        "made": datetime.now().astimezone().isoformat(timespec="seconds"),
        "n_envs": config.n_envs,
        "clock": "lockstep",
        "brains": {},
        "wall_s": {one.label: one.wall_s for one in policies},
    }
    result = EvalResult(folder, results, timing, folder / "report.html", stopped_by=stop)
    no_videos = "videos of an environment of LeRobot are made by lerobot-eval."
    finish(console, config, result, lambda: ReportInput(config, results, timing, {}, [], no_videos, folder))
    if failure is not None:
        raise failure
    return result


def _policy(label: str, brain: Any) -> _Policy:
    try:
        return _Policy(label, brain, find_checkpoint(brain.path))
    except ConfigError as error:
        raise ConfigError(f"brains.{label}: {error}") from error


def _make(config: EnvironmentEvalConfig, n: int) -> Envs:
    """Return n environments of each task, in this process: workers do not know what other packages register."""
    kind = config.env.type
    try:
        made: Envs = stock.make_env(config.env, n_envs=n, use_async_envs=False)
    except ConfigError:
        raise
    except ImportError as error:
        extras = metadata.metadata("lerobot").get_all("Provides-Extra") or []
        package = f"lerobot[{kind}]" if kind in extras else (error.name or config.env.package_name).replace("_", "-")
        raise ConfigError(
            f"env.type is {kind!r}, which needs a package that is not installed: {as_text(error)}. Install it: "
            f"pip install '{package}'"
        ) from error
    except Exception as error:  # of another package's code
        raise ConfigError(
            f"env.type is {kind!r}, which cannot be made: {as_text(error)}. Check the options of env and what is "
            "installed for it."
        ) from error
    return made


def _check(config: EnvironmentEvalConfig, policies: Sequence[_Policy]) -> list[str]:
    """Load every policy once and check that it fits; return the environment's tasks."""
    envs = _make(config, 1)
    try:
        first = next(iter(_tasks(envs).values()))
        try:
            seen, _ = first.reset(seed=[config.seed])
        except Exception as error:  # of another package's code
            raise ConfigError(f"env.type is {config.env.type!r}, which cannot be reset: {as_text(error)}.") from error
        for one in policies:
            loaded = one.load()
            before, _ = stock.make_env_pre_post_processors(env_cfg=config.env, policy_cfg=loaded.config)
            shapes = {
                key: tuple(value.shape[1:])
                for key, value in before({**stock.preprocess_observation(seen), "task": [""]}).items()
                if isinstance(value, torch.Tensor) and key.startswith("observation")
            }
            _check_fit(config, one, loaded, shapes, first.single_action_space.shape)
            one.is_privileged = OBS_ENV_STATE in loaded.inputs
            one.facts = {
                "type": "learned",
                "path": recorded_path(one.config.path, one.folder),
                "policy": loaded.kind,
                "weights": weights_digest(one.folder),
                "n_action_steps": getattr(loaded.config, "n_action_steps", 1),
                "device": one.config.device,
            }
        return list(_tasks(envs))
    finally:
        stock.close_envs(envs)


def _check_fit(
    config: EnvironmentEvalConfig,
    one: _Policy,
    loaded: LoadedPolicy,
    shapes: dict[str, tuple[int, ...]],
    action: tuple[int, ...],
) -> None:
    """Refuse a policy that reads what the environment does not return, or acts in another number of dimensions."""
    wrong = []
    features = dict(zip(loaded.inputs, (loaded.config.input_features or {}).items(), strict=True))
    for key, (own, _) in features.items():
        if key in loaded.cameras:  # a policy of several cameras may do with some of them
            continue
        if key not in shapes:
            wrong.append(f"it reads {key!r}, which the environment does not return")
        elif len(shapes[key]) == 1 and loaded.width(own) != shapes[key][0]:
            wrong.append(f"it reads {loaded.width(own)} numbers in {key!r}; the environment returns {shapes[key][0]}")
    if loaded.cameras and not set(loaded.cameras) & set(shapes):
        wrong.append(f"it reads the images {', '.join(loaded.cameras)}, and the environment returns none of them")
    if len(action) == 1 and loaded.width(ACTION) != action[0]:
        wrong.append(f"its actions have {loaded.width(ACTION)} numbers, and those of the environment {action[0]}")
    if wrong:
        returned = ", ".join(f"{key} {shape}" for key, shape in sorted(shapes.items())) or "nothing that a policy reads"
        raise ConfigError(
            f"brains.{one.label}: the policy {one.config.path!r} does not fit env.type {config.env.type!r}: "
            f"{'; '.join(wrong)}. The environment returns {returned}. Use the options of env that it was trained with, "
            "or a policy that was trained in this environment."
        )


def _run(config: EnvironmentEvalConfig, one: _Policy, stop: StopRequest) -> Iterator[None]:
    """Run a policy's episodes, batch by batch; yield after each.

    What draws random numbers follows in the order of `lerobot-eval`: seed, environments, policy, rollouts.
    """
    started = time.perf_counter()
    stock.set_seed(config.seed)
    envs = _make(config, config.n_envs)
    try:
        loaded = one.load()
        before, after = stock.make_env_pre_post_processors(env_cfg=config.env, policy_cfg=loaded.config)
        roll_out = partial(
            stock.eval_policy,
            policy=loaded.policy,
            env_preprocessor=before,
            env_postprocessor=after,
            preprocessor=loaded.before,
            postprocessor=loaded.after,
        )
        for task, env in _tasks(envs).items():
            watched = _Watched(env, stop)
            for first in range(0, config.n_episodes, config.n_envs):
                n = min(config.n_envs, config.n_episodes - first)
                try:
                    # LeRobot's progress bars would mix with ours.
                    with torch.no_grad(), loaded.precision(), contextlib.redirect_stderr(io.StringIO()):
                        rolled = roll_out(env=watched, n_episodes=n, start_seed=config.seed + first)
                except _StoppedError:
                    return
                except Exception as error:  # of a policy, an environment, or a processor between them
                    raise BhdError(
                        f"brains.{one.label}: the policy {one.config.path!r} cannot be evaluated in env.type "
                        f"{config.env.type!r}: {as_text(error)}. Use the options of env that it was trained with."
                    ) from error
                for i, outcome in enumerate(rolled["per_episode"]):
                    one.episodes.append(_metrics(config, one, task, outcome, watched.ending(i)))
                one.says_success &= watched.says_success
                one.wall_s = time.perf_counter() - started
                yield
            env.close()
    finally:
        stock.close_envs(envs)


def _tasks(envs: Envs) -> dict[str, Any]:
    """Return the vector environments by their tasks' names."""
    return {f"{group} {number}": env for group, tasks in envs.items() for number, env in tasks.items()}


def _metrics(
    config: EnvironmentEvalConfig, one: _Policy, task: str, outcome: dict[str, Any], ending: tuple[int, bool]
) -> EnvironmentMetrics:
    frames, is_terminated = ending
    success = bool(outcome["success"])
    return EnvironmentMetrics(
        brain=one.label,
        episode=len(one.episodes),
        seed=int(outcome["seed"]),
        success=success,
        outcome="success" if success else "failure" if is_terminated else "timeout",
        reward=float(outcome["sum_reward"]),
        max_reward=float(outcome["max_reward"]),
        frames=frames,
        length_s=frames / config.env.fps,
        task=task,
    )


PROGRAM = Program(EnvironmentEvalConfig, lambda config: evaluate_in_environment(config).exit_status, read=read)
"""`bhd-eval` with `env`."""
