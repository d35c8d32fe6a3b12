"""Write docs/reference/options.md and the pages in options/: every option and dataset column, from the code.

python scripts/make_reference.py
"""

import argparse
import ast
import dataclasses
import inspect
import re
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.teleoperators.config import TeleoperatorConfig

import bhd_lerobot.plugin  # noqa: F401  registers the teleoperators
from bhd_lerobot.bodies.tabletop import OBJECT_FIELDS
from bhd_lerobot.cli import ros2
from bhd_lerobot.control.commands import GoalPhase, ResultCode
from bhd_lerobot.control.messages import Limit, Mode, Reason, Watchdog
from bhd_lerobot.control.record import STATE_FIELDS
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.environment import EnvironmentEvalConfig
from bhd_lerobot.options.declared import declaration_of
from bhd_lerobot.options.help import meanings_of, summary_of
from bhd_lerobot.options.parse import choices_of, options_of
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.parts.names import drive_observation_names
from bhd_lerobot.robots.ur import UR5
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.ros2.serve.config import BridgeConfig, ServeConfig
from bhd_lerobot.tasks import avoid, navigate, pick, reach
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.config import BhdTrainConfig, own_fields
from bhd_lerobot.training.dagger.config import AggregationConfig
from bhd_lerobot.training.rl.config import RlConfig

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference"

_INDEX = """\
# Options and columns

Options are written `--key=value` on the command line, or as nested keys in a YAML file that `--config_path=FILE` names;
the command line wins. `type` chooses among several classes. *Required* means that there is no default. "Nothing" is
written `null`.

| page | options |
| --- | --- |
| [`bhd-record`](options/record.md) | of a recording |
| [`bhd-replay`](options/replay.md) | of a replay |
| [`bhd-eval`](options/eval.md) | of an evaluation, also with `env` |
| [`bhd-train`](options/train.md) | of a training, also with `algorithm: ppo` and `algorithm: dagger` |
| [`bhd-ros2`](options/ros2.md) | of a simulated robot on a ROS 2 network, and of what is on one |
| [`teleop`](options/teleop.md) | of each teleoperator of ours, for LeRobot's own commands, too |
| [`robot`](options/robot.md), [`brain`](options/brain.md), [`task`](options/task.md) | of each type |
"""
_TRAIN = """\
LeRobot's own options of training, `policy.*`, `dataset.*`, `steps`, `batch_size` and the others, keep their names and
meaning; they are not listed here.
"""
_ENVIRONMENT = """\
`env.type` and LeRobot's own options of environments, `env.*`, keep their names and meaning; `--env.type=TYPE --help`
lists them. Those of the type `bhd` are described [with the environments](../../how_to/environments.md).
"""
_TELEOPERATORS = """\
Besides these options each has LeRobot's own `teleop.id` and `teleop.calibration_dir`, which ours do not need.
"""

_RECORD = """\
# The record of a robot

What a tick of the [cerebellum](../explanation/control.md) reads and changes is one record for each robot, a numpy
structured type, `bhd_lerobot.control.record.STATE`: a row of `Cerebellum.states`, and on the wall clock of the ring
that its process publishes every tick. Values beyond a robot's own joints are 0. An arm on a base has the arm's values
first, then the wheels'. A command of a base is a forward speed [m/s] and a yaw rate [rad/s], one of an arm joint
positions [rad] and an opening [m], one of an impedance the pose of the tool and an opening.
"""
# In which columns of a dataset fields are recorded, at the end of each frame.
_RECORDED = {
    "command": f"`{keys.APPLIED_ACTION}`",
    "requested": f"`{keys.ACTION}` of a chunk",
    "torque": f"`{keys.EFFORT}`",
    "wrench": f"`{keys.WRENCH}`",
    "mode": f"`{keys.MODE}`",
    "limits": f"`{keys.LIMITS}`",
    "watchdog": f"`{keys.WATCHDOG}`",
    "due_ns": f"`{keys.COMMAND_AGE}`",
    "position": f"`{keys.OBSERVATION_STATE}`",
    "velocity": f"`{keys.OBSERVATION_STATE}`",
    "odometry": f"`{keys.OBSERVATION_STATE}`",
}

