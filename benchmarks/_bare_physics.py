"""The physics and the scans of an environment's run again, with nothing around them.

What a step of the physics costs depends on what touches what. So an environment is run once, all that it asks of its
world is written down, and that is done again in a loop: the same wheel speeds, physics steps and scans, of the same
robots in the same arenas. Only steps and scans are timed. Both worlds end in the same state, to the last bit.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bhd_lerobot.control.kernels import plain_python
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation

STEP, SCAN, PLACE, RESET = range(4)
Entry = tuple[Any, ...]


def write_down(task: str, actions: np.ndarray, frames: int) -> tuple[list[Entry], np.ndarray]:
    """Run an environment; return what it asked of its world, and the state that the world ended in.

    Args:
        task: the environment's name.
        actions: shape (rows, n, 2), used again and again.
        frames: how many.
    """
    n = actions.shape[1]
    env = BhdVectorEnv(n, task, autoreset_mode="SameStep")
    simulation = env.episodes.simulation
    world, lidar = simulation.world, simulation.lidar  # type: ignore[attr-defined]
    log: list[Entry] = []

    def noted(what: int, call: Callable[..., Any], *, has_speeds: bool = False) -> Callable[..., Any]:
        def noting(*args: Any, **hooks: Any) -> Any:  # what is called between steps is no physics
            given = tuple(arg.copy() if isinstance(arg, np.ndarray) else arg for arg in args)
            log.append((what, world.ctrl.copy(), *given) if has_speeds else (what, *given))
            return call(*args, **hooks)

        return noting

    world.step = noted(STEP, world.step, has_speeds=True)
    world.place, world.reset = noted(PLACE, world.place), noted(RESET, world.reset)
    scan = lidar.scan
    lidar.scan = lambda rngs, ids: (log.append((SCAN, ids.copy())), scan(rngs, ids))[1]
    env.reset(seed=0)
    with plain_python():  # in compiled frames no steps are asked for one by one
        for frame in range(frames):
            env.step(actions[frame % len(actions)])
    state = world.qpos.copy()
    env.close()
    return log, state


def again(log: list[Entry], state: np.ndarray) -> float:
    """Do all of it again; return how long the steps and the scans took [s].

    Raises:
        AssertionError: the world did not end where it did.
    """
    n = len(state)
    simulation = Simulation(TurtleBot3Config(), n)
    world, lidar = simulation.world, simulation.lidar
    rngs = [np.random.default_rng(i) for i in range(n)]
    took = 0.0
    for entry in log:
        if entry[0] == PLACE:
            world.place(*entry[1:])
        elif entry[0] == RESET:
            world.reset(*entry[1:])
        else:
            started = time.perf_counter()
            if entry[0] == STEP:
                world.ctrl[:] = entry[1]
                world.step(*entry[2:])
            else:
                lidar.scan(rngs, entry[1])
            took += time.perf_counter() - started
    if not np.array_equal(world.qpos, state):
        raise AssertionError("The same steps led to another state; the two cannot be compared.")
    return took
