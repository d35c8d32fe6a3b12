"""Which package may import which."""

from pathlib import Path

PACKAGE = "bhd_lerobot"
ROOT = Path(__file__).resolve().parents[1]

# package -> what it may import of ours, besides itself and errors: the files of a package without its subpackages
# ("control"), with them ("control.*"), or one module ("bodies.body").
EVERYTHING = ("*",)
_TASKS = ("options", "bodies", "control", "control.geometry")
_DATASETS = ("datasets.format", "datasets.storage")
ARROWS: dict[str, tuple[str, ...]] = {
    "errors": (),
    "versions": (),
    "programs": (),
    "stock": (),
    "options": (),
    "bodies": ("options",),
    "sim": (
        *("versions", "bodies"),
        *("control", "control.geometry", "control.tick", "control.cerebellum"),
    ),
    "sim.files": ("bodies", "control", "control.geometry", "sim"),
    "control": ("bodies.body",),
    "control.geometry": ("versions", "bodies.body", "control"),
    "control.motion": ("versions", "bodies.body", "control", "control.geometry"),
    "control.arm": ("bodies.body", "control", "control.geometry", "control.motion"),
    "control.tick": ("control", "control.arm"),
    "control.cerebellum": ("bodies.body", "control", "control.tick"),
    "control.bridge": ("bodies.body", "control", "control.cerebellum"),
    "realtime": ("bodies.body", "control.*"),
    "tasks": _TASKS,
    "robots.host": (
        *("bodies.body", "bodies.scenes", "bodies.tabletop", "bodies.truth", "robots.parts"),
        *("sim", "control.*", "realtime", "datasets.format", "ros2.live.network", "programs"),
    ),
    "robots.parts": ("bodies.body", "bodies.arenas", "bodies.tabletop", "sim", "control.*"),
    "robots.viewer": ("programs", "bodies.scenes", "realtime", "robots.host", "sim.window"),
    "robots.external": ("realtime", "options", "bodies.body", "control", "datasets.format", "robots.host"),
    "robots.device": ("programs", "options", "bodies.body", "control", "control.geometry", "robots.external"),
    "robots": (
        "options",
        "realtime",
        "tasks",
        "bodies",
        "sim.*",
        "control.*",
        "robots.host",
        "robots.parts",
        "ros2.live.network",
    ),
    "registry": ("options", "bodies", "tasks", "robots.*", "policies.*", "ros2.robots.config_robot"),
    "envs": ("registry", "tasks", "bodies", "sim", "robots.*", "options"),
    "policies": (*_TASKS, "datasets.format.features"),
    "policies.mlp": ("control.geometry", "policies"),
    "policies.cnn": ("bodies", "policies", "policies.mlp"),
    "policies.learned": (
        "__version__",
        "options",
        "control",
        "datasets.storage",
        "datasets.format.features",
        "policies",
        "policies.mlp",
    ),
    "policies.navigation": ("bodies", "policies"),
    "policies.manipulation": (*_TASKS, "policies", "policies.navigation"),
    "policies.perception": ("bodies", "policies", "policies.learned", "policies.manipulation"),
    "policies.pixels": ("bodies", "policies", "policies.learned", "policies.mlp", "policies.perception"),
    "policies.language": (*_TASKS, "policies", "policies.manipulation", "policies.perception"),
    "policies.teleop": (*_TASKS, "policies", "policies.manipulation"),
    "policies.topic": (*_TASKS, "policies", "ros2.live", "ros2.messages"),
    "policies.dagger": (*_TASKS, "policies", "policies.manipulation", "policies.navigation"),
    "datasets.storage": (),
    "datasets.format": ("datasets.storage",),
    "datasets.assembly": _DATASETS,
    "datasets.edit": ("options", *_DATASETS, "datasets.assembly", "bodies", "tasks"),
    "datasets.validate": (*_DATASETS, "control.geometry"),
    "datasets.recovery": (*_DATASETS, "datasets.assembly", "datasets.validate", "tasks"),
    "datasets.writer": ("programs", *_DATASETS, "datasets.assembly", "datasets.recovery"),
    "datasets.remote": (*_DATASETS, "datasets.assembly"),
    "datasets.loader": (*_DATASETS, "datasets.remote", "tasks"),
    "datasets.timing": ("realtime", *_DATASETS, "control"),
    "ros2.messages": ("options.unique_keys", "bodies", "control", "control.geometry", "datasets.format"),
    "ros2.live": ("programs", "bodies", "control", "ros2.messages"),
    "ros2.robots": ("bodies", "control", "ros2.live", "ros2.messages"),
    "ros2.serve": (
        *("bodies", "control", "control.geometry", "policies", "policies.navigation"),
        *("robots", "robots.host", "robots.viewer", "ros2.live", "ros2.messages"),
        *("recording", "sim.description"),
    ),
    "ros2.bag.storage": ("datasets.storage", "ros2.messages"),
    "ros2.bag.recorder": ("datasets.storage", "ros2.live", "ros2.messages", "ros2.bag.storage"),
    "ros2.bag.player": ("ros2.live", "ros2.messages", "ros2.bag.storage"),
    "ros2.bag.exporter": (*_DATASETS, "datasets.edit", "ros2.messages", "ros2.bag.storage"),
    "ros2.bag.importer": (
        *("tasks", "bodies", "control", "datasets.format", "datasets.writer"),
        *("ros2.messages", "ros2.bag.storage"),
    ),
    "rollout": (
        *("__version__", "options", "tasks", "bodies", "sim", "control", "realtime", "policies"),
        *("robots.host", "robots.external", *_DATASETS, "datasets.writer"),
    ),
    "rollout.replay": (
        *("options", "registry", "bodies", "control", "realtime", "robots.host", "robots.external"),
        *(*_DATASETS, "rollout"),
    ),
    "hub": ("bodies", *_DATASETS, "datasets.remote", "rollout", "rollout.replay"),
    "cluster": ("registry", "tasks", "control", "robots.host", "policies.*", "datasets.format", "rollout"),
    "recording": (
        *("options", "registry", "tasks", "bodies", "control", "realtime"),
        *("robots.host", "robots.external", "robots.viewer"),
        *("policies", "policies.teleop", "policies.topic", *_DATASETS, "datasets.writer"),
        *("rollout", "teleoperators", "hub", "cluster"),
    ),
    "evaluation": (
        "realtime",
        *("tasks", "control", "robots.external", "robots.host", "robots.viewer"),
        *("policies", "policies.learned", "policies.perception", "policies.teleop"),
        "envs",  # registers our environments with LeRobot, for `--env.type`
        *("datasets.format", "datasets.timing", "datasets.writer"),
        *("options", "registry", "rollout", "cluster"),
    ),
    "teleoperators": (
        "realtime",
        *("bodies", "control", "control.geometry", "control.arm"),
        *("policies.*", "robots", "robots.parts", "registry"),
    ),
    "plugin": ("versions", "envs", "policies.*", "registry", "ros2.robots.config_robot", "teleoperators"),
    "training": (
        *("plugin", "tasks", "robots.host", "envs", "policies.*", *_DATASETS, "datasets.loader", "datasets.remote"),
        *("options", "registry", "rollout", "hub"),
    ),
    "training.rl": (
        *("registry", "plugin", "control", "tasks", "envs", "policies.*", "datasets.format", "rollout", "training"),
        "options",
    ),
    "training.dagger": (
        *("policies", "policies.dagger", "datasets.format", "datasets.storage", "datasets.edit"),
        *("options", "rollout", "recording", "evaluation", "training"),
    ),
    "apps.view": ("tasks", "bodies", "control", "control.geometry", *_DATASETS, "datasets.assembly", "datasets.edit"),
    "apps.monitor": ("control", "control.motion", "realtime", "datasets.format", "apps.view"),
    "apps.doctor": (
        *("options", "versions", "tasks", "policies", "bodies", "control", "sim", "realtime", "datasets.format"),
        "control.geometry",
    ),
    "api": (
        *("options", "registry", "tasks", "policies", "rollout.replay", "recording", "evaluation"),
        *("training", "training.rl"),
    ),
    "cli": EVERYTHING,
    "cli.data": EVERYTHING,
}
