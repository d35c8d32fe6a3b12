"""The environments' names, and their registration with Gymnasium.

Importing this module registers them, also as the part of an id before its colon:
``gymnasium.make("bhd_lerobot.envs.register:bhd_lerobot/UR5Reach-v0")``. It imports nothing heavy.
"""

from gymnasium.envs.registration import register as register_environment
from gymnasium.envs.registration import registry

NAMESPACE = "bhd_lerobot"

# name -> type of the robot, type of the task
ENVIRONMENTS: dict[str, tuple[str, str]] = {
    "TurtleBot3Avoid-v0": ("turtlebot3", "avoid"),
    "TurtleBot3Navigate-v0": ("turtlebot3", "navigate"),
    "UR5Reach-v0": ("ur5", "reach"),
    "UR5Pick-v0": ("ur5", "pick"),
}
"""Robot and task of each environment, by its name."""


def register() -> None:
    """Register every environment with Gymnasium, as `bhd_lerobot/<name>`; those that are there already stay."""
    for name in ENVIRONMENTS:
        full = f"{NAMESPACE}/{name}"
        if full not in registry:
            # No time limit here: the task knows when an episode's time is over.
            register_environment(
                id=full,
                entry_point="bhd_lerobot.envs.gym_env:BhdEnv",
                vector_entry_point="bhd_lerobot.envs.vector:BhdVectorEnv",
                kwargs={"environment": name},
            )


register()
