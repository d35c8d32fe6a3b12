"""Every key of a dataset that this package records, in one place.

The names decide what LeRobot does with a column: `observation*` become a policy's inputs and `action*` its outputs.
Everything else is carried along and neither learned from nor predicted, which is why the command that was really
applied is called `control.applied_action`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

OBSERVATION_STATE = "observation.state"
OBSERVATION_IMAGES = "observation.images"
ENVIRONMENT_STATE = "observation.environment_state"
ACTION = "action"

APPLIED_ACTION = "control.applied_action"
TIME = "control.time"
AGE = "control.age"
COMMAND_AGE = "control.command_age"
LATENESS = "control.lateness"
OVERRUNS = "control.overruns"
SKIPPED = "control.skipped"
INFERENCE_TIME = "control.inference_time"
LATE = "control.late"
LIMITS = "control.limits"
WATCHDOG = "control.watchdog"
MODE = "control.mode"
EFFORT = "control.effort"
WRENCH = "control.wrench"
IMAGE_AGE = "control.image_age"
READING_AGE = "control.reading_age"
EXPERT_ACTION = "expert.action"

REWARD = "next.reward"
SUCCESS = "next.success"
DONE = "next.done"
EVENT = "event"

SUBTASK = "subtask"
LANGUAGE = "language_persistent"  # LeRobot's own name

PHYSICS_STATE = "simulation.state"

# dtype and meaning of the columns that hold one number a frame
SCALARS: dict[str, tuple[str, str]] = {
    TIME: ("float64", "when the observation was measured, since the episode's start [s]"),
    AGE: ("float32", "age of the oldest reading in the observation when the brain got it [s]"),
    COMMAND_AGE: ("float32", "age of the command in force at the end of the frame [s]"),
    LATENESS: ("float32", "largest lateness of a control tick in the frame [s]"),
    OVERRUNS: ("int64", "control ticks of the frame that ended after the next was due"),
    SKIPPED: ("int64", "control ticks of the frame that were left out because one before them was late"),
    INFERENCE_TIME: ("float32", "time that the brain took for the decision that drove the frame [s]; 0 in lockstep"),
    LATE: ("bool", "the frame violates the timing tolerance; false in lockstep"),
    LIMITS: (
        "int64",
        "limits that changed the command: 1 not finite, 2 velocity, 4 acceleration, 8 effort, 16 position, 32 "
        "posture, 64 clearance; sum",
    ),
    WATCHDOG: (
        "int64",
        "watchdogs that were triggered: 1 command too old, 2 arm blocked, 4 brain silent, 8 recorder silent (before "
        "version 0.4), 16 plant silent, 32 too many missed ticks, 64 guard, 128 force, 256 speed; sum",
    ),
    MODE: (
        "int64",
        "cerebellum's mode at the end of the frame: 0 unconfigured, 1 inactive, 2 hold, 3 tracking, 4 stopping, "
        "5 safe off, 6 emergency stop, 7 fault",
    ),
    REWARD: ("float32", "the task's reward for the frame"),
    SUCCESS: ("bool", "the episode ended in success with this frame"),
    DONE: ("bool", "the episode ended with this frame"),
    EVENT: (
        "int64",
        "0 nothing, 1 success, 2 collision, 3 stuck, 4 time-out, 5 intervention, 6 emergency stop, 7 wrong object, 8 "
        "dropped, 9 unreachable, 10 fault, 11 failure without a stated cause",
    ),
}

# What a simulated clock makes zero: it is never late, and time stands still while the brain thinks.
PUNCTUALITY = (LATENESS, OVERRUNS, SKIPPED, INFERENCE_TIME, LATE)


def dataset_features(
    observation_names: Sequence[str],
    action_names: Sequence[str],
    images: Mapping[str, tuple[int, int, int]],
    columns: Mapping[str, Sequence[str]],
    environment_names: Sequence[str] = (),
    *,
    expert: bool = False,
    subtask: bool = False,
    language: bool = False,
) -> dict[str, dict[str, Any]]:
    """Return the features of a dataset in LeRobot's form.

    Args:
        images: image shapes (height, width, 3) by camera name.
        columns: what the robots report beside observation and action: names of the values by key, in order; those of
            `SCALARS` are always there.
        environment_names: the values of the environment state, in order; no such column if there are none.
    """
    features: dict[str, dict[str, Any]] = {OBSERVATION_STATE: _vector("float32", observation_names)}
    if environment_names:
        features[ENVIRONMENT_STATE] = _vector("float32", environment_names)
    for name, shape in images.items():
        features[f"{OBSERVATION_IMAGES}.{name}"] = {
            "dtype": "video",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
    features[ACTION] = _vector("float32", action_names)
    features[APPLIED_ACTION] = _vector("float32", action_names)
    for key, (dtype, _) in SCALARS.items():
        features[key] = {"dtype": dtype, "shape": (1,), "names": None}
    if subtask:
        features[SUBTASK] = {"dtype": "string", "shape": (1,), "names": None}
    if language:
        features[LANGUAGE] = {"dtype": "language", "shape": (1,), "names": None}
    # The place of a column in a file does not depend on the robot that has it.
    vectors = {key: names for key, names in columns.items() if key not in SCALARS}
    for key in (EFFORT, EXPERT_ACTION, WRENCH, *sorted({*vectors} - {EFFORT, WRENCH, PHYSICS_STATE}), PHYSICS_STATE):
        if key == EXPERT_ACTION:
            if expert:
                features[key] = _vector("float32", action_names)
        elif vectors.get(key):
            features[key] = _vector("float64" if key == PHYSICS_STATE else "float32", vectors[key])
    return features


def _vector(dtype: str, names: Sequence[str]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (len(names),), "names": list(names)}


def names_of(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's numbers, one for each; empty where it does not name them one by one.

    LeRobot's datasets have them as a list, as lists in an object (``{"motors": [...]}``), or as an object of places.
    """
    names = feature.get("names")
    if isinstance(names, Mapping) and all(isinstance(place, int) for place in names.values()):
        names = sorted(names, key=names.__getitem__)
    elif isinstance(names, Mapping):
        names = [name for part in names.values() for name in (part if isinstance(part, list | tuple) else [part])]
    if not isinstance(names, list | tuple) or len(names) != math.prod(feature.get("shape") or (len(names),)):
        return ()
    return tuple(map(str, names))


def numbered_names_of(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's numbers; where it does not name them one by one, their places from 0 on."""
    return names_of(feature) or tuple(map(str, range(math.prod(feature["shape"]))))


def meaning_of(key: str, feature: dict[str, Any]) -> str:
    """Return what a column holds, as text; the names of a vector where there is nothing better."""
    if key in SCALARS:
        return SCALARS[key][1]
    if key in _LEROBOT_COLUMNS:
        return _LEROBOT_COLUMNS[key]
    told = names_of(feature)
    text = f"{', '.join(told[:3])}, … {told[-1]}" if len(told) > 6 else ", ".join(told)
    return f"privileged, from the simulator's true state: {text}" if key == ENVIRONMENT_STATE else text


_LEROBOT_COLUMNS = {
    SUBTASK: "the brain's current step, in words",
    "timestamp": "frame_index / fps [s]",
    "frame_index": "number of the frame in its episode",
    "episode_index": "number of the episode in the dataset",
    "index": "number of the frame in the dataset",
    "task_index": "number of the instruction",
}
