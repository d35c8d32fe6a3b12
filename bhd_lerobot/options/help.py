"""What the options of a configuration class mean, from docstrings and comments: for `--help` and the reference."""

import dataclasses
import inspect
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bhd_lerobot.options.declared import declaration_of
from bhd_lerobot.options.parse import choices_of, entries_of, options_of, valid_names

_INDENT = 26  # [characters] where meanings begin
# What LeRobot's own classes say nowhere; where a class says it, that counts.
_OF_LEROBOT = {
    "episodes": "numbers of the episodes to use; by default all",
    "tfs": "random changes of images, by name",
    "revision": "branch, tag or commit on the Hub; by default LeRobot's version tag",
    "use_imagenet_stats": "normalise images by ImageNet's statistics",
    "video_backend": "which library decodes videos",
    "streaming": "read frames from the Hub while training, without a download",
    "env": "the environment in which the policy is evaluated while it is trained.",
    "policy": "the policy.",
    "reward_model": "a reward model to train instead of a policy",
    "job_name": "name of the run in reports; by default made of the policy's type",
    "batch_size": "frames, or chunks of frames, in a training step",
    "prefetch_factor": "batches that each worker of the loader prepares",
    "persistent_workers": "keep the loader's workers between epochs",
    "steps": "total number of training steps",
    "log_freq": "steps between two lines of the log",
    "tolerance_s": "by how much timestamps may differ from frame_index / fps [s]",
    "save_checkpoint": "write checkpoints",
    "use_policy_training_preset": "use the policy's own optimizer and scheduler",
    "optimizer": "the optimizer.",
    "scheduler": "the schedule of the learning rate.",
    "n_episodes": "episodes of an evaluation",
    "enable": "report to Weights & Biases",
    "project": "its project",
    "entity": "its user or team",
    "notes": "notes stored with the run",
    "run_id": "continue the run with this id",
    "peft": "parameter-efficient fine-tuning, LoRA for example; by default all parameters are trained",
    "checkpoint_path": "set when a run is resumed",
}
_TYPES = {"str": "TEXT", "Path": "PATH", "bool": "true|false", "int": "N", "float": "X", "dict": "{…}", "list": "[…]"}


def summary_of(config_class: type) -> str:
    """Return the first paragraph of a class's docstring; empty if it has the one that `dataclass` makes."""
    if (config_class.__doc__ or "").startswith(f"{config_class.__name__}("):
        return ""
    return inspect.cleandoc(config_class.__doc__ or "").partition("\n\n")[0].replace("``", "`")


def meanings_of(config_class: type) -> dict[str, str]:
    """Return what each field means, by name, as far as the class or one of its bases says so."""
    result = dict(_OF_LEROBOT)
    for one in reversed(config_class.__mro__):
        if not dataclasses.is_dataclass(one):
            continue
        is_ours = one.__module__.startswith("bhd_lerobot.")
        result |= ({} if is_ours else _comments(one)) | _described(inspect.cleandoc(one.__doc__ or ""))
    return {name: " ".join(text.replace("``", "`").split()) for name, text in result.items()}


def _described(docstring: str) -> dict[str, str]:
    result: dict[str, str] = {}
    section = re.search(r"^(?:Attributes|Args|Arguments):\n((?:[ ]+.*\n?|\n)*)", docstring, re.MULTILINE)
    name = ""
    for line in textwrap.dedent(section[1]).splitlines() if section else ():
        if start := re.match(r"(\w+)(?: \(.*\))?: (.*)", line):
            name = start[1]
            result[name] = start[2]
        elif line.strip() and name:
            result[name] += f" {line.strip()}"
    return result


def _comments(config_class: type) -> dict[str, str]:
    result: dict[str, str] = {}
    above: list[str] = []
    try:
        lines = inspect.getsource(config_class).splitlines()
    except (OSError, TypeError):  # made without a file
        return result
    for line in lines:
        if comment := re.fullmatch(r"    #\s?(.*)", line):
            above.append(comment[1])
        elif found := re.match(r"    (\w+)\s*:[^#]*(?:#\s*(.*))?$", line):
            text = " ".join([*above, found[2] or ""]).strip()
            if text:
                result[found[1]] = f"{re.split(r'[.] (?=[A-Z])', text)[0].rstrip('.')}."  # the rest is for developers
            above = []
        else:
            above = []
    return result


