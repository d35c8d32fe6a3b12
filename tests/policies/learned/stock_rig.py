"""LeRobot's programs in this process, and what a policy saw and did in each of them and in bhd-eval."""

import contextlib
import logging
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from lerobot.scripts import lerobot_eval, lerobot_rollout, lerobot_train
from numpy.typing import NDArray

from bhd_lerobot.cli import evaluate
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.policies.learned.brain import LearnedBrain
from bhd_lerobot.robots.robot import BhdRobot

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_PROGRAMS: dict[str, Callable[[], None]] = {
    "lerobot-train": lerobot_train.main,
    "lerobot-eval": lerobot_eval.main,
    "lerobot-rollout": lerobot_rollout.main,
}


class Trace(NamedTuple):
    """What a policy saw, shape (frames, numbers and pixels), and what it did, shape (frames, actions)."""

    seen: NDArray[np.float32]
    done: NDArray[np.float32]


def arguments(**values: Any) -> list[str]:
    """Return a command line's options; names are written with `__` for dots."""
    return [f"--{name.replace('__', '.')}={value}" for name, value in values.items()]


@contextlib.contextmanager
def _undone() -> Iterator[None]:
    """Give back what LeRobot's programs take of a process: its log, its signals, its command line."""
    root, argv = logging.getLogger(), sys.argv
    log, handlers = (root.level, root.handlers[:]), [signal.getsignal(one) for one in _SIGNALS]
    try:
        yield
    finally:
        root.level, root.handlers[:] = log
        sys.argv = argv
        for one, handler in zip(_SIGNALS, handlers, strict=True):
            signal.signal(one, handler)


def run_stock(program: str, options: list[str]) -> None:
    """Run one of LeRobot's programs as its console script does."""
    with _undone():
        sys.argv = [program, *options]
        _PROGRAMS[program]()


def trace_bhd_eval(folder: Path, options: list[str]) -> Trace:
    """Run bhd-eval on one episode and return what its learned brain saw and did."""
    seen, done, act = [], [], LearnedBrain.act

    def spy(self: LearnedBrain, observation: Any) -> Any:
        action = act(self, observation)
        seen.append(_flat(observation.state[0], {name: image[0] for name, image in observation.images.items()}))
        done.append(action[0])
        return action

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LearnedBrain, "act", spy)
        # Images are made only where they are looked at; here every one is compared.
        patch.setattr(LearnedBrain, "needs_images", lambda self, results: np.full(1, self.uses_images))
        assert evaluate.main([*options, *arguments(n_episodes=1, n_envs=1, videos=0, output_dir=folder)]) == 0
    return _trace(seen, done)


def trace_lerobot_eval(folder: Path, options: list[str]) -> Trace:
    """Run lerobot-eval on one episode and return what the policy saw and did."""
    seen, done, reset, step = [], [], BhdVectorEnv.reset, BhdVectorEnv.step

    def look(observation: Any) -> None:
        images = {name: image[0] for name, image in observation.get("pixels", {}).items()}
        seen.append(_flat(observation["agent_pos"][0], images))

    def spy_reset(self: BhdVectorEnv, **given: Any) -> Any:
        result = reset(self, **given)
        look(result[0])
        return result

    def spy_step(self: BhdVectorEnv, actions: Any) -> Any:
        done.append(np.array(actions[0]))
        result = step(self, actions)
        look(result[0])
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BhdVectorEnv, "reset", spy_reset)
        patch.setattr(BhdVectorEnv, "step", spy_step)
        common = arguments(eval__n_episodes=1, eval__batch_size=1, seed=0, policy__device="cpu", output_dir=folder)
        run_stock("lerobot-eval", [*options, *common])
    return _trace(seen, done)


def trace_lerobot_rollout(frames: int, options: list[str]) -> Trace:
    """Run lerobot-rollout, press Ctrl-C after some frames, and return what the policy saw and did."""
    seen, done = [], []
    get, send = BhdRobot.get_observation, BhdRobot.send_action

    def spy_get(self: BhdRobot) -> Any:
        observation = get(self)
        images = {name: observation[name] for name in self.camera_shapes}
        seen.append(_flat([observation[name] for name in self.observation_names], images))
        return observation

    def spy_send(self: BhdRobot, action: Any) -> Any:
        if len(done) == frames:
            raise KeyboardInterrupt
        done.append([action[name] for name in self.action_names])
        return send(self, action)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BhdRobot, "get_observation", spy_get)
        patch.setattr(BhdRobot, "send_action", spy_send)
        # fps only says how long to wait between frames: a lockstep robot has its own.
        run_stock("lerobot-rollout", [*options, *arguments(fps=1000, return_to_initial_position="false")])
    return _trace(seen[1:], done)  # LeRobot looks once more, before it begins


def _flat(state: Any, images: dict[str, Any]) -> NDArray[np.float32]:
    """Return a new array of the numbers, and of the pixels camera by camera."""
    parts = [np.asarray(state), *(images[name] for name in sorted(images))]
    return np.concatenate([np.asarray(part, np.float32).ravel() for part in parts])


def _trace(seen: list[Any], done: list[Any]) -> Trace:
    return Trace(np.array(seen[: len(done)], np.float32), np.array(done, np.float32))
