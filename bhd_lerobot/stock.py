"""What of LeRobot's own programs this package uses, and what differs between LeRobot's versions.

No other module imports LeRobot's internals: they move from version to version. What LeRobot documents for plug-ins
(configurations, base classes, processor steps, constants) is imported where it is used. A name is imported when it is
first asked for.
"""

import inspect
import json
import sys
import threading
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

_MODULES = {
    "lerobot.common.train_utils": ("get_step_checkpoint_dir", "get_step_identifier", "push_checkpoint_to_hub"),
    "lerobot.common.wandb_utils": ("WandBLogger",),
    "lerobot.datasets": ("language",),
    "lerobot.datasets.compute_stats": ("compute_episode_stats",),
    "lerobot.datasets.dataset_metadata": ("CODEBASE_VERSION", "LeRobotDatasetMetadata"),
    "lerobot.datasets.feature_utils": ("get_hf_features_from_features",),
    "lerobot.datasets.io_utils": ("load_info", "load_stats", "load_tasks"),
    "lerobot.datasets.lerobot_dataset": ("LeRobotDataset",),
    "lerobot.datasets.utils": ("EPISODES_DIR", "check_version_compatibility"),
    "lerobot.datasets.video_utils": ("FrameTimestampError", "decode_video_frames"),
    "lerobot.envs": ("close_envs", "make_env", "make_env_pre_post_processors", "preprocess_observation"),
    "lerobot.optim.factory": ("make_optimizer_and_scheduler",),
    "lerobot.policies.act.modeling_act": ("ACTTemporalEnsembler",),
    "lerobot.policies.factory": ("get_policy_class", "make_policy", "make_pre_post_processors"),
    "lerobot.processor.factory": ("make_default_policy_processor_steps", "make_policy_processor_pipelines"),
    "lerobot.robots.utils": ("make_robot_from_config",),
    "lerobot.teleoperators.utils": ("make_teleoperator_from_config",),
    "lerobot.scripts.lerobot_eval": ("eval_policy", "eval_policy_all"),
    "lerobot.transforms": ("ImageTransforms",),
    "lerobot.utils": ("visualization_utils",),
    "lerobot.utils.collate": ("lerobot_collate_fn",),
    "lerobot.utils.device_utils": ("auto_select_torch_device", "is_torch_device_available"),
    "lerobot.utils.feature_utils": ("dataset_to_policy_features",),
    "lerobot.utils.import_utils": ("register_third_party_plugins",),
    "lerobot.utils.random_utils": ("load_rng_state", "save_rng_state", "seeded_context", "set_seed"),
    "lerobot.utils.rerun_visualization": ("log_rerun_data",),
    "lerobot.utils.utils": ("has_method",),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}


_DEFERRED = ("cameras", "configs", "envs", "policies", "processor", "robots", "teleoperators", "utils")
_LOCK = threading.RLock()


class _DeferredPackage(ModuleType):
    """A package whose modules can be imported, and whose own code runs when the first of its names is asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        with _LOCK:
            if not self.__dict__.setdefault("_is_executed", False):
                self._is_executed = True
                assert self.__spec__ is not None
                assert self.__spec__.loader is not None
                self.__spec__.loader.exec_module(self)
            if name in self.__dict__:
                return self.__dict__[name]
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")


def defer_packages() -> None:
    """Let programs import LeRobot's configurations without what its packages import beside them: PyTorch and pandas."""
    for name in (f"lerobot.{package}" for package in _DEFERRED):
        if name not in sys.modules and (spec := find_spec(name)) is not None:
            package = module_from_spec(spec)
            package.__class__ = _DeferredPackage
            sys.modules[name] = package
            setattr(sys.modules["lerobot"], name.removeprefix("lerobot."), package)


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(_WHERE[name])
    return getattr(module, name) if hasattr(module, name) else import_module(f"{_WHERE[name]}.{name}")


def resolve_delta_timestamps(policy: Any, meta: Any, rename_map: dict[str, str]) -> dict[str, list[float]]:
    """Return the times that a policy looks at, by the dataset's features [s].

    Version 0.6.1 goes by the dataset's names, later ones by those that the policy has for them.
    """
    resolve = import_module("lerobot.datasets.factory").resolve_delta_timestamps
    renamed = [rename_map] if "rename_map" in inspect.signature(resolve).parameters else []
    return resolve(policy, meta, *renamed) or {}


def save_checkpoint(folder: Path, step: int, config: Any, parts: Any, processes: int) -> None:
    """Write a checkpoint as LeRobot does.

    Args:
        folder: the checkpoint's.
        step: training steps that were done.
        config: of the run.
        parts: its `policy`, `optimizer`, `scheduler`, `preprocessor` and `postprocessor`.
        processes: that train together; of versions after 0.6.1, which read the batch size of the configuration, unused.
    """
    save = import_module("lerobot.common.train_utils").save_checkpoint
    given = {"num_processes": processes, "batch_size": config.batch_size}
    wanted = {name: value for name, value in given.items() if name in inspect.signature(save).parameters}
    names = ("policy", "optimizer", "scheduler", "preprocessor", "postprocessor")
    save(folder, step, config, *(getattr(parts, name) for name in names), **wanted)


def load_training_state(folder: Path, optimizer: Any, scheduler: Any) -> int:
    """Load random states, optimizer and scheduler of a checkpoint; return its step.

    Raises:
        OSError: a file is missing.
        ValueError: a file cannot be read.
    """
    optim, constants = import_module("lerobot.optim"), import_module("lerobot.utils.constants")
    states = folder / constants.TRAINING_STATE_DIR
    __getattr__("load_rng_state")(states)
    step = int(json.loads((states / constants.TRAINING_STEP).read_text(encoding="utf-8"))["step"])
    optim.load_optimizer_state(optimizer, states)
    if scheduler is not None:
        optim.load_scheduler_state(scheduler, states)
    return step
