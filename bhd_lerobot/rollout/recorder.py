"""The dataset of a run: opened or continued, and filled with episodes."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format.features import (
    ACTION,
    EFFORT,
    EXPERT_ACTION,
    IMAGE_AGE,
    OBSERVATION_IMAGES,
    TIME,
    dataset_features,
)
from bhd_lerobot.datasets.format.summary import DatasetSummary, dataset_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import is_free
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.robots.external.names import name_of_robot
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.robots.host.host import describe
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.rollout.types import Episode
from bhd_lerobot.tasks.task import Task, TaskConfig


@dataclass(frozen=True)
class Recording:
    """A dataset that is opened, or continued; `language`: whether the plan is recorded in LeRobot's language column."""

    repo_id: str
    root: Path
    fps: int
    task: TaskConfig
    seed: int
    split: str
    resume: bool = False
    language: bool = False
    expert_action: bool = False


def open_recorder(recording: Recording, robots: Robots, task: Task, brain: Brain) -> DatasetRecorder:
    """Open the dataset of a recording, or continue with it."""
    root = recording.root
    features = dataset_features(
        robots.observation_names,
        robots.action_names,
        robots.camera_shapes,
        robots.columns,
        task.environment_names,
        expert=recording.expert_action,
        subtask=brain.has_plan,
        language=brain.has_plan and recording.language,
    )
    if recording.expert_action:
        _check_expert(brain)
    # What decides the episodes. How many there are, and how many run side by side, does not.
    about: dict[str, Any] = {
        "robot": describe(robots.config),
        "task": task.parameters(),
        "brain": brain.parameters(),
        "seed": recording.seed,
        "split": recording.split,
    }
    is_continued = recording.resume and not is_free(root)
    if is_continued and (info := info_of(root)) is not None:
        if EFFORT not in info.features:
            features.pop(EFFORT, None)  # the dataset is older than this column
        about["robot"] = _as_read_then(about["robot"], info.recording.get("robot"))
        about["task"] = _without_new(about["task"], info.recording.get("task"), type(recording.task))
        about["brain"] = _as_named_then(about["brain"], info.recording.get("brain"))
    make = DatasetRecorder.resume if is_continued else DatasetRecorder.create
    recorder = make(
        recording.repo_id,
        recording.fps,
        features,
        robot_type=name_of_robot(robots.config),
        root=root,
        recording=about,
        fsync=robots.world is None,  # a real robot is switched off, and its loop does not wait for a save
    )
    if robots.clock is not None and robots.camera_shapes:
        recorder.encode_in_process()  # on the wall clock the loop waits for no encoder
    return recorder


_BY_OPTION = (EFFORT, EXPERT_ACTION)
"""Columns that a dataset may do without: it is older, or did not ask for them."""


def save_episode(recorder: DatasetRecorder, episode: Episode, metadata: dict[str, Any]) -> None:
    """Save an episode; when this returns, it survives a kill."""
    writer = episode.writer or recorder.begin_episode()
    try:
        known = recorder.features
        columns = {key: column for key, column in episode.columns.items() if key not in _BY_OPTION or key in known}
        if EXPERT_ACTION in known:
            columns.setdefault(EXPERT_ACTION, columns[ACTION])  # of a rule, which is the expert
        _age_dropped(columns, writer.dropped, known.get(IMAGE_AGE, {}).get("names", ()))
        writer.set_columns(columns)
        recorder.save(writer, task=episode.instruction, metadata=metadata)
    except BaseException:
        writer.discard()
        raise


def _age_dropped(columns: dict[str, NDArray], dropped: Mapping[str, list[int]], cameras: Sequence[str]) -> None:
    """Let the age of an image that stands in the place of dropped ones grow from frame to frame."""
    if not cameras or not dropped:
        return
    ages, time_s = columns[IMAGE_AGE].copy(), columns[TIME]
    for key, rows in dropped.items():
        column = cameras.index(key.removeprefix(f"{OBSERVATION_IMAGES}."))
        for row in rows:
            ages[row, column] = ages[row - 1, column] + time_s[row] - time_s[row - 1]
    columns[IMAGE_AGE] = ages


