"""LeRobot's `Robot` over a host of one: simulated, or real behind a plant."""

import math
import weakref
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.commands import CommandResult
from bhd_lerobot.control.messages import Mode, Reason
from bhd_lerobot.errors import ActionError, CommandRefusedError, unknown_name
from bhd_lerobot.realtime.estop import POLL_S, EstopInputs, Source, check_source
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.realtime import make_live
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.parts.names import action_names, observation_names

# Robots that are connected in this process. LeRobot's recording loop hands no observation to a teleoperator: a brain
# finds its robot here. Weak, so that a forgotten robot is freed.
_connected: "weakref.WeakSet[BhdRobot]" = weakref.WeakSet()


def connected_robots() -> list["BhdRobot"]:
    """Return the robots of this package that are connected in this process."""
    return [robot for robot in _connected if robot.is_connected]


class BhdRobot(Robot):
    """A robot under a cerebellum.

    On the lockstep clock `send_action` applies an action and advances time by one frame. Two things differ from a robot
    on a table. Time stands still between two calls of `send_action`, so that a slow brain is not a late one. And
    `send_action` returns at the end of the frame, with what the cerebellum commanded by then.

    With ``clock = "realtime"`` the robot runs on the wall clock, in a process of its own: `send_action` returns at
    once, and a robot that gets no command for too long decelerates and holds.
    """

    simulation_class: ClassVar[type[Simulation]] = Simulation
    config: Any

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.config = config
        self._host: Host | None = None
        self._last_observation: dict[str, Any] | None = None
        self._results: list[CommandResult] = []
        self._estop_sources: list[tuple[Source, str, float]] = []
        self._estop_inputs: EstopInputs | None = None
        # lerobot-record asks for its length, with or without cameras.
        self.cameras: dict[str, Any] = dict.fromkeys(self.camera_shapes)

    def __str__(self) -> str:
        return self.name if self.id is None else f"{self.name} {self.id!r}"

    def make_simulation(self) -> Simulation:
        """Return a new simulation of one robot."""
        simulation: Any = self.simulation_class
        made: Simulation = simulation(self.config)
        return made

    def make_scene(self) -> Any:
        """Return where the robot is when it is used by itself."""
        return self.config.start_scene()

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's floats, in order."""
        return observation_names(self.config, self.body)

    @cached_property
    def body(self) -> Body:
        """The robot's hardware."""
        made: Body = self.config.body()
        return made

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action's floats, in order."""
        return action_names(self.config, self.body)

    @property
    def camera_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Image shapes (height, width, 3) by camera name."""
        cameras = self.body.cameras if self.config.camera else {}
        return {name: (camera.height, camera.width, 3) for name, camera in cameras.items()}

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """LeRobot's description of an observation: floats first, then images."""
        return {**dict.fromkeys(self.observation_names, float), **self.camera_shapes}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """LeRobot's description of an action."""
        return dict.fromkeys(self.action_names, float)

    @property
    def is_connected(self) -> bool:
        """Whether it runs."""
        return self._host is not None

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Start the robot, a simulated one at the start of the configured scene.

        An emergency stop that is pressed meanwhile is kept for it.

        Raises:
            DeviceAlreadyConnectedError: it runs already.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        is_live = self.config.clock == "realtime"
        inputs = self._estop_inputs = EstopInputs()
        try:
            for source in self._estop_sources:
                inputs.add(*source)
            self._host = make_live(self.simulation_class, self.config, self.id) if is_live else self.make_simulation()
            inputs.attach(self._host.estop)
            if not is_live:  # whose other process has done it
                self._host.load()  # now, and not for the first action, in the middle of an episode
            self.restart()
            for name in self.camera_shapes:
                self._host.render(0, name)
        except BaseException:
            self.disconnect()
            raise
        _connected.add(self)

    def restart(self) -> None:
        """Put a simulated robot back to the start of its scene, at rest; a real one starts from where it is."""
        host = self.host
        scene = self.make_scene()
        host.reset(np.zeros(1, np.intp), [None if host.world is None else scene], [self.config.seed])
        host.begin()

    def disconnect(self) -> None:
        """Stop the robot. May be called at any time, also twice."""
        self._stop_listening()
        if self._host is not None:
            self._host.close()
            self._host = None
        self._last_observation = None
        self._results = []
        _connected.discard(self)

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure beyond the configuration."""

    @property
    def host(self) -> Host:
        """What moves the robot: a simulation in this process, or processes on the wall clock.

        Raises:
            DeviceNotConnectedError: it does not run.
        """
        if self._host is None:
            raise DeviceNotConnectedError(f"{self} is not connected. Call connect() first.")
        return self._host

    def get_observation(self) -> dict[str, Any]:
        """Return what the robot sees now: floats in SI units, images as (height, width, 3) uint8 RGB.

        Raises:
            DeviceNotConnectedError: the robot is not connected.
        """
        host = self.host
        frame = host.latest()
        observation: dict[str, Any] = dict(zip(self.observation_names, frame.state[0].tolist(), strict=True))
        for name in self.camera_shapes:
            observation[name] = host.render(0, name)
        self._last_observation = {
            name: value.copy() if isinstance(value, np.ndarray) else value for name, value in observation.items()
        }
        return observation

    @property
    def last_observation(self) -> dict[str, Any]:
        """A copy of what `get_observation` returned last; a new observation if it was not called yet.

        Raises:
            DeviceNotConnectedError: the robot is not connected.
        """
        if self._last_observation is None:
            return self.get_observation()
        return dict(self._last_observation)

    def send_action(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Apply an action for one frame of simulated time.

        Args:
            action: a number for each action feature. The order of the keys is free, because they are names.

        Returns:
            The command at the end of the frame: the action after the limits, those of the reference for an arm and also
            that of the effort for a base.

        Raises:
            DeviceNotConnectedError: the robot is not connected.
            ActionError: a key is missing or unknown, or a value is not a finite number. Nothing happened.
            CommandRefusedError: the robot does not take commands in its present mode, after an emergency stop for
                example. Time went on by a frame all the same: a robot that is stopping continues stopping.
        """
        values = self.action_array(action)
        done = self.host.act(values)
        self._results += done.results.get(0, ())
        reason = Reason(int(done.sent.reasons[0]))
        if reason != Reason.ACCEPTED:
            words = done.refusals.get(0, reason.explanation)
            raise CommandRefusedError(
                f"The {self.name} refused the action: {words} (mode {Mode(int(done.mode[0])).name})."
            )
        return dict(zip(self.action_names, done.applied[0].tolist(), strict=True))

    def action_array(self, action: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return an action as an array of shape (1, actions), checked.

        Raises:
            ActionError: a key is missing or unknown, or a value is not a finite number.
        """
        if not isinstance(action, Mapping):
            raise ActionError(
                f"An action is a dict of feature names to numbers, got {type(action).__name__}. "
                f"Valid keys: {', '.join(self.action_names)}."
            )
        unknown = [key for key in action if key not in self.action_features]
        if unknown:
            raise ActionError(unknown_name("action key", unknown[0], self.action_names))
        missing = [key for key in self.action_names if key not in action]
        if missing:
            raise ActionError(
                f"The action lacks {', '.join(map(repr, missing))}. It needs a number for each of "
                f"{', '.join(self.action_names)}."
            )
        values = np.empty((1, len(self.action_names)))
        for column, name in enumerate(self.action_names):
            value = action[name]
            try:
                values[0, column] = float(value)
            except (TypeError, ValueError):
                raise ActionError(f"Action {name!r} is {value!r}, which is not a number.") from None
            if not math.isfinite(values[0, column]):
                raise ActionError(f"Action {name!r} is {value!r}; it must be finite.")
        return values

    @property
    def environment(self) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """Environment state of the robot's scene, beyond its own sensors: names, and values of shape (k,)."""
        return (), np.zeros(0)

    @property
    def instruction(self) -> str:
        """The instruction of the robot's scene; empty if it has none."""
        return ""

    def take_results(self) -> list[CommandResult]:
        """Return the results of goals, sent by `host.bridge`, that were not taken yet, in their order.

        Raises:
            DeviceNotConnectedError: the robot is not connected.
        """
        results = self._results + self.host.bridge.take_results()
        self._results = []
        return results

    def estop(self) -> None:
        """Latch the emergency stop: from the next tick the robot brakes as hard as it can, and refuses commands.

        Also while `connect` starts it. This is a software stop, not a certified safety function.

        Raises:
            DeviceNotConnectedError: it neither runs nor starts.
        """
        inputs = self._estop_inputs
        if self._host is None and inputs is not None:
            inputs.press("robot.estop()")
        else:
            self.host.estop()

    def add_estop_input(self, source: Source, name: str = "", period_s: float = POLL_S) -> None:
        """Let a physical button press the emergency stop while the robot is connected, now and at later times.

        Args:
            source: a file descriptor or an object with one: any byte presses, and so does its end or an error, a wire
                that is cut. Or a callable, called once a period: it presses when it returns something true, raises, or
                does not return for a second.
            name: what it is called.
            period_s: time between two calls of a callable [s].

        Raises:
            ConfigError: it is neither, the descriptor is not open, or the period is not positive.
        """
        check_source(source, period_s)
        if self._estop_inputs is not None:
            self._estop_inputs.add(source, name, period_s)
        self._estop_sources.append((source, name, period_s))

    def remove_estop_inputs(self) -> None:
        """Forget all buttons. What they have pressed stays pressed until `reset`."""
        self._stop_listening()
        self._estop_sources.clear()
        if self._host is not None:
            self._estop_inputs = EstopInputs(self._host.estop)

    def _stop_listening(self) -> None:
        if self._estop_inputs is not None:
            self._estop_inputs.close()
            self._estop_inputs = None

    def reset(self) -> None:
        """Clear an emergency stop, a fault or a deactivation. The robot moves again only after `activate`.

        Raises:
            CommandRefusedError: there is nothing to clear, or the robot is not at rest, or presses on something.
        """
        self._request(self.host.bridge.reset().reasons[0])

    def activate(self) -> None:
        """Accept actions again after `reset`.

        Raises:
            CommandRefusedError: the robot is active already, a stop is still latched, or it presses on something.
        """
        self._request(self.host.bridge.activate().reasons[0])

    def _request(self, reason: int) -> None:
        if reason != Reason.ACCEPTED:
            mode, why = Mode(int(self.host.modes[0])).name, Reason(int(reason)).explanation
            force = f"{self.host.bridge.state().pressed[0]:.0f} N, " if reason == Reason.PRESSED else ""
            raise CommandRefusedError(f"{why} ({force}mode {mode})")
