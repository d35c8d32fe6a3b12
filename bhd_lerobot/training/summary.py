"""What `bhd-train` prints before and after a run."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bhd_lerobot.errors import counted, quoted
from bhd_lerobot.options.plugins import module_to_name
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.registry import robot_configs, tasks_for
from bhd_lerobot.robots.host.host import LEFT_OUT_IF_OFF
from bhd_lerobot.tasks.task import TaskConfig
from bhd_lerobot.training.checkpoint import resume_command
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.data import TrainingData
from bhd_lerobot.training.log import METRICS_NAME, PLOT_NAME

if TYPE_CHECKING:
    from bhd_lerobot.training.train import TrainResult


def print_start(console: Console, config: BhdTrainConfig, policy: Any, data: TrainingData, step: int) -> None:
    """Print which policy is trained on which data."""
    learnable = sum(parameter.numel() for parameter in policy.parameters() if parameter.requires_grad)
    total = sum(parameter.numel() for parameter in policy.parameters())
    frozen = f", {total - learnable:,} more are fixed" if total > learnable else ""
    held_out = f", {len(data.held_out_episodes)} held out" if data.held_out_episodes else ""
    table = _table()
    table.add_row(
        "policy", escape(f"{policy.config.type}, {learnable:,} parameters{frozen}, on {policy.config.device}")
    )
    table.add_row("data", f"{counted(data.episodes, 'episode')}{held_out}, {data.frames:,} samples in an epoch")
    table.add_row("loader", escape(data.how))
    samples = config.batch_size * data.train.order.world_size
    epochs = config.steps * samples / data.frames
    passes = f"{epochs:,.1f}" if epochs < 100 else f"{epochs:,.0f}"
    table.add_row("steps", f"{config.steps:,} of {samples} samples: {passes} epochs")
    if step:
        table.add_row("resumed", f"after step {step}")
    table.add_row("run folder", escape(str(config.output_dir)))
    console.print(table)


def print_summary(console: Console, config: BhdTrainConfig, result: "TrainResult") -> None:
    """Print how the run ended, where its files are, and the next command."""
    losses = [row["loss"] for row in result.rows if row.get("loss") is not None]
    held_out = [row["held_out_loss"] for row in result.rows if row.get("held_out_loss") is not None]
    table = _table()
    table.add_row("steps", f"{result.step:,} of {config.steps:,} in {result.wall_s:.1f} s")
    if losses:
        table.add_row("loss", _course(losses))
    if held_out:
        table.add_row("held-out loss", _course(held_out))
    table.add_row("metrics", escape(str(result.output_dir / METRICS_NAME)))
    table.add_row("curve", escape(str(result.output_dir / PLOT_NAME)))
    if result.checkpoint is not None:
        table.add_row("checkpoint", escape(str(result.checkpoint / PRETRAINED_MODEL_DIR)))
    console.print(table)
    lines = []
    if result.stopped_by and result.step < config.steps:
        lines.append(
            f"Stopped by {result.stopped_by.name}. " + ("Continue with:" if result.checkpoint else "Nothing saved.")
        )
        if result.checkpoint is not None:
            lines.append(f"  {resume_command(result.checkpoint)}")
    elif result.checkpoint is not None:
        lines += how_to_evaluate(result.contract, str(result.checkpoint), config.policy)
    for line in lines:
        console.print(escape(line), soft_wrap=True, highlight=False)


def _table() -> Table:
    """Return an empty table of names and values, which folds a path that is too long."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column()
    table.add_column(overflow="fold")
    return table


def _course(losses: Sequence[float]) -> str:
    if len(losses) == 1:
        return f"{losses[0]:.4g}, logged once"
    return f"{losses[0]:.4g} at first, {losses[-1]:.4g} at the end"


def how_to_evaluate(contract: PolicyContract, checkpoint: str, policy: Any = None) -> list[str]:
    """Return a line and a command that evaluate a checkpoint of a policy on held-out episodes of its task.

    The command names the options of robot and task that are not at their defaults: with others the observations or
    actions do not fit. A dataset that another program recorded does not say its task; then it is one of the robot's.
    """
    path = f"{checkpoint}/{PRETRAINED_MODEL_DIR}"
    kinds = robot_configs()
    found: Any = contract.task or {}
    kind, task, module = "" if policy is None else policy.type, found.get("type"), ""
    if kind == "bhd_perception":  # its recordings are single looks at the scenes of the task
        found = {key: value for key, value in found.items() if key != "duration_s"}
    if contract.robot_type not in kinds:
        robot_type = (contract.robot or {}).get("type", contract.robot_type)  # a robot's name may be no type
        options = f"--robot.type={robot_type} --brain.type=learned --brain.path={quoted(path)}"
        command = f"bhd-record {options} --task.instruction='…' --dataset.root=data/rollout"
        return ["Run it on the robot, with the robot's own options added, with:", f"  {command}"]
    text, usual = "Evaluate it with:", {}
    if task is None:
        task, found = next(name for name in tasks_for(contract.robot_type) if name != "free"), {}
        text = f"The dataset does not record its task. Evaluate it in simulation at {task!r}, for example, with:"
    elif task in TaskConfig.get_known_choices():
        chosen = TaskConfig.get_choice_class(task)
        usual = asdict(chosen())
        if (name := module_to_name(chosen)) == "__main__":
            text = f"Its task {task!r} is defined in this script. Move it to a module, and evaluate it with:"
            module = " --task.discover_packages_path=MODULE"
        elif name is not None:
            text = f"Evaluate it, where Python finds the module {name!r} (in this folder with PYTHONPATH=.), with:"
            module = f" --task.discover_packages_path={name}"
    else:
        text = f"Its task {task!r} is of a plug-in that is not installed. Evaluate it, with the plug-in's module, with:"
        usual = dict.fromkeys(key for key in found if key != "type")
        module = " --task.discover_packages_path=MODULE"
    if policy is not None and (name := module_to_name(type(policy))) is not None:
        module += f" --brain.discover_packages_path={'MODULE' if name == '__main__' else name}"
    brain = "type=language --brain.perception.path" if kind == "bhd_perception" else "path"
    robot, default = contract.robot or {}, vars(kinds[contract.robot_type]())
    off = {name: False for name in LEFT_OUT_IF_OFF if robot and name not in robot and default.get(name) is True}
    options = _options("robot", {**robot, **off}, default)
    command = (
        f"bhd-eval{module} --robot.type={contract.robot_type}{options} --task.type={task}"
        f"{_options('task', found, usual)} --brain.{brain}={quoted(path)}"
    )
    return [text, f"  {command}"]


def _options(name: str, values: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """Return the options that make a configuration have these values, each with a space before it."""
    options = ""
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(usual.get(key), Mapping):
            options += _options(f"{name}.{key}", value, usual[key])
        elif isinstance(value, str | bool | int | float | list) and key in usual and value != usual[key]:
            options += f" --{name}.{key}={shlex.quote(value if isinstance(value, str) else json.dumps(value))}"
    return options
