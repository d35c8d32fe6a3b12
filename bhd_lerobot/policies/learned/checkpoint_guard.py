"""What a checkpoint may ask for before LeRobot loads it.

A checkpoint is data that was downloaded or handed over. LeRobot imports whatever object a processor step names and
calls it with arguments from the same file, `subprocess.Popen` as readily as a normaliser.
"""

import importlib
import json
from collections.abc import Callable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.plugins import PREFIXES
from bhd_lerobot.policies.learned.checkpoint import CONFIG_FILE

PROCESSOR_FILES = (f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json")
"""The files of a checkpoint that name processor steps."""

# Some of LeRobot's policies and steps load a further model by name and run the code that lies beside it
# (trust_remote_code). These are the keys that hold such names, and the names that LeRobot itself has there.
_POLICIES_WITH_CODE = ("gaussian_actor", "groot", "pi0_fast", "wall_x")
_CODE_KEYS = (
    "action_tokenizer_name",
    "action_tokenizer_path",
    "base_model_id",
    "base_model_path",
    "model_name",
    "paligemma_tokenizer_name",
    "text_tokenizer_name",
    "vision_encoder_name",
    "vlm_name",
)
_TRUSTED_MODELS = (
    "google/paligemma-3b-pt-224",
    "lerobot/fast-action-tokenizer",
    "lerobot/resnet10",
    "nvidia/Cosmos-Reason2-2B",
    "nvidia/GR00T-N1.7-3B",
    "physical-intelligence/fast",
)
_BEWARE = "Do not use the checkpoint unless you know who made it."


def plugin_packages() -> set[str]:
    """Return the packages whose classes a checkpoint may name: LeRobot, this one, and installed plug-ins of LeRobot."""
    names = {str(distribution.metadata["Name"] or "") for distribution in metadata.distributions()}
    return {"lerobot", "bhd_lerobot"} | {name for name in names if name.startswith(PREFIXES)}


def check_checkpoint(folder: Path) -> None:
    """Check that loading a checkpoint runs no code but LeRobot's, this package's and that of installed plug-ins."""
    config = _read(folder / CONFIG_FILE)
    kind = config.get("type")
    if kind in PreTrainedConfig.get_known_choices():
        _register_steps(PreTrainedConfig.get_choice_class(kind))
    if kind in _POLICIES_WITH_CODE:
        _check_models(folder / CONFIG_FILE, config)
    allowed = cache(plugin_packages)  # reads about every installed distribution
    for file in (folder / name for name in PROCESSOR_FILES):
        if not file.exists() and not file.is_symlink():
            continue
        steps = _read(file).get("steps")
        if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
            raise ConfigError(f"{file} has no list of processor steps. Copy the checkpoint again.")
        for step in steps:
            _check_step(file, step, allowed)


def _register_steps(config_class: type) -> None:
    """Import the module in which a policy registers steps of its own, by LeRobot's convention."""
    module = config_class.__module__.replace("configuration_", "processor_")
    try:
        importlib.import_module(module)
    except ImportError:  # it has none, or needs a package that is not installed; loading states which
        return


def _check_step(file: Path, step: dict[str, Any], allowed: Callable[[], set[str]]) -> None:
    # As in LeRobot, where "registry_name" is there "class" is not looked at.
    is_registered = "registry_name" in step
    name = step.get("registry_name" if is_registered else "class")
    found = _registered(name) if is_registered else _class(name, allowed)
    if not (isinstance(found, type) and issubclass(found, ProcessorStep)):
        packages = ", ".join(sorted(allowed()))
        raise ConfigError(
            f"{file} asks for the processor step {name!r}, which is not loaded: it would run code of the checkpoint's "
            f"choice. Allowed are registered steps, and processor steps of {packages}. {_BEWARE} Put a step of your "
            "own into an installed package lerobot_policy_…, decorated with ProcessorStepRegistry.register()."
        )
    state = step.get("state_file")
    if state is not None and (not isinstance(state, str) or Path(state).name != state or state in ("", "..")):
        raise ConfigError(
            f"{file} names the state file {state!r} for the processor step {name!r}; it must be the name of a file in "
            f"the checkpoint's folder. {_BEWARE}"
        )
    options = step.get("config", {})
    if not isinstance(options, dict):
        raise ConfigError(f"{file} has {options!r} as the configuration of {name!r}; it must be an object.")
    _check_models(file, options)
    if options.get("pretrained_path") is not None:  # a reward classifier, which loads an encoder by name
        raise ConfigError(f"{file} has {name!r} load another model, {options['pretrained_path']!r}. {_BEWARE}")


def _registered(name: Any) -> Any:
    return ProcessorStepRegistry.get(name) if name in ProcessorStepRegistry.list() else None


def _class(path: Any, allowed: Callable[[], set[str]]) -> Any:
    """Return the class of a dotted name; None if it is not of an allowed package.

    A module of an allowed package may have imported the class from elsewhere, so it is the class that is asked.
    """
    parts = path.split(".") if isinstance(path, str) else []
    if len(parts) < 2 or parts[0] not in allowed() or not all(part.isidentifier() for part in parts):
        return None
    try:
        found = getattr(importlib.import_module(".".join(parts[:-1])), parts[-1], None)
    except Exception:  # whatever that module needs and does not find
        return None
    return found if getattr(found, "__module__", "").partition(".")[0] in allowed() else None


def _check_models(file: Path, options: dict[str, Any]) -> None:
    for key in _CODE_KEYS:
        name = options.get(key)
        if name is not None and name not in _TRUSTED_MODELS:
            raise ConfigError(
                f"{file} names the model {name!r} as {key}; LeRobot runs the code that lies beside such a model. "
                f"Allowed are {', '.join(_TRUSTED_MODELS)}. {_BEWARE} If you do, LeRobot's own commands load it."
            )


def _read(file: Path) -> dict[str, Any]:
    try:
        if not file.is_file():
            raise OSError("it is not a file")
        values = json.loads(file.read_text())  # in the encoding of the locale, so that it reads what LeRobot reads
        if not isinstance(values, dict):
            raise ValueError("it is not a JSON object")
        return values
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{file} cannot be read ({error}). Copy the checkpoint again.") from error
