"""What a notebook does: record, replay, train and evaluate, and make the robots, tasks and brains that do it.

Each takes its configuration, or keyword arguments that are named like the options of its command: nested options are
dictionaries, and where an option has a ``type``, its name alone is enough.
"""

import logging
from collections.abc import Mapping
from dataclasses import make_dataclass
from typing import TYPE_CHECKING, Any, cast

from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from rich.console import Console

from bhd_lerobot import registry
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import EvalResult
from bhd_lerobot.evaluation.evaluate import evaluate as run_evaluation
from bhd_lerobot.options.parse import decode, from_options
from bhd_lerobot.options.plugins import load_plugins
from bhd_lerobot.policies.brain import Brain, BrainConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record as run_record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.rollout.replay.simulated import Divergence
from bhd_lerobot.rollout.replay.simulated import replay as run_replay
from bhd_lerobot.stock import make_robot_from_config
from bhd_lerobot.tasks.task import Task, TaskConfig

if TYPE_CHECKING:
    from bhd_lerobot.training.config import BhdTrainConfig
    from bhd_lerobot.training.rl.config import RlConfig
    from bhd_lerobot.training.rl.train import RlResult
    from bhd_lerobot.training.train import TrainResult


# LeRobot looks for torchcodec as soon as there is a dataset's configuration, and prints 80 lines if it is broken.
logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)


def record(config: RecordConfig | None = None, *, console: Console | None = None, **options: Any) -> RecordResult:
    """Record episodes of a simulated robot, driven by a brain, into a LeRobotDataset: `bhd-record`.

    Args:
        config: what to record.
        console: where progress is shown; standard error if None.
        options: instead of the configuration, its options, such as ``robot={"type": "turtlebot3", "beams": 36}``,
            ``brain="gap_follower"``, ``dataset={"repo_id": "me/avoid", "num_episodes": 10}``.

    Raises:
        BhdError: the configuration cannot be honoured, or the dataset cannot be written.
    """
    return run_record(_configured(RecordConfig, config, options), console)


def replay(config: ReplayConfig | None = None, *, console: Console | None = None, **options: Any) -> list[Divergence]:
    """Replay a recorded episode in simulation, and return how far it diverges from the recording: `bhd-replay`.

    Args:
        config: which episode.
        console: where the result is shown; standard error if None.
        options: instead of the configuration, its options, such as ``dataset={"root": "data/avoid", "episode": 3}``.

    Raises:
        DatasetError: the dataset cannot be replayed.
    """
    return run_replay(_configured(ReplayConfig, config, options), console)


def evaluate(config: EvalConfig | None = None, *, console: Console | None = None, **options: Any) -> EvalResult:
    """Compare brains on the same episodes: `bhd-eval`.

    Args:
        config: what to compare.
        console: where progress is shown; standard error if None.
        options: instead of the configuration, its options, such as ``brains={"rule": "gap_follower", "learned":
            {"type": "learned", "path": "outputs/train/run"}}``.

    Raises:
        BhdError: the configuration cannot be honoured.
    """
    return run_evaluation(_configured(EvalConfig, config, options), console)


def train(
    config: "BhdTrainConfig | RlConfig | None" = None, *, console: Console | None = None, **options: Any
) -> "TrainResult | RlResult":
    """Train a policy on a LeRobotDataset, or with ``algorithm="ppo"`` by trial and error: `bhd-train`.

    Args:
        config: what to train.
        console: where progress is shown; standard error if None.
        options: instead of the configuration, its options, such as ``policy={"type": "bhd_mlp"}``,
            ``dataset={"repo_id": "me/avoid", "root": "data/avoid"}``, ``steps=2000``.

    Raises:
        BhdError: the configuration cannot be honoured, or training failed.
    """
    from bhd_lerobot.training.rl.config import RlConfig

    if isinstance(config, RlConfig) or "algorithm" in options:
        from bhd_lerobot.training.rl.train import train as run_rl

        return run_rl(_configured(RlConfig, cast("RlConfig | None", config), options), console)  # refuses another
    from bhd_lerobot.training.arguments import config_of
    from bhd_lerobot.training.train import train as run_train

    load_plugins()
    _refuse_both(config, options)
    return run_train(config_of(from_options(options)) if config is None else config, console)


def make_robot(robot: "str | Mapping[str, Any] | RobotConfig", **options: Any) -> Robot:
    """Return a LeRobot robot, of this package, of LeRobot or of a plug-in; it is not connected.

    Args:
        robot: its type, such as ``"turtlebot3"``, a dictionary with its ``type``, or its configuration.
        options: of its configuration.

    Raises:
        ConfigError: there is no such robot or option, or a value that cannot be honoured.
    """
    return make_robot_from_config(_choice("robot", robot, options))


def make_brain(brain: str | Mapping[str, Any] | BrainConfig, **options: Any) -> Brain:
    """Return a brain, given its type, a dictionary with it or its configuration, and options of that.

    Raises:
        ConfigError: there is no such brain or option, or a value that cannot be honoured.
    """
    return registry.make_brain(_choice("brain", brain, options))


def make_task(task: str | Mapping[str, Any] | TaskConfig, n: int = 1, fps: int = 10, **options: Any) -> Task:
    """Return a task for n simulations at `fps` frames a second, given as in `make_brain`, and options of that.

    Raises:
        ConfigError: there is no such task or option, or a value that cannot be honoured.
    """
    return registry.make_task(_choice("task", task, options), n, fps)


def _configured[T](kind: type[T], config: T | None, options: Mapping[str, Any]) -> T:
    load_plugins()
    _refuse_both(config, options)
    if config is None:
        return decode(kind, from_options(options))
    if not isinstance(config, kind):
        raise ConfigError(f"config is a {type(config).__name__}; a {kind.__name__} is needed, or keyword arguments.")
    return config


def _refuse_both(config: Any, options: Mapping[str, Any]) -> None:
    if config is not None and options:
        raise ConfigError(f"Both a configuration and options are given ({', '.join(options)}); give one of them.")


_HOLDERS = {
    word: make_dataclass(word, [(word, kind)])
    for word, kind in (("robot", RobotConfig), ("brain", BrainConfig), ("task", TaskConfig))
}


def _choice(word: str, given: Any, options: Mapping[str, Any]) -> Any:
    load_plugins()
    if not isinstance(given, str | Mapping):
        if options:
            raise ConfigError(f"{word} is a configuration, and options of it are given, too: {', '.join(options)}.")
        return given
    chosen = {"type": given} if isinstance(given, str) else given
    return getattr(decode(_HOLDERS[word], {word: from_options({**chosen, **options})}), word)
