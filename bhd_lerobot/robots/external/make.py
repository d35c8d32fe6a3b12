"""Makes and connects a robot that is not ours."""

import contextlib
from typing import Any

from bhd_lerobot.errors import ConfigError, RealtimeError, as_text
from bhd_lerobot.options.parse import types_of
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.host import LeRobotHost
from bhd_lerobot.robots.external.lock import RobotLock


def make_external(config: Any, fps: int, gate: GateConfig) -> LeRobotHost:
    """Return the robot that a configuration of LeRobot, or of a plug-in, describes; connected.

    Raises:
        ConfigError: it cannot be made.
        RealtimeError: it cannot be connected.
    """
    from bhd_lerobot.stock import make_robot_from_config

    try:
        robot = make_robot_from_config(config)
    except Exception as error:  # of another package's code
        raise ConfigError(
            f"robot.type is {types_of(config)}, which cannot be made: {as_text(error.__cause__ or error)}."
        ) from error
    with contextlib.ExitStack() as undo:
        lock = RobotLock(config)
        undo.callback(lock.close)
        try:
            # What cannot be recorded is found out before the robot is touched.
            host = LeRobotHost(robot, fps, gate, lock, config)
            undo.callback(host.close)
            robot.connect()
        except (ConfigError, RealtimeError):
            raise
        except Exception as error:  # of another package's code
            with contextlib.suppress(Exception):  # what it has connected before it failed
                robot.disconnect()
            raise RealtimeError(
                f"The robot {config.type!r} cannot be connected: {as_text(error)}. Check its power, its cable and "
                "robot.port, and that no other program uses it."
            ) from error
        undo.pop_all()
    return host
