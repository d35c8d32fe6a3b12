"""How late a robot follows its commands, by what was recorded of it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episodes
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.errors import ConfigError

_MOST_S, _STEP_S = 1.0, 0.01
_LEAST_CHANGE = 1e-3  # of a command: one that changes less shows nothing
_BETTER = 0.5  # of the error of the worst lag: the best explains twice as much
_MARGIN = 1.25  # of the proposal

Array = NDArray[np.float64]


def following_latency(times: Array, commands: Array, observed: Array) -> float | None:
    """Return after how long what is observed follows commands, arrays of shape (n,) [s]; None if it is not seen."""
    if len(times) < 3 or np.ptp(commands) < _LEAST_CHANGE or np.ptp(observed) < _LEAST_CHANGE:
        return None
    lags = np.arange(0.0, _MOST_S + _STEP_S, _STEP_S)
    at = times[None] - lags[:, None]  # before the first frame the first command held
    errors = ((np.interp(at, times, commands) - observed) ** 2).mean(axis=1)
    best = int(errors.argmin())
    return float(lags[best]) if errors[best] < _BETTER * errors.max() else None


def describe_following(root: Path) -> str:
    """Return how late the robot of a dataset follows its commands, and which option that is, as text."""
    state = load_state(root)
    features = state.info["features"]
    vectors = {
        key: list((features.get(key) or {}).get("names") or ()) for key in (keys.APPLIED_ACTION, keys.OBSERVATION_STATE)
    }
    commanded, observed = vectors.values()
    found: list[float] = []
    for episode in read_episodes(root, range(len(state.rows))):
        for name in [name for name in commanded if name in observed]:
            times = np.asarray(episode[keys.TIME], np.float64).reshape(-1)
            command, reading = (
                np.asarray(episode[key], np.float64).reshape(len(times), -1)[:, names.index(name)]
                for key, names in vectors.items()
            )
            late = following_latency(times, command, reading)
            found += [] if late is None else [late]
    if not found:
        raise ConfigError(
            f"{root} does not show how late its robot follows: no number of {keys.APPLIED_ACTION} changes and is "
            f"followed by that of its name in {keys.OBSERVATION_STATE}. Record it while it speeds up and slows down."
        )
    late, most = float(np.median(found)), max(found)
    return (
        f"The robot of {root} follows its commands after {late:.2f} s, {most:.2f} s at the most ({len(found)} numbers "
        f"in all episodes). If it is on a ROS 2 network: --robot.ros2.latency_s={max(_MARGIN * most, 0.05):.2f}"
    )