def type_word(kind: Any) -> str:
    """Return what stands for a value of a type in the help."""
    arguments = [one for one in typing.get_args(kind) if one is not type(None)]
    origin = typing.get_origin(kind)
    if origin in (list, tuple, dict):
        return _TYPES["dict" if origin is dict else "list"]
    if arguments:
        return "|".join(dict.fromkeys(repr(one) if isinstance(one, str) else type_word(one) for one in arguments))
    return _TYPES.get(getattr(kind, "__name__", ""), "VALUE")


def help_of(config_class: type, chosen: Mapping[str, str], shipped: Sequence[str] = ()) -> str:
    """Return the help of a program: its options in groups, but only those of the types that were chosen, by option."""
    width = max(60, min(120, shutil.get_terminal_size((120, 24)).columns))
    lines = textwrap.wrap(summary_of(config_class), width)
    lines += ["", "Options are written --key=value, or nested in a YAML file: --config_path=FILE.", ""]
    if shipped:
        names = f"--config_path=NAME takes a file that comes with the package: {', '.join(shipped)}."
        lines += [*textwrap.wrap(names, width), ""]
    return "\n".join([*lines, *_lines(config_class, "", "", chosen, width)])


def _lines(config_class: type, prefix: str, title: str, chosen: Mapping[str, str], width: int) -> Iterator[str]:
    meanings = meanings_of(config_class)
    inner: list[tuple[type, str, str]] = []
    if title:
        yield from ("", *textwrap.wrap(title, width))
    for name, kind, default in options_of(config_class):
        key, meaning = f"{prefix}{name}", meanings.get(name, "")
        entry = entries_of(kind)
        if choices := choices_of(entry or kind):
            option = f"{key}.NAME.type" if entry else f"{key}.type"
            picked = {given: type_name for given, type_name in chosen.items() if _is(given, option)}
            is_taken = getattr(config_class, "taken", {}).get(name, bool)
            valid = ", ".join(valid_names(entry or kind, is_taken))
            if set(picked.values()) - choices.keys():
                choices = choices_of(entry or kind, of_lerobot=True)
            known = {given: type_name for given, type_name in picked.items() if type_name in choices}
            more = "" if known else f" Its options: --{option}=TYPE --help"
            yield from _entry(f"--{option}=TYPE", f"{meaning} Valid: {valid}.{more}".strip(), width)
            for given, type_name in known.items():
                group = choices[type_name]
                inner.append(
                    (
                        group,
                        f"{given.removesuffix('type')}",
                        f"{given}={type_name}: {summary_of(group)}".removesuffix(" "),
                    )
                )
        elif dataclasses.is_dataclass(kind):
            group = typing.cast(type, kind)
            inner.append((group, f"{key}.", f"{key}: {meaning or summary_of(group)}"))
        else:
            shown = "required" if default is dataclasses.MISSING else f"default: {_short(default)}"
            valid = "; ".join(filter(None, (declaration_of(config_class, name), shown)))
            yield from _entry(f"--{key}={type_word(kind)}", f"{meaning} ({valid})".strip(), width)
    for group, inner_prefix, heading in inner:
        yield from _lines(group, inner_prefix, heading, chosen, width)


def _is(given: str, option: str) -> bool:
    return re.fullmatch(re.escape(option).replace("NAME", r"\w+"), given) is not None


def _short(value: Any) -> str:
    plain = {None: "none", True: "true", False: "false", "": "not set"}
    text = plain.get(value, str(value)) if isinstance(value, str | bool | None) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}…"


def _entry(option: str, meaning: str, width: int) -> Iterator[str]:
    left = f"  {option}"
    wrapped = textwrap.wrap(meaning, width - _INDENT)
    if len(left) >= _INDENT:
        yield left
        left = ""
    for line in wrapped or [""]:
        yield f"{left:<{_INDENT}}{line}".rstrip()
        left = ""
