"""What the critic is told and the actor is not."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit
from bhd_lerobot.envs.stage import Stage


def privileged_state(stage: Stage) -> NDArray[np.float32]:
    """Return what the simulator, the task and the cerebellum know beyond the observation, shape (n, k).

    Returns:
        Of each simulation `Simulation.privileged_state`, `Task.privileged_state`, and whether the cerebellum kept the
        robot from an obstacle in the last frame: the flag CLEARANCE, which the collision monitor sets.
    """
    kept = (stage.limits & Limit.CLEARANCE) != 0
    parts = stage.simulation.privileged_state(), stage.task.privileged_state(), kept[:, None]
    return np.concatenate(parts, axis=1, dtype=np.float32)
