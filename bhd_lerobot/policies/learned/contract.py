"""What a policy was trained on, kept beside its weights, so that it is never run on anything else by mistake."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from lerobot.utils.constants import (
    ACTION,
    OBS_ENV_STATE,
    OBS_IMAGE,
    OBS_IMAGES,
    OBS_STATE,
)

from bhd_lerobot import __version__
from bhd_lerobot.datasets.format.features import names_of
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import ConfigError, brief
from bhd_lerobot.options.units import other_units
from bhd_lerobot.policies.learned.checkpoint import CONFIG_FILE, WEIGHT_FILES, find_checkpoint

__all__ = ["CONFIG_FILE", "CONTRACT_FILE", "FORMAT", "WEIGHT_FILES", "PolicyContract", "camera_name", "find_checkpoint"]

CONTRACT_FILE = "bhd.json"
"""Name of the file in a checkpoint's folder `pretrained_model`."""

FORMAT = 1
"""Version of the file."""


@dataclass(frozen=True)
class PolicyContract:
    """What a policy was trained on. A part that is None is not known.

    Attributes:
        robot_type: the robot, for example ``"turtlebot3"``.
        fps: frames a second [Hz].
        observation_names: names of the columns of `observation.state`, in order.
        action_names: names of the columns of `action`, in order.
        environment_names: names of the columns of `observation.environment_state`, in order; empty if there were none.
        cameras: image shapes (height, width, channels) [px] by camera name.
        units: what the numbers are in.
        task: parameters of the task in the dataset.
        robot: options of the robot in the dataset.
        dataset: which dataset it was: `repo_id`, `root` (the folder's name), `episodes`, `frames`.
        trainer: the program that trained it.
        versions: of the packages that trained it.
    """

    robot_type: str | None = None
    fps: int | None = None
    observation_names: tuple[str, ...] | None = None
    action_names: tuple[str, ...] | None = None
    environment_names: tuple[str, ...] | None = None
    cameras: Mapping[str, tuple[int, int, int]] | None = None
    units: str | None = None
    task: Mapping[str, Any] | None = None
    robot: Mapping[str, Any] | None = None
    dataset: Mapping[str, Any] | None = None
    trainer: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_known(self) -> bool:
        """Whether it states which features the policy takes and gives; if not, only their shapes can be checked."""
        return self.observation_names is not None or self.action_names is not None

    @classmethod
    def from_dataset(cls, meta: Any, trainer: str | None = None) -> Self:
        """Return the contract of a policy that is trained on a dataset."""
        root = Path(meta.root)
        contract = cls._from_info(meta.info, root)
        known = dict(contract.dataset or {}, repo_id=meta.repo_id)
        return replace(contract, dataset=known, trainer=trainer, versions=_versions())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the contract of a trained policy.

        Without `bhd.json`, for example after stock `lerobot-train`, the dataset that `train_config.json` names is
        asked, if it is on this machine; what cannot be found out is None.
        """
        folder = find_checkpoint(path)
        file = folder / CONTRACT_FILE
        if not file.exists():
            return cls._from_train_config(folder)
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            if not isinstance(values, dict):
                raise ValueError("it is not a JSON object")
            if values.pop("format", FORMAT) != FORMAT:
                raise ValueError(f"it is of another format than {FORMAT}; a newer version of this package wrote it")
            names = {one.name for one in fields(cls)}
            return cls(**{key: _frozen(key, value) for key, value in values.items() if key in names})
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"{file} cannot be read: {error}. It describes the policy's training data. Copy the checkpoint again; "
                "or delete the file, and only the shapes of features can be checked."
            ) from error

    def save(self, folder: str | Path) -> Path:
        """Write `bhd.json` into a folder, in one step; return the file."""
        file = Path(folder) / CONTRACT_FILE
        Disk().publish(file, (json.dumps({"format": FORMAT, **asdict(self)}, indent=2) + "\n").encode())
        return file

    def check(
        self,
        observation_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        fps: int | None = None,
        environment_names: Sequence[str] | None = None,
        robot_type: str | None = None,
        *,
        cameras: Mapping[str, Sequence[int]] | None = None,
        robot: Mapping[str, Any] | None = None,
        who: str = "The policy",
    ) -> None:
        """Check that the policy fits what it is to drive. What is None, here or in the contract, is not checked.

        Cameras are image shapes (height, width, channels) [px] by name; more than the policy knows are fine. Of the
        robot's options those are compared that say what its numbers mean.
        """
        if None not in (robot_type, self.robot_type) and robot_type != self.robot_type:
            raise ConfigError(
                f"{who} was trained on the robot {self.robot_type!r} and would drive a {robot_type!r}. Choose that "
                f"robot (--robot.type={self.robot_type}), or a policy that was trained on a {robot_type}."
            )
        if None not in (self.units, "SI") and self.units != "SI":
            raise ConfigError(f"{who} was trained on values in {self.units}; robots here use SI units and radians.")
        if fps is not None and self.fps is not None and fps != self.fps:
            raise ConfigError(
                f"{who} was trained at {self.fps} frames a second and would drive a robot at {fps}. Set "
                f"--robot.fps={self.fps} (--dataset.fps={self.fps} when recording), or train on data of {fps} fps."
            )
        for what, trained, here, remedy in (
            ("observation", self.observation_names, observation_names, "the same --robot options"),
            ("action", self.action_names, action_names, "the same --robot options, such as action_space"),
            ("environment", self.environment_names, environment_names, "the same task with the same --task options"),
        ):
            if trained is not None and here is not None and tuple(trained) != tuple(here):
                raise ConfigError(
                    f"{who} was trained on other {what} features: {_difference(trained, here)}. "
                    f"Use {remedy} as in {self._data()}, or train on data of this robot and task."
                )
        for name, then, now in other_units(self.robot or {}, robot or {}):
            raise ConfigError(
                f"{who} was trained on numbers of another meaning: robot.{name} was {then} there and is {now} here. "
                f"Set --robot.{name}={then}, or train on data of this robot."
            )
        for name, shape in (self.cameras or {}).items():
            if cameras is None:
                break
            if name not in cameras:
                raise ConfigError(
                    f"{who} uses the camera {name!r}, which this robot does not have. There is: "
                    f"{', '.join(cameras) or 'none'}. Turn cameras on (--robot.camera=true)."
                )
            if tuple(cameras[name]) != tuple(shape):
                raise ConfigError(
                    f"{who} was trained on images of {_size(shape)} from the camera {name!r}; here they are "
                    f"{_size(cameras[name])}. Set --robot.camera_width={shape[1]} --robot.camera_height={shape[0]}."
                )

    def _data(self) -> str:
        name = (self.dataset or {}).get("repo_id")
        return f"the dataset {name!r}" if name else "its dataset"

    @classmethod
    def _from_train_config(cls, folder: Path) -> Self:
        with contextlib.suppress(OSError, ValueError, AttributeError, KeyError, TypeError):
            dataset = json.loads((folder / "train_config.json").read_text(encoding="utf-8"))["dataset"]
            repo_id, root = dataset["repo_id"], dataset.get("root")
            if root is None:
                from lerobot.utils.constants import HF_LEROBOT_HOME

                root = HF_LEROBOT_HOME / repo_id
            info = json.loads((Path(root) / "meta" / "info.json").read_text(encoding="utf-8"))
            contract = cls._from_info(info, Path(root))
            return replace(contract, dataset={**(contract.dataset or {}), "repo_id": repo_id}, trainer="lerobot-train")
        return cls()

    @classmethod
    def _from_info(cls, info: Any, root: Path) -> Self:
        """Return what a dataset's `info.json` tells, and its `bhd.json`, if it has one."""

        def read(name: str) -> Any:
            return info[name] if isinstance(info, dict) else getattr(info, name)

        features = read("features")
        recording: Mapping[str, Any] = {}
        units = None
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            recording = dict(json.loads((root / "meta" / CONTRACT_FILE).read_text(encoding="utf-8"))["recording"])
            units = "SI"  # it is our recorder that writes that file
        return cls(
            robot_type=read("robot_type"),
            fps=int(read("fps")),
            observation_names=_names(features, OBS_STATE),
            action_names=_names(features, ACTION),
            environment_names=_names(features, OBS_ENV_STATE) if OBS_ENV_STATE in features else (),
            cameras={
                camera_name(key): _channels_last(feature)
                for key, feature in features.items()
                if feature["dtype"] in ("video", "image")
            },
            units=units,
            task=recording.get("task"),
            robot=recording.get("robot"),
            dataset={"root": root.name, "episodes": read("total_episodes"), "frames": read("total_frames")},
        )