# Groups of classes whose options are listed already: what they are options of, and the page and anchor.
_MANY = 15  # options that are not listed twice
Listed = dict[frozenset[type], tuple[str, str]]


def pages() -> dict[Path, str]:
    """Return every page, by its file."""
    listed: Listed = {}
    groups = {name: _choices(kind) for name, kind, _ in options_of(RecordConfig)}
    groups["teleop"] = _choices(TeleoperatorConfig)
    texts = {name: [f"# `{name}`\n"] for name in ("robot", "brain", "task")}
    for name in (*texts, "teleop"):
        listed[frozenset(groups[name].values())] = name, f"{name}.md"
    for name, text in texts.items():
        for chosen, one in groups[name].items():
            own = [option for option, _, _ in options_of(one)]
            text.append(f"## `{name}.type={chosen}`\n")
            if same := _with_some_of(one, groups[name], chosen):
                own = [option for option in own if option not in dict(_defaults(groups[name][same]))]
                text.append(f"The options of `{name}.type={same}`{', and:' if own else '.'}\n")
            if own:
                text.extend(_options(one, f"{name}.", f"{name}.md", listed, own))
    texts["record"] = ["# `bhd-record`\n", *_options(RecordConfig, "", "record.md", listed)]
    texts["replay"] = ["# `bhd-replay`\n", *_options(ReplayConfig, "", "replay.md", listed)]
    names = [name for name, _, _ in options_of(EnvironmentEvalConfig) if name != "env"]
    texts["eval"] = [
        *("# `bhd-eval`\n", *_options(EvalConfig, "", "eval.md", listed)),
        *("## `bhd-eval` with `env`\n", _ENVIRONMENT),
        *_options(EnvironmentEvalConfig, "", "eval.md", listed, names),
    ]
    texts["train"] = [
        *("# `bhd-train`\n", _TRAIN, *_options(BhdTrainConfig, "", "train.md", listed, own_fields())),
        *("## `bhd-train` with `algorithm: ppo`\n", *_options(RlConfig, "", "train.md", listed)),
        *("## `bhd-train` with `algorithm: dagger`\n", *_options(AggregationConfig, "", "train.md", listed)),
    ]
    texts["teleop"] = ["# `teleop`\n", _TELEOPERATORS]
    for chosen, one in groups["teleop"].items():
        own = [name for name, _, _ in options_of(one) if name not in ("id", "calibration_dir")]
        texts["teleop"] += [
            f"## `teleop.type={chosen}`\n",
            *_options(one, "teleop.", "teleop.md", listed, own),
        ]
    texts["ros2"] = [
        *("# `bhd-ros2`\n", "## `bhd-ros2 serve`\n", *_options(ServeConfig, "", "ros2.md", listed)),
        *("## `bhd-ros2 bridge`\n", *_options(BridgeConfig, "", "ros2.md", listed)),
        *("## `bhd-ros2 topics`, `record` and `play`\n", *_commands(ros2.network_parser())),
    ]
    written = {FOLDER / "options.md": _index(), FOLDER / "record.md": _record()}
    for name, parts in texts.items():
        page = "\n".join(parts)
        # A page of one command has no headings of the second level of its own.
        written[FOLDER / "options" / f"{name}.md"] = page if "\n## " in page else page.replace("\n### ", "\n## ")
    return written


def _defaults(one: Any) -> list[tuple[str, str]]:
    """Return the options of a class and their defaults, as text."""
    names = [name for name, _, _ in options_of(one)]
    return [(option.name, str(option.default)) for option in dataclasses.fields(one) if option.name in names]


