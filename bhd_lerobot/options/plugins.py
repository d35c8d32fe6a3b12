"""Robots, tasks, brains and policies of other packages: imported before a command reads its options.

A plug-in is a distribution whose name follows LeRobot's rule (``lerobot_robot_…``, ``lerobot_policy_…``, and so on),
one with an entry point of the group `ENTRY_POINTS`, or a module that a command line names with LeRobot's own option
``--….discover_packages_path``. It registers what it has while it is imported.
"""

import contextlib
import importlib
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import ConfigError, as_text

ENTRY_POINTS = "bhd_lerobot.plugins"
"""The group of entry points; each names a module."""

PREFIXES = ("lerobot_robot_", "lerobot_camera_", "lerobot_teleoperator_", "lerobot_policy_", "lerobot_env_")
"""How the names of distributions begin that LeRobot imports."""

_CHOICES = ("lerobot.robots", "lerobot.teleoperators", "lerobot.cameras")
_OPTION = "discover_packages_path"
# This distribution, for LeRobot's commands. Ours register what they need; our environments take seconds to import.
_OURS = "lerobot_robot_bhd"
_imported: set[str] = set()


def load_plugins(report: Callable[[str], object] | None = None) -> None:
    """Import every plug-in that is installed, once; report those that fail, on standard error if None."""
    for name, reason in import_plugins():
        if reason:
            text = f"The plug-in {name} cannot be imported, and its robots, tasks and brains are missing: {reason}"
            report(text) if report else print(f"warning: {text}", file=sys.stderr)


def import_plugins() -> Iterator[tuple[str, str]]:
    """Import every plug-in that is installed and was not imported yet; yield its name, and why that failed."""
    for name, load in _installed():
        if name in _imported:
            continue
        _imported.add(name)
        reason = ""
        try:
            load()
        except Exception as error:  # whatever a module raises while it is imported
            reason = as_text(error)
        yield name, reason


def load_lerobot(module: str) -> None:
    """Import all robots, teleoperators or cameras of LeRobot, which register themselves; not those without a driver.

    Args:
        module: `lerobot.robots`, `lerobot.teleoperators`, `lerobot.cameras` or a module in one; others do nothing.
    """
    package = ".".join(module.split(".")[:2])
    if package not in _CHOICES:
        return
    for found in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        if found.ispkg:
            with contextlib.suppress(Exception):  # whatever a driver raises while it is imported
                importlib.import_module(found.name)


def names_of_lerobot(module: str) -> list[str]:
    """Return the types that `load_lerobot` would register, without importing them."""
    package = ".".join(module.split(".")[:2])
    if package not in _CHOICES:
        return []
    spec = find_spec(package)
    folders = [] if spec is None else spec.submodule_search_locations or []
    files = (path for folder in folders for path in Path(folder).glob("*/config*.py"))
    texts = (path.read_text(encoding="utf-8") for path in files)
    return sorted({name for text in texts for name in re.findall(r"register_subclass\(\s*\"(\w+)\"", text)})


def misnamed() -> list[tuple[str, str]]:
    """Return the distributions that LeRobot passes over although they look like plug-ins, and why."""
    return [
        (name, f"LeRobot expects a name with underscores, {name.replace('-', '_')!r}.")
        for name in map(_name_of, metadata.distributions())
        if name.replace("-", "_").startswith(PREFIXES) and not name.startswith(PREFIXES)
    ]


def load_named(arguments: Sequence[str]) -> list[str]:
    """Import the modules that options ``--….discover_packages_path=MODULE`` name; return the other arguments."""
    left: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        option, sign, value = argument.partition("=")
        if not option.startswith("--") or option.rpartition(".")[2].removeprefix("--") != _OPTION:
            left.append(argument)
            continue
        name = value if sign else (rest.pop(0) if rest else "")
        try:
            importlib.import_module(name)
        except Exception as error:  # whatever a module raises while it is imported, also a name that is none
            reason = as_text(error)
            here = Path(f"{name}.py").is_file() or Path(name, "__init__.py").is_file()
            remedy = (
                "Give a module that Python can find: an installed one, or one in a folder of PYTHONPATH."
                if not (isinstance(error, ModuleNotFoundError) and error.name == name and here)
                else "It is in this folder, where Python does not look: write PYTHONPATH=. before the command."
            )
            raise ConfigError(f"{option} names {name!r}, which cannot be imported: {reason}. {remedy}") from error
    return left


def module_to_name(kind: type) -> str | None:
    """Return the module that a command line has to name for a class to be known; None if it finds it by itself."""
    own = kind.__module__.partition(".")[0]
    installed = {name.partition(":")[0].partition(".")[0] for name, _ in _installed()}
    return None if own in {__name__.partition(".")[0], "lerobot", *installed} else kind.__module__


def _installed() -> list[tuple[str, Callable[[], Any]]]:
    found: dict[str, Callable[[], Any]] = {}
    for name in map(_name_of, metadata.distributions()):
        if name.startswith(PREFIXES) and name != _OURS:
            found[name] = partial(importlib.import_module, name)
    for entry in metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(entry.value, entry.load)
    return sorted(found.items(), key=lambda item: item[0])


def _name_of(distribution: metadata.Distribution) -> str:
    """Return the name of a distribution, or nothing if it is none that may be a plug-in."""
    # Python tells it from the folder's name; to read all metadata takes a tenth of a second.
    if not getattr(distribution, "_normalized_name", PREFIXES[0]).startswith(PREFIXES):
        return ""
    return str(distribution.metadata["Name"] or "")