def camera_name(key: str) -> str:
    """Return a camera's name from an image feature's key."""
    return key.removeprefix(f"{OBS_IMAGES}.").removeprefix(f"{OBS_IMAGE}.")


def _names(features: Mapping[str, Any], key: str) -> tuple[str, ...] | None:
    """Return the names of a feature's columns."""
    return (names_of(features[key]) or None) if key in features else None


def _channels_last(feature: Mapping[str, Any]) -> tuple[int, int, int]:
    first, second, third = (int(size) for size in feature["shape"])
    is_first = str((feature.get("names") or ("",))[0]).startswith("channel")
    return (second, third, first) if is_first else (first, second, third)


def _difference(trained: Sequence[str], here: Sequence[str]) -> str:
    """Return in what two lists of names differ: how many, which, or in what place."""
    missing = [name for name in trained if name not in set(here)]
    new = [name for name in here if name not in set(trained)]
    if missing or new:
        parts = [f"{len(trained)} there and {len(here)} here"]
        parts += [f"only there {brief(missing, 4)}"] * bool(missing) + [f"only here {brief(new, 4)}"] * bool(new)
        return "; ".join(parts)
    place = next(i for i, pair in enumerate(zip(trained, here, strict=False)) if pair[0] != pair[1])
    return f"the same names in another order; column {place} is {trained[place]!r} there and {here[place]!r} here"


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]} px" if len(shape) >= 2 else str(tuple(shape))


def _frozen(key: str, value: Any) -> Any:
    """Return what JSON read, as the type that the field has; refuse another."""
    if value is None:
        return None
    if key.endswith("_names"):
        if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
            raise ValueError(f"{key} is {value!r}; it must be a list of names")
        return tuple(value)
    if key == "cameras":
        return {name: (int(height), int(width), int(channels)) for name, (height, width, channels) in value.items()}
    if key == "fps" and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
        raise ValueError(f"fps is {value!r}; it must be a whole number of Hz")
    if key in ("task", "robot", "dataset", "versions") and not isinstance(value, dict):
        raise ValueError(f"{key} is {value!r}; it must be an object")
    return value


def _versions() -> dict[str, str]:
    return {"bhd_lerobot": __version__, **{name: metadata.version(name) for name in ("lerobot", "torch", "numpy")}}