def _with_some_of(one: Any, others: Mapping[str, type], chosen: str) -> str | None:
    """Return the type that has many of a class's options and no others; of those that are alike one of a short name."""
    found, own = [], _defaults(one)
    for name, other in others.items():
        theirs = _defaults(other)
        alike = len(theirs) == len(own)
        if name != chosen and len(theirs) > _MANY and set(theirs) <= set(own):
            found += [name] if not alike or _rank(name) > _rank(chosen) else []
    return max(found, key=_rank, default=None)


def _rank(name: str) -> tuple[int, str]:
    return -len(name), name


def _index() -> str:
    parts = [
        _INDEX,
        "## Dataset columns\n",
        _columns(),
        "### Modes\n\nIn `control.mode`.\n",
        _members(Mode),
        "### Limits\n\nIn `control.limits`: the sum of what applied during the frame.\n",
        _members(Limit),
        "### Watchdogs\n\nIn `control.watchdog`: the sum of what applied during the frame.\n",
        _members(Watchdog),
        "### Events\n\nIn `event`, and by name in the episode's `bhd/outcome`.\n",
        _members(Event),
        "### Reasons of refusal\n\nIn `SendResult.reasons`, and in the message of a `CommandRefusedError`.\n",
        _table(("value", "name", "meaning"), ((r.value, f"`{r.name}`", r.explanation) for r in Reason)),
        "### How goals end\n\nIn `CommandResult.code`, and by name in the episode's `bhd/results`.\n",
        _members(ResultCode),
        "### Phases of a goal\n\nIn `Feedback.phase`.\n",
        _members(GoalPhase),
    ]
    return "\n".join(parts)


def _record() -> str:
    """Return the page of a robot's record."""
    parts = [_RECORD]
    for title, fields in STATE_FIELDS.items():
        rows = []
        for name, (kind, shape, meaning) in fields.items():
            size = " × ".join(map(str, shape)) or 1
            rows.append((f"`{name}`", np.dtype(kind).name, size, meaning, _RECORDED.get(name, "")))
        parts += [f"## {title}\n", _table(("field", "type", "size", "meaning", "recorded in"), rows)]
    return "\n".join(parts)


# --- options ---------------------------------------------------------------------------------------------------------


def _options(
    config_class: type, prefix: str, page: str, listed: Listed, only: Sequence[str] | None = None
) -> Iterator[str]:
    """Yield the table of a class's plain options, and then those of the classes inside it.

    Args:
        config_class: a dataclass.
        prefix: of its options.
        page: the name of the page that they are on.
        listed: it is extended.
        only: names of the fields to list; all if None.
    """
    described = meanings_of(config_class)
    rows, inner, elsewhere = [], [], []
    for name, kind, default in options_of(config_class):
        if only is not None and name not in only:
            continue
        key, meaning = f"{prefix}{name}", described.get(name)
        if meaning is None:
            raise SystemExit(f"{config_class.__qualname__}: the docstring does not describe {name!r}.")
        choices = _choices(kind)
        groups = {f"{key}.type={name}": one for name, one in choices.items()}
        if groups:
            unset = "`null`" if default is None else "*required*"
            chosen = next((f"`{name}`" for name, one in choices.items() if one is type(default)), unset)
            rows.append((f"`{key}.type`", ", ".join(f"`{name}`" for name in choices), chosen, meaning))
        elif dataclasses.is_dataclass(kind):
            groups = {key: typing.cast(type, kind)}
        else:
            shown = "*required*" if default is dataclasses.MISSING else f"`{_plain(default)}`"
            declared = declaration_of(config_class, name)
            kind_name, null, _ = _type_name(kind).partition(" or null")
            kind_name = f"{kind_name}, {declared}{',' * bool(null)}{null}" if declared else kind_name + null
            rows.append((f"`{key}`", kind_name.removeprefix("text, "), shown, meaning))
        if classes := frozenset(groups.values()):
            first, where = next((found for known, found in listed.items() if classes <= known), ("", ""))
            if first:
                link = f"[`{first}.*`]({where.removeprefix(page) or where})"
                elsewhere.append(link if first == key else f"`{key}.*`, as {link}")
            else:
                listed[classes] = key, f"{page}#{re.sub(r'[^a-z0-9_-]', '', next(iter(groups)))}"
                inner += [(title, one, f"{key}.") for title, one in groups.items()]
    yield from _introduction(config_class)
    if rows:
        yield _table(("option", "type", "default", "meaning"), rows)
    if elsewhere:
        yield f"Also: {'; '.join(elsewhere)}.\n"
    for title, one, inner_prefix in inner:
        yield f"### `{title}`\n"
        yield from _options(one, inner_prefix, page, listed)