@contextmanager
def closing_used(recorder: DatasetRecorder, *, is_new: bool) -> Iterator[DatasetRecorder]:
    """Finalise a dataset at the end; remove a new one without an episode, which would be in the next run's way."""
    try:
        with recorder:
            yield recorder
    finally:
        info = info_of(recorder.root)
        if is_new and info is not None and not info.episodes:
            for name in ("meta", "data", "videos", layout.STAGING):
                shutil.rmtree(recorder.root / name, ignore_errors=True)
            with suppress(OSError):  # a link, or a mount point, stays
                recorder.root.rmdir()


def language_column(plan: dict[str, Any], subtasks: NDArray, fps: int) -> NDArray:
    """Return LeRobot's column `language_persistent`: the plan, and every subtask from its first frame on.

    Every frame of an episode holds the same rows. The plan's `steps` are pairs of a skill and a text.
    """
    rows: list[dict[str, Any]] = []

    def say(style: str, content: str, frame: int) -> None:
        when = {"timestamp": frame / fps, "camera": None, "tool_calls": None}
        rows.append({"role": "assistant", "content": content, "style": style, **when})

    if plan.get("steps"):
        say("plan", "\n".join(f"{number}. {text}" for number, (_, text) in enumerate(plan["steps"], 1)), 0)
    for frame, text in enumerate(subtasks):
        if frame == 0 or text != subtasks[frame - 1]:
            say("subtask", str(text), frame)
    column = np.empty(len(subtasks), dtype=object)
    column[:] = [rows] * len(subtasks)
    return column


def _without_new(asked: dict[str, Any], recorded: Any, kind: type) -> dict[str, Any]:
    """Return options without those that a dataset is older than, if they are as they are by default.

    By default an option of a task leaves it as it was before there was that option.
    """
    if not isinstance(recorded, Mapping):
        return asked
    kept = dict(asked)
    for field in fields(kind):
        name = field.name
        made = field.default if field.default_factory is MISSING else field.default_factory()
        default = asdict(made) if is_dataclass(made) and not isinstance(made, type) else made
        if name not in kept:
            continue
        if name not in recorded and kept[name] == default:
            del kept[name]
        elif name in recorded and is_dataclass(made):
            kept[name] = _without_new(kept[name], recorded[name], type(made))
    return kept


def _as_read_then(asked: dict[str, Any], recorded: Any) -> dict[str, Any]:
    """Return the description of a robot with those options of a dataset's that say how its frames were read, as then.

    They changed nothing in the frames; some are gone.
    """
    then = recorded.get("realtime") if isinstance(recorded, Mapping) else None
    if "realtime" not in asked or not isinstance(then, Mapping):
        return asked
    names = {"buffer_s", *RealtimeConfig.removed} - ({"plant_process"} if then.get("plant_process") else set())
    return {**asked, "realtime": asked["realtime"] | {name: then[name] for name in names & then.keys()}}


def _as_named_then(asked: Any, recorded: Any) -> Any:
    """Return the parameters of a brain with each policy named as in the dataset, if its weights are those.

    A policy is what its weights are: it may have been moved, and older datasets name it as the user did.
    """
    if not (isinstance(asked, Mapping) and isinstance(recorded, Mapping)):
        return asked
    named = {name: _as_named_then(value, recorded.get(name)) for name, value in asked.items()}
    if "path" in recorded and "weights" in asked and asked["weights"] == recorded.get("weights"):
        named["path"] = recorded["path"]
    return named


def info_of(root: Path) -> DatasetSummary | None:
    """Return what a dataset is; None if it cannot be read."""
    try:
        return dataset_info(root)
    except BhdError:  # what is wrong with it is said when it is resumed
        return None


def _check_expert(brain: Any) -> None:
    """Raise if nobody states what an expert would do."""
    about = brain.parameters()
    inner = about.get("brain")  # of one that is blanked
    if (inner if isinstance(inner, Mapping) else about).get("type") == "learned":  # a rule is its own expert
        raise ConfigError(
            "dataset.expert_action records an expert's actions, but brain.type is 'learned', a policy, and no "
            "expert. Use a rule, or brain.type=dagger with a rule as its expert, such as gap_follower."
        )
