"""What the tests of the environments share."""

from typing import Any

import numpy as np

from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.envs.register import ENVIRONMENTS

NAMES = tuple(ENVIRONMENTS)


def short(name: str, **overrides: Any) -> dict[str, Any]:
    """Return arguments of an environment with short episodes; an arm's is randomised, with noise and latency."""
    if name.startswith("UR5"):
        return {"task": {"duration_s": 1.0, "randomisation": {"enabled": True}}, **overrides}
    hold = {"hold_s": 0.5} if "Navigate" in name else {}
    return {"robot": {"beams": 36}, "task": {"duration_s": 0.8 if "Manipulation" in name else 2.0, **hold}, **overrides}


def some_actions(name: str, frames: int, n: int = 1, seed: int = 0) -> np.ndarray:
    """Return random actions that end some episodes early, shape (frames, n, a), of single precision."""
    rng = np.random.default_rng(seed)
    if name.startswith("UR5"):
        home = np.array(ur5().arm.home)
        actions = home + rng.uniform(-0.2, 0.2, (frames, n, len(home)))
    else:
        held = turtlebot3_manipulation().arm.home if "Manipulation" in name else ()
        actions = np.array([*held, 0.22, 0.0]) + rng.uniform(-0.2, 0.2, (frames, n, len(held) + 2))
    return actions.astype(np.float32)


def assert_same(first: Any, second: Any, where: str = "") -> None:
    """Assert that two nested results are equal to the last bit, types included."""
    assert type(first) is type(second), where
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, tuple):
        assert len(first) == len(second), where
        for index, (one, other) in enumerate(zip(first, second, strict=True)):
            assert_same(one, other, f"{where}/{index}")
    elif isinstance(first, np.ndarray) and first.dtype == object:
        assert_same(tuple(first), tuple(second), where)
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype, where
        np.testing.assert_array_equal(first, second, err_msg=where)
    else:
        assert first == second, where
