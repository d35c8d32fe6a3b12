"""From a YAML file and command-line overrides to a checked configuration.

LeRobot's own parser stops at the first unknown key with a list of every option there is. Here the message names the
key, the nearest one that exists, and the valid ones on that level.
"""

import copy
import dataclasses
import json
import keyword
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import draccus
import yaml

from bhd_lerobot.errors import BhdError, ConfigError, unknown_name
from bhd_lerobot.options.declared import check_option, declared_types
from bhd_lerobot.options.plugins import load_lerobot, names_of_lerobot
from bhd_lerobot.options.shipped import found_config
from bhd_lerobot.options.unique_keys import UniqueKeys

CONFIG_PATH = "config_path"
RUN_CONFIG = "config.yaml"
"""What the configuration of a run is called in its folder."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a mapping of a JSON file; raise if it has a key twice."""
    keys = [key for key, _ in pairs]
    for key in (key for key in keys if keys.count(key) > 1):
        raise ValueError(f"the key {key!r} occurs twice in a mapping; leave one of them")
    return dict(pairs)


@dataclasses.dataclass
class CommandLine:
    """What a command line says, read once.

    Attributes:
        options: values, by the full names of their options; without `config_path`.
        path: what `config_path` names: a file, or the folder of a run, which holds one.
    """

    options: dict[str, Any]
    path: Path | None = None

    @cached_property
    def file(self) -> dict[str, Any]:
        """What the file holds; nothing if none is named."""
        if self.path is None:
            return {}
        inside = self.path / RUN_CONFIG
        return read_file(inside if inside.is_file() else self.path)

    def over(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return nested values, those of the file for example, with the options in their place."""
        result = copy.deepcopy(dict(values))

        def wholes(option: tuple[str, Any]) -> int:
            return sum(option[0].startswith(f"{other}.") for other in self.options)

        for name, value in sorted(self.options.items(), key=wholes):  # a whole before its parts, wherever it stands
            *keys, last = name.split(".")
            inner: Any = result
            for key in keys:
                if inner.get(key) is None:  # as in the file of a run, which has every option
                    inner[key] = {}
                inner = inner[key]
                if not isinstance(inner, dict):
                    raise ConfigError(
                        f"Option --{name} sets a key of {key!r}, which is {inner!r}. If that is its type, write it "
                        "as a key, too: type."
                    )
            inner[last] = value
        return result


def read_line(arguments: Sequence[str] | CommandLine, command: str = "") -> CommandLine:
    """Return what a command line says: ``--config_path=FILE``, ``--a.b=value`` or ``--a.b value``; values are YAML.

    Args:
        command: whose configurations `--config_path` can name, too; see `shipped`.
    """
    if isinstance(arguments, CommandLine):
        return arguments
    options: dict[str, Any] = {}
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if not argument.startswith("--"):
            raise ConfigError(f"Unexpected argument {argument!r}; options are written --key=value.")
        key, sign, text = argument[2:].partition("=")
        if not sign:
            if not rest or rest[0].startswith("--"):
                raise ConfigError(f"Option --{key} has no value; write --{key}=value.")
            text = rest.pop(0)
        if key in options:
            raise ConfigError(f"Option --{key} was given twice.")
        try:
            options[key] = text if key == CONFIG_PATH else yaml.load(text, UniqueKeys)
        except (yaml.YAMLError, ValueError) as error:
            raise ConfigError(f"The value of --{key}, {text!r}, cannot be read: {error}") from error
    text = options.pop(CONFIG_PATH, None)
    path = None if text is None else Path(text).expanduser()
    return CommandLine(options, found_config(path, command) if path is not None and command else path)


def parse[T](config_class: type[T], arguments: Sequence[str] | CommandLine) -> T:
    """Return the configuration that a command line describes."""
    line = read_line(arguments)
    return decode(config_class, line.over(line.file))


def decode[T](config_class: type[T], values: dict[str, Any], prefix: str = "") -> T:
    """Return the configuration that plain values, nested, stand for.

    Args:
        values: by the names of its fields; values with an exponent and entries that are nothing are replaced.
        prefix: what stands before the fields' names in messages, ``"robot."``, for example.
    """
    _check_keys(config_class, values, prefix)
    try:
        return draccus.decode(config_class, values)
    except ConfigError:
        raise
    except Exception as error:  # draccus raises DecodingError, ValueError, TypeError and what our checks raise in it
        own = _own_error(error)
        reason = " ".join(str(own or _cause(error)).split())
        raise ConfigError(reason if own else f"The configuration cannot be used: {reason}") from error


def from_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments, with configurations, paths and tuples among them, as a file would hold them."""
    return {name: _plain(value) for name, value in options.items()}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return draccus.encode(value)
    if isinstance(value, Mapping):
        return from_options(value)
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def encode(config: Any) -> dict[str, Any]:
    """Return a configuration as plain values, with every default filled in: what `parse` would read back."""
    plain: dict[str, Any] = json.loads(json.dumps(draccus.encode(config)))  # draccus leaves enumerations inside
    return plain


def read_file(path: Path) -> dict[str, Any]:
    """Return what a YAML or JSON file holds."""
    is_json = path.suffix == ".json"  # JSON's 1e-05 is text in YAML
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text, object_pairs_hook=_unique) if is_json else yaml.load(text, UniqueKeys)
    except OSError as error:
        raise ConfigError(
            f"The configuration {str(path)!r} cannot be read: {error.strerror}. Give --config_path a YAML or JSON file."
        ) from error
    except (yaml.YAMLError, ValueError) as error:
        kind = "JSON" if is_json else "YAML"
        raise ConfigError(f"{path} is not a {kind} file: {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        found = "nothing" if values is None else type(values).__name__
        raise ConfigError(f"{path} must hold keys and values at its top level, found {found}.")
    return values


def _check_keys(config_class: type, values: dict[str, Any], prefix: str, *others: str) -> None:
    """Raise unless all options exist; `others` are valid, too, and none of the class's own."""
    fields = {name: (kind, default) for name, kind, default in options_of(config_class)}
    taken = getattr(config_class, "taken", {})
    for old, new in getattr(config_class, "renamed", {}).items():
        if old in values and new not in values:
            values[new] = values.pop(old)
    for key, value in values.items():
        if key not in fields and (ours := getattr(config_class, "of_lerobot", {}).get(key)):
            raise ConfigError(f"{prefix}{key} is an option of LeRobot's command. Here: {ours}.")
        if key not in fields and (why := getattr(config_class, "removed", {}).get(key)):
            raise ConfigError(f"The option {prefix}{key} was removed: {why}. Leave it out.")
        if key not in fields:
            valid = [f"{prefix}{name}" for name in (*others, *fields)] + ([] if prefix else [CONFIG_PATH])
            inner = [
                f"{prefix}{name}.{key}"
                for name, (kind, _) in fields.items()
                if dataclasses.is_dataclass(kind)
                and not choices_of(kind)
                and key in {one for one, *_ in options_of(typing.cast(type, kind))}
            ]
            raise ConfigError(unknown_name("option", f"{prefix}{key}", valid, *inner[:1]))
        kind, default = fields[key]
        of_default = isinstance(value, dict) and "type" not in value and isinstance(default, draccus.ChoiceRegistry)
        given = {"type": default.get_choice_name(type(default)), **value} if of_default else value
        values[key] = _checked(f"{prefix}{key}", given, kind, taken.get(key, bool))
        check_option(f"{prefix}{key}", values[key], declared_types(config_class)[key])
    for name, kind, default in options_of(config_class):
        if default is dataclasses.MISSING and name not in values:
            if dataclasses.is_dataclass(kind) and not choices_of(kind):
                _check_keys(typing.cast(type, kind), {}, f"{prefix}{name}.")  # names what is missing in it
            choice = f".type, one of {', '.join(valid_names(kind, taken.get(name, bool)))}" if choices_of(kind) else ""
            raise ConfigError(f"The option {prefix}{name} is required; set --{prefix}{name}{choice}.")


def _checked(key: str, value: Any, kind: Any, is_taken: Callable[[type], bool] = bool) -> Any:
    """Return the value of an option whose keys, if it has any, all exist; messages name types that are taken."""
    choices, entries = choices_of(kind), entries_of(kind)
    if choices and isinstance(value, str):  # short for its type: robot="ur5"
        value = {"type": value}
    if entries is not None and isinstance(value, dict):
        # Nothing in the place of an entry takes it out: a command line can drop what a file names.
        present = {name: entry for name, entry in value.items() if entry is not None}
        _check_keys(_keyed(present, entries), present, f"{key}.")
        return present
    if choices and isinstance(value, dict):
        chosen = value.get("type")
        if chosen is None:
            given = f"; given: {', '.join(f'{key}.{name}' for name in value)}" if value else ""
            raise ConfigError(f"{key}.type is missing{given}. Valid: {', '.join(valid_names(kind, is_taken))}.")
        if chosen not in choices and chosen in valid_names(kind):
            choices = choices_of(kind, of_lerobot=True)
        if chosen not in choices:
            unknown = unknown_name(f"{key}.type", chosen, valid_names(kind, is_taken))
            raise ConfigError(
                f"{unknown} To use one that your module registers: --{key}.discover_packages_path=MODULE."
            )
        fields = {k: v for k, v in value.items() if k != "type"}
        _check_keys(choices[chosen], fields, f"{key}.", "type")
        return {"type": chosen, **fields}
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        _check_keys(typing.cast(type, kind), value, f"{key}.")
        return value
    if choices and value is None and _allows_none(kind):
        return None
    if entries is not None or dataclasses.is_dataclass(kind) or choices:
        name = ".NAME" if entries is not None else ""
        first = "type" if entries is not None or choices else options_of(typing.cast(type, kind))[0][0]
        raise ConfigError(f"{key} is {value!r}; it has keys of its own, such as {key}{name}.{first}.")
    return _checked_value(key, value, kind)


def _checked_value(key: str, value: Any, kind: Any) -> Any:
    """Return the value, or refuse one of another type: converting silently would turn fps: 10.5 into 10."""
    allowed = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    if float in allowed and isinstance(value, str) and _EXPONENT.fullmatch(value):
        return float(value)  # YAML takes 1e-6 for text: it wants a point in it
    for one in allowed:
        if typing.get_origin(one) is list and not isinstance(value, list):
            continue
        if typing.get_origin(one) is list and typing.get_args(one)[0] in (int, float, bool):
            return [_checked_value(f"{key}[{i}]", item, typing.get_args(one)[0]) for i, item in enumerate(value)]
        if one not in _PLAIN:
            return value  # enumerations and other lists: the decoder checks them
        if isinstance(value, _PLAIN[one]) and (one is bool or not isinstance(value, bool)):
            return value
    separator = ", or " if any(typing.get_origin(one) is list for one in allowed) else " or "
    is_text = str in allowed and isinstance(value, int | float)
    quotes = f" Text that reads as something else has quotes of its own: --{key}='\"{value}\"'." if is_text else ""
    raise ConfigError(f"{key} is {value!r}; it must be {separator.join(map(_named, allowed))}.{quotes}")


def _named(kind: Any) -> str:
    if typing.get_origin(kind) is list:
        inner = typing.get_args(kind)[0]
        return f"a list of {_PLURALS.get(inner) or _named(inner)} in brackets, such as [a, b]"
    return _WORDS.get(kind) or str(getattr(kind, "__name__", kind))


_WORDS = {int: "a whole number", float: "a number", str: "text", Path: "a path", bool: "true or false"} | {
    type(None): "null"
}
_PLURALS = {int: "whole numbers", float: "numbers", str: "texts", Path: "paths"}
_EXPONENT = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")
_PLAIN: dict[Any, tuple[type, ...]] = {
    float: (int, float),
    int: (int,),
    str: (str,),
    Path: (str,),
    bool: (bool,),
    type(None): (type(None),),
}


def options_of(config_class: type) -> list[tuple[str, Any, Any]]:
    """Return name, type and default of each field; the default is MISSING where there is none."""
    hints = typing.get_type_hints(config_class)
    result = []
    for field in dataclasses.fields(config_class):
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        result.append((field.name, hints[field.name], default))
    return result


def entries_of(kind: Any) -> Any:
    """Return the choice type of the entries of a mapping from names to choices, or None if it is none."""
    arguments = typing.get_args(kind) if typing.get_origin(kind) is dict else ()
    return arguments[1] if len(arguments) == 2 and choices_of(arguments[1]) else None


def _keyed(names: Iterable[Any], kind: Any) -> type:
    """Return a class with a field for each name: what a mapping from these names has to hold."""
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
            raise ConfigError(f"{name!r} is not a valid name: names consist of letters, digits and underscores.")
    return dataclasses.make_dataclass("Entries", [(name, kind) for name in names])


def _allows_none(kind: Any) -> bool:
    return type(None) in typing.get_args(kind)


def choices_of(kind: Any, *, of_lerobot: bool = False) -> dict[str, type]:
    """Return the registered classes of a choice type, or of one that may be None; empty if it is none.

    Args:
        of_lerobot: import what LeRobot itself has to choose from; done for a type without choices.
    """
    kind = _without_none(kind)
    if not (isinstance(kind, type) and issubclass(kind, draccus.ChoiceRegistry)):
        return {}
    known = kind.get_known_choices()
    if of_lerobot or not known:
        load_lerobot(getattr(kind, "lerobot_package", kind.__module__))
        known = kind.get_known_choices()
    return known


def types_of(config: Any) -> str:
    """Return the names that a registered configuration may be chosen by, as text: LeRobot has several for some."""
    return " or ".join(repr(name) for name, kind in config.get_known_choices().items() if kind is type(config))


def valid_names(kind: Any, is_taken: Callable[[type], bool] = bool) -> list[str]:
    """Return what may be chosen of a choice type, LeRobot's own included, which are not imported.

    Args:
        is_taken: whether a class may be chosen; it gets `object` for one that is not imported.
    """
    kind = _without_none(kind)
    known = choices_of(kind)
    names = {*known, *names_of_lerobot(getattr(kind, "lerobot_package", kind.__module__))}
    return sorted(name for name in names if is_taken(known.get(name, object)))


def _without_none(kind: Any) -> Any:
    return typing.get_args(kind)[0] if _allows_none(kind) and len(typing.get_args(kind)) == 2 else kind


def _cause(error: BaseException) -> BaseException:
    """Return what reports why a class could not be made; draccus only states that it could not."""
    while error.__cause__ is not None and "Couldn't instantiate" in str(error):
        error = error.__cause__
    return error


def _own_error(error: BaseException | None) -> BhdError | None:
    while error is not None:
        if isinstance(error, BhdError):
            return error
        error = error.__cause__ or error.__context__
    return None
