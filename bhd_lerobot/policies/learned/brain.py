"""The brain `learned`: any trained LeRobot policy, with the processors that were saved with it."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Chunk, CommandResult
from bhd_lerobot.errors import ActionError, ConfigError
from bhd_lerobot.options.declared import Count
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint, recorded_path, weights_digest
from bhd_lerobot.policies.learned.contract import PolicyContract

if TYPE_CHECKING:
    from bhd_lerobot.policies.learned.inference import Rows

_STATE, _ENVIRONMENT, _ACTION = "observation.state", "observation.environment_state", "action"
_FIXED = ("bhd_cnn", "bhd_pixels", "act", "diffusion")  # policies that do not scale images to a size of their own
_log = logging.getLogger(__name__)


@BrainConfig.register_subclass("learned")
@dataclass
class LearnedBrainConfig(BrainConfig):
    """Parameters of the learned brain.

    Attributes:
        path: the checkpoint: its folder, a training run's folder (then its last checkpoint), or a name on the Hub.
        device: where it runs: `cpu`, `cuda`, …
        n_action_steps: how many actions of a chunk are carried out before it looks again; as it was trained if not set.
        sample: draw actions from a Gaussian policy instead of taking its mean.
        stream: give whole chunks, which continue while the policy thinks: for `clock = realtime`, where it is slow.
        exact: infer for every simulation by itself: the bits are those of LeRobot's own evaluation however many run
            side by side; slower.
        threads: threads for torch on the CPU; if not set, one for small networks and torch's own choice for others.
        name: what reports call it.
    """

    path: str
    device: str = "cpu"
    n_action_steps: Count | None = None
    sample: bool = False
    stream: bool = False
    exact: bool = False
    threads: Count | None = None
    name: str = "learned"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.path:
            raise ConfigError("brain.path is empty; name a checkpoint or a training run's folder.")


class LearnedBrain(Brain):
    """Drives n simulations, whose episodes need not be in step, with one policy.

    Every simulation has its own chunk, history and random numbers, which follow from its episode's seed; those that
    need a new chunk in the same frame share a forward pass.
    """

    name = "learned"

    def __init__(self, config: LearnedBrainConfig) -> None:
        from bhd_lerobot.policies.learned.inference import expected_frames, make_inference
        from bhd_lerobot.policies.learned.policy import load_policy

        self.config, self.name = config, config.name
        folder = find_checkpoint(config.path)
        self._recorded_path = recorded_path(config.path, folder)
        self.contract = PolicyContract.load(folder)
        self.loaded = load_policy(folder, config.device, config.n_action_steps)
        self.uses_images = bool(self._cameras)
        self.uses_privileged_state = _ENVIRONMENT in self.loaded.inputs
        self.inference = make_inference(self.loaded, sample=config.sample, exact=config.exact, threads=config.threads)
        if config.stream and self.inference.steps == 1:
            raise ConfigError(
                f"brain.stream is true, but this {self.loaded.kind!r} carries out one action at a time. Leave it out, "
                "or set brain.n_action_steps to more than 1 if the policy predicts chunks."
            )
        self._history_length = expected_frames(self.inference.frames)
        self._history: Rows = {}
        self._chunks: NDArray[np.float32] = np.zeros((0, 0, 0), np.float32)
        self._next = self._frame = np.zeros(0, np.int64)
        self._fresh = np.zeros(0, np.bool_)
        self._actions = np.zeros((0, 0))
        self._action_names: tuple[str, ...] = ()

    @staticmethod
    def robot_of(config: LearnedBrainConfig) -> str:
        """Return the robot that a configuration's policy was trained on, without loading the policy.

        Where there is no such folder, it returns no name: a configuration may be read before its policy is trained,
        and reading it asks nobody on the network. Making the brain then fails, or fetches the policy.
        """
        if not Path(config.path).expanduser().is_dir():
            return ""
        return PolicyContract.load(config.path).robot_type or ""

    def bind(self, robot: RobotFeatures) -> None:
        """Check that these are the features, the rate and the cameras that the policy was trained on."""
        who = f"The policy {self.config.path!r}"
        inputs = self.loaded.inputs
        has_environment = _ENVIRONMENT in inputs
        self.contract.check(
            robot.observation_names if _STATE in inputs else None,
            robot.action_names,
            robot.fps,
            robot.environment_names if has_environment else None,
            # A robot of another package has several names, of which `check_brain` knows.
            (robot.robot_type or None) if robot.body else None,
            robot=robot.robot,
            who=who,
        )
        if not self.contract.is_known:
            _log.warning(
                "%s does not record its training data, and its dataset is not available: only the number of its "
                "inputs is checked, not their names, the robot or the frame rate.",
                who,
            )
        for key, names in (
            (_STATE, robot.observation_names),
            (_ENVIRONMENT, robot.environment_names),
            (_ACTION, robot.action_names),
        ):
            width = self.loaded.width(key)
            if (key in inputs or key == _ACTION) and width not in (None, len(names)):
                raise ConfigError(
                    f"{who} was trained with {width} numbers in {key!r}; this robot and task have {len(names)}: "
                    f"{', '.join(names[:6]) or 'none'}{', …' if len(names) > 6 else ''}. Use the robot options and the "
                    "task of its dataset."
                )
        if robot.cameras is not None:
            self._check_cameras(robot.cameras)
        self._action_names = tuple(robot.action_names)
        self._next = np.zeros(0, np.int64)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes in some of n simulations: forget their chunks and histories, and seed their random numbers."""
        if len(self._next) != n:
            width = len(self._action_names)
            self._chunks, self._history = np.zeros((n, 0, width), np.float32), {}
            self._next, self._frame = np.zeros(n, np.int64), np.zeros(n, np.int64)
            self._fresh, self._actions = np.ones(n, np.bool_), np.zeros((n, width))
        self._next[ids] = self.inference.steps
        self._frame[ids] = 0
        self._fresh[ids] = True
        self._actions[ids] = 0
        self.inference.reset(ids, seeds, n, instructions)

    def act(self, observation: Observation) -> "NDArray[np.float64] | Chunk | None":
        """Return the actions, shape (n, actions); with `stream`, chunks, and None between two of them."""
        n = len(self._next)
        running = np.arange(n) if observation.running is None else np.flatnonzero(observation.running)
        ids = running[self._next[running] >= self.inference.steps]
        rows = self._remember(self._rows(observation, bool(self.needs_images({})[running].any())), running)
        if len(ids):
            self._store(ids, self.inference.infer(ids, {key: values[ids] for key, values in rows.items()}), rows)
        if self.config.stream:
            chunk = self._stream(running) if len(ids) else None
            self._next[running] += 1
            self._frame[running] += 1
            return chunk
        self._actions[running] = self._chunks[running, self._next[running]]
        self._next[running] += 1
        self._frame[running] += 1
        return self._actions.copy()

    def parameters(self) -> dict[str, Any]:
        """Return the parameters, and which weights they are."""
        return {
            "type": "learned",
            "path": self._recorded_path,
            "policy": self.loaded.kind,
            "weights": self._weights,
            "n_action_steps": getattr(self.loaded.config, "n_action_steps", 1),
            "sample": self.config.sample,
            "stream": self.config.stream,
            "exact": self.config.exact,
            "device": self.config.device,
            "dataset": dict(self.contract.dataset or {}),
            "trainer": self.contract.trainer,
        }

    @cached_property
    def _weights(self) -> str:
        return weights_digest(self.loaded.folder)

    def needs_images(self, results: Mapping[int, Sequence[CommandResult]]) -> NDArray[np.bool_]:
        """Return in which simulations the policy is about to use images, shape (n,)."""
        if self._history_length > 1:
            return np.full(len(self._next), self.uses_images)
        is_due = self._next >= self.inference.steps
        return self.uses_images & (is_due & (self._frame == 0) if self.inference.looks_once else is_due)

    @property
    def _cameras(self) -> dict[str, str]:
        """The cameras that it looks through, by key; images of those that its training data lacked it makes up."""
        if not getattr(self.loaded.config, "empty_cameras", 0):
            return self.loaded.cameras
        known = self.contract.cameras
        return {
            key: camera
            for key, camera in self.loaded.cameras.items()
            if (not camera.startswith("empty_camera") if known is None else camera in known)
        }

    def _rows(self, observation: Observation, is_looking: bool) -> "Rows":
        """Return the policy's inputs of all simulations, shape (n, …); images if it looks."""
        if is_looking:
            self._check_cameras({name: images.shape[1:] for name, images in observation.images.items()})
        rows: Rows = {}
        for key in self.loaded.inputs:
            if key == _STATE:
                rows[key] = observation.state.astype(np.float32)
            elif key == _ENVIRONMENT:
                if observation.environment_state is None:
                    raise AssertionError("The brain was bound to a task that tells something.")
                rows[key] = observation.environment_state.astype(np.float32)
            elif is_looking and key in self._cameras:
                rows[key] = observation.images[self._cameras[key]]
        return rows

    def _check_cameras(self, cameras: Mapping[str, tuple[int, ...]]) -> None:
        """Check that the cameras that the policy looks at are there, with images of the shape that it knows."""
        for key, camera in self._cameras.items():
            shape = tuple((self.contract.cameras or {}).get(camera, ())) or self._own_shape(key)
            if camera not in cameras:
                size = f" --robot.camera_width={shape[1]} --robot.camera_height={shape[0]}" if shape else ""
                raise ConfigError(
                    f"The policy {self.config.path!r} uses the camera {camera!r} ({key}), which this robot does not "
                    f"have. There is: {', '.join(cameras) or 'none'}. Set --robot.camera=true{size}."
                )
            if shape and cameras[camera] != shape:
                height, width, channels = shape
                contract = replace(self.contract, cameras={camera: (height, width, channels)})
                contract.check(cameras={camera: cameras[camera]}, who=f"The policy {self.config.path!r}")

    def _own_shape(self, key: str) -> tuple[int, ...]:
        """Return the shape of images that the policy itself says it takes, channels last; empty if it may take any."""
        is_fixed = self.loaded.kind in _FIXED and not getattr(self.loaded.config, "resize_shape", None)
        if not is_fixed:
            return ()
        channels, *size = self.loaded.shapes[key]
        return (*size, channels)

    def _remember(self, rows: "Rows", running: NDArray[np.intp]) -> "Rows":
        """Return the frames that the policy looks at, shape (n, frames, …), oldest first."""
        length = self._history_length
        if length == 1:
            return {key: values[:, None] for key, values in rows.items()}
        fresh = running[self._fresh[running]]
        self._fresh[running] = False
        for key, values in rows.items():
            if key not in self._history:
                self._history[key] = np.zeros((len(values), length, *values.shape[1:]), values.dtype)
            history = self._history[key]
            history[running, :-1] = history[running, 1:]
            history[running, -1] = values[running]
            # As in the dataset, nothing was before an episode's first frame but that frame.
            history[fresh] = values[fresh, None]
        columns = [length - 1 + frame for frame in self.inference.frames]
        return {key: history[:, columns] for key, history in self._history.items()}

    def _store(self, ids: NDArray[np.intp], chunks: NDArray[np.float32], rows: "Rows") -> None:
        finite = np.isfinite(chunks)
        if not finite.all():
            row, step, column = np.argwhere(~finite)[0]
            sim = int(ids[row])
            blind = [key for key, values in rows.items() if not np.isfinite(values[sim]).all()]
            cause = f"its input {blind[0]!r} is not finite either" if blind else "all its inputs are finite"
            raise ActionError(
                f"The policy {self.config.path!r} gave {chunks[row, step, column]} for "
                f"{self._action_names[column]!r}, {step} frames ahead, in frame {self._frame[sim]} of the episode in "
                f"simulation {sim}; {cause}. The training perhaps diverged: look at its loss, and use an earlier "
                "checkpoint."
            )
        if self._chunks.shape[1] != chunks.shape[1]:
            self._chunks = np.zeros((len(self._next), *chunks.shape[1:]), np.float32)
        self._chunks[ids] = chunks
        self._next[ids] = 0

    def _stream(self, running: NDArray[np.intp]) -> Chunk:
        """Return what is left of every simulation's chunk; the shorter ones continue with their last action."""
        length = self._chunks.shape[1]
        columns = np.minimum(self._next[:, None] + np.arange(length), length - 1)
        left = np.take_along_axis(self._chunks, columns[..., None], axis=1)
        longest = length - int(self._next[running].min())
        return Chunk(left.transpose(1, 0, 2)[:longest].astype(np.float64))
