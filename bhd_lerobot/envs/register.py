"""The environments' names, and their registration with Gymnasium.

Importing this module registers them, also as the part of an id before its colon:
``gymnasium.make("bhd_lerobot.envs.register:bhd_lerobot/UR5Reach-v0")``. It imports nothing heavy.
"""

from gymnasium.envs.registration import register as gymnasium_register
from gymnasium.envs.registration import registry

from bhd_lerobot.options.registry import Registry

NAMESPACE = "bhd_lerobot"

ENVIRONMENTS = Registry(
    "environment",
    {
        "TurtleBot3Avoid-v0": ("turtlebot3", "avoid"),
        "TurtleBot3Navigate-v0": ("turtlebot3", "navigate"),
        "UR5Reach-v0": ("ur5", "reach"),
        "UR5Pick-v0": ("ur5", "pick"),
        "TurtleBot3ManipulationFetch-v0": ("turtlebot3_manipulation", "fetch"),
    },
)
"""The types of the robot and of the task of each environment."""


def register_environment(name: str, robot: str, task: str) -> None:
    """Register an environment with Gymnasium, as `bhd_lerobot/<name>`; one that is there already stays.

    Args:
        name: its name, such as ``RoverCorridor-v0``.
        robot: type of the robot.
        task: type of the task.

    Raises:
        ConfigError: there is an environment of this name with another robot or task.
    """
    ENVIRONMENTS.register(name, (robot, task))
    full = f"{NAMESPACE}/{name}"
    if full not in registry:
        # No time limit here: the task knows when an episode's time is over.
        gymnasium_register(
            id=full,
            entry_point="bhd_lerobot.envs.gym_env:BhdEnv",
            vector_entry_point="bhd_lerobot.envs.vector:BhdVectorEnv",
            kwargs={"environment": name},
        )


def register() -> None:
    """Register every environment with Gymnasium, as `bhd_lerobot/<name>`; those that are there already stay."""
    for name, (robot, task) in ENVIRONMENTS.items():
        register_environment(name, robot, task)


register()
