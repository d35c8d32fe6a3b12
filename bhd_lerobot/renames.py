"""What was renamed or removed since version 0.1: one table, for command lines, configuration files and datasets.

A configuration or a command line with an old name is refused, with every new name in one message. In the metadata of
datasets the old names stay, and are read as the new ones.
"""

from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

from bhd_lerobot.errors import ConfigError

TYPES: dict[str, str] = {"corrected": "dagger"}
"""Values of `type`, in configurations and in the metadata of datasets: old to new."""

KEYS: dict[str, str] = {
    "anchor": "PPO has no term that holds the actor near its checkpoint; a smaller ppo.lr or ppo.target_kl does",
    "start_action": "an actor that starts from a checkpoint takes the first action of its chunk",
}
"""Keys of configurations by their full names, in which `*` stands for anything: old to the new last part.

A sentence, recognised by the space in it, says what replaces a removed key.
"""

OPTIONS: dict[str, str] = {
    "push --replace_card": "a README.md beside the dataset is sent as its card; an edited card there is kept otherwise",
    "import --resample": "bags of bhd-data export are resampled always; --robot=turtlebot3 reads one as a real robot's",
}
"""Options of `bhd-data`, each after its command: old to a new option, or to a sentence."""


def check_values(values: Mapping[str, Any]) -> None:
    """Refuse a configuration with names of version 0.1.

    Args:
        values: nested plain values, by key.

    Raises:
        ConfigError: lists every old name with the new one.
    """
    _refuse(list(_in_values(values, "")))


def check_options(command: str, options: Sequence[str]) -> None:
    """Refuse options of `bhd-data` that version 0.1 had.

    Args:
        command: of `bhd-data`.
        options: those that it does not know, as they were typed.

    Raises:
        ConfigError: lists every old option with the new one, or with what takes its place.
    """
    typed = [option.partition("=")[0] for option in options]
    found = [(option, OPTIONS.get(f"{command} {option.replace('-', '_').replace('__', '--', 1)}")) for option in typed]
    _refuse([_line(old, new) for old, new in found if new is not None])


def present(recorded: Any) -> Any:
    """Return metadata of a dataset, as plain values, with the present names of what was renamed."""
    if isinstance(recorded, Mapping):
        values = {key: present(value) for key, value in recorded.items()}
        if isinstance(values.get("type"), str):
            values["type"] = TYPES.get(values["type"], values["type"])
        return values
    return [present(value) for value in recorded] if isinstance(recorded, list) else recorded


def _in_values(values: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for key, value in values.items():
        name = f"{prefix}{key}"
        for old, new in KEYS.items():
            if fnmatchcase(name, old):
                yield _line(name, new if " " in new else f"{prefix}{new}")
        if isinstance(value, Mapping):
            yield from _in_values(value, f"{name}.")
        elif key == "type" and isinstance(value, str) and value in TYPES:
            yield _line(f"{name} = {value}", TYPES[value])


def _line(old: str, new: str) -> str:
    return f"{old} was removed: {new}" if " " in new else f"{old} -> {new}"


def _refuse(lines: Sequence[str]) -> None:
    if lines:
        text = "\n  ".join(lines)
        raise ConfigError(f"Names of version 0.1 that have changed since:\n  {text}")