def _commands(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield a table of the options of a parser's commands."""
    (commands,) = (one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    of_options: dict[tuple[str, str], list[str]] = {}
    for name, command in commands.choices.items():
        for one in command._actions:
            if one.dest != "help":
                option = " ".join(filter(None, (*one.option_strings, typing.cast(str, one.metavar))))
                of_options.setdefault((f"`{option}`", str(one.help)), []).append(f"`{name}`")
    yield _table(("command", "meaning"), ((f"`{name}`", one.description) for name, one in commands.choices.items()))
    rows = ((*option, ", ".join(names)) for option, names in of_options.items())
    yield _table(("option", "meaning", "commands"), rows)


def _introduction(config_class: type) -> Iterator[str]:
    summary = summary_of(config_class)
    if not summary.startswith("Configuration of the"):  # the heading says that
        yield summary + "\n"


def _choices(kind: Any) -> dict[str, type]:
    """Return the classes of ours that are registered under a choice type, or nothing if it is none."""
    known = choices_of(kind)
    return {name: one for name, one in sorted(known.items()) if one.__module__.startswith("bhd_lerobot.")}


def _plain(value: Any) -> str:
    names = {None: "null", True: "true", False: "false"}
    return names[value] if value is None or isinstance(value, bool) else str(value)


def _type_name(kind: Any) -> str:
    arguments = tuple(one for one in typing.get_args(kind) if one is not ...)
    if arguments and typing.get_origin(kind) is dict:
        return f"{_type_name(arguments[1])} for each name"
    if arguments and typing.get_origin(kind) not in (list, tuple):
        return " or ".join("null" if one is type(None) else _type_name(one) for one in arguments)
    if arguments:
        return f"list of {_type_name(arguments[0])}"
    return {"str": "text", "Path": "path", "bool": "yes or no", "int": "whole number", "float": "number"}.get(
        kind.__name__, kind.__name__
    )


# --- columns ---------------------------------------------------------------------------------------------------------

_VECTORS = {
    keys.OBSERVATION_STATE: "the robot's floats in the order of its observation features; named in `meta/info.json`",
    f"{keys.OBSERVATION_IMAGES}.front": "the front camera, RGB; only with `robot.camera=true`",
    f"{keys.OBSERVATION_IMAGES}.scene": "the camera beside the table, RGB; only with `robot.camera=true`",
    f"{keys.OBSERVATION_IMAGES}.wrist": "the camera at the gripper, RGB; only with `robot.camera=true`",
    keys.ENVIRONMENT_STATE: "what the task gives to the brain; see below",
    keys.LANGUAGE: "the plan and the subtasks as LeRobot's language rows, each with the time from which it was valid; "
    "the same in every frame of an episode; only of brains with a plan",
    keys.SUBTASK: "what the brain is doing, in words; only of brains with a plan",
    keys.ACTION: "the brain's command for the coming frame; for goals, where the reference is at its end",
    keys.APPLIED_ACTION: "what the cerebellum commanded at the end of the frame, after all limits",
    keys.PHYSICS_STATE: "the simulator's generalised positions, then velocities, when the observation was measured",
}

_DEFAULTS = {
    "timestamp": "frame_index / fps [s]",
    "frame_index": "number of the frame in its episode, from 0",
    "episode_index": "number of the episode in the dataset, from 0",
    "index": "number of the frame in the dataset, from 0",
    "task_index": "number of the instruction in `meta/tasks.parquet`",
}


def _columns() -> str:
    config = TurtleBot3Config(camera=True)
    image = (config.camera_height, config.camera_width, 3)
    # The state of a free body (7 positions, 6 velocities) and of two wheels.
    base = keys.dataset_features(
        drive_observation_names(config),
        ("x.vel", "theta.vel"),
        {"front": image},
        {keys.PHYSICS_STATE: [str(i) for i in range(17)]},
    )
    arm_config = UR5Config(camera=True)
    image = (arm_config.camera_height, arm_config.camera_width, 3)
    # Six joints and two fingers, and five free bodies.
    physics = {keys.PHYSICS_STATE: [str(i) for i in range(8 + 5 * 7 + 8 + 5 * 6)]}
    cameras = {"scene": image, "wrist": image}
    robot = UR5(arm_config)
    arm = keys.dataset_features(
        robot.observation_names, robot.action_names, cameras, physics, pick.ENVIRONMENT, subtask=True
    )
    environment = (
        "What a task gives to the brain, in `observation.environment_state`.\n\n"
        f"`reach`, {len(reach.ENVIRONMENT)} numbers: {_names(reach.ENVIRONMENT)}: the target pose of the tool in the "
        "base frame, position [m] and unit quaternion.\n\n"
        f"`pick`, {len(pick.ENVIRONMENT)} numbers: for each of five places `object_0` to `object_4` the "
        f"{len(OBJECT_FIELDS)} numbers {_names(OBJECT_FIELDS)}: whether there is an object, whether it is the one "
        "asked for, whether it is a box; its pose in the base frame; its measures [m]; its colour.\n\n"
        f"`navigate`, {len(navigate.ENVIRONMENT)} numbers: {_names(navigate.ENVIRONMENT)}: the goal in the robot's "
        "frame, position [m] and cosine and sine of the angle to its heading.\n\n"
        f"`avoid` with `task.trail`, {len(avoid.TRAIL)} numbers: `{avoid.TRAIL[0]}` to `{avoid.TRAIL[-1]}`: whether "
        "the robot has visited the cell at that bearing and distance from it.\n"
    )
    return "\n".join(
        (
            "### TurtleBot3\n\nAs `bhd-record` writes them for a TurtleBot3 with its defaults and a camera. "
            "[dataset.md](dataset.md) says more about each.\n",
            _feature_table({**base, **DEFAULT_FEATURES}),
            "### UR5\n\nAs `bhd-record` writes them for a UR5 in the pick task with cameras; those that are like the "
            "TurtleBot3's are left out.\n",
            _feature_table({key: one for key, one in arm.items() if base.get(key) != one}),
            "### Environment state\n",
            environment,
        )
    )


def _feature_table(features: dict[str, dict[str, Any]]) -> str:
    rows = []
    for key, feature in features.items():
        meaning = keys.SCALARS[key][1] if key in keys.SCALARS else {**_VECTORS, **_DEFAULTS}[key]
        shape = " × ".join(str(size) for size in feature["shape"])
        rows.append((f"`{key}`", feature["dtype"], shape, meaning))
    return _table(("key", "type", "size", "meaning"), rows)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _members(kind: type[Enum]) -> str:
    """Return a table of an enumeration's members, with the docstrings that stand below them."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    notes: dict[str, str] = {}
    name = ""
    for node in typing.cast(ast.ClassDef, tree).body:
        if isinstance(node, ast.Assign):
            name = ast.unparse(node.targets[0])
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and name:
            notes[name] = " ".join(str(node.value.value).split())
    members = kind.__members__.items()
    return _table(("value", "name", "meaning"), ((m.value, f"`{n}`", notes.get(n, "")) for n, m in members))


def _table(headings: tuple[str, ...], rows: Any) -> str:
    lines = [headings, tuple("---" for _ in headings), *rows]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def main() -> None:
    """Write every page."""
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
