"""Any brain as a LeRobot teleoperator, so that the stock command lines can be driven by it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Rates
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.commands import BrainCommand, Chunk, CommandResult, Goals
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures, is_privileged
from bhd_lerobot.registry import ROBOTS, action_names_of, brains_for, drives, make_brain
from bhd_lerobot.robots.robot import BhdRobot, connected_robots
from bhd_lerobot.teleoperators.config_bhd_brain import BhdBrainConfig
from bhd_lerobot.teleoperators.plain import PlainTeleoperator, TeleoperatorConfigError


class GoalStreamer:
    """Plans goals as the cerebellum does, and hands out where the reference is at the end of every frame.

    LeRobot's `Robot` takes setpoints only; a brain that gives goals drives it through this.

    Args:
        body: the robot, with an arm.
        rates: the rates.
        start: the robot's command now, joint angles [rad] and the gripper's opening [m] first, shape (width,).
    """

    def __init__(self, body: Body, rates: Rates, start: NDArray[np.float64]) -> None:
        self._rates = rates
        self._controller = ArmController(body, 1, rates.control_hz, rates.ticks_per_frame)
        self._reading = PlantReading(1, self._controller.joints, states=self._controller.states)
        self._reading.position[0] = start[: self._controller.joints]
        self._controller.configure(np.zeros(1, np.intp), self._reading)

    def frame(
        self, commands: Sequence[BrainCommand], measured: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], list[CommandResult]]:
        """Plan one frame.

        Args:
            commands: new goals.
            measured: where the joints are now, those of the arm first, shape (joints,).

        Returns:
            The arm's reference at the end of the frame, shape (joints of the arm,), and the goals that ended or were
            refused.
        """
        controller, reading = self._controller, self._reading
        refused = [refusal for command in commands if (refusal := controller.submit(0, command)) is not None]
        # Within the frame nothing is measured: the arm is taken to follow the reference from where it is.
        behind = measured[: controller.joints] - controller.command[0]
        for _ in range(self._rates.ticks_per_frame):
            reading.velocity[0] = controller.velocity[0]
            reading.position[0] = controller.command[0] + behind
            controller.advance()
        # A refusal is among the results, too, unless another goal has its name.
        ended = controller.take_results(0)
        return controller.command[0].copy(), [name for name in refused if name not in ended] + ended


class BhdBrain(PlainTeleoperator):
    """A brain in place of a person: its actions follow from what the robot in this process last observed.

    LeRobot asks a teleoperator for actions and shows it nothing; this one observes the simulated robot that is
    connected in the same process.

    Args:
        config: the configuration.
    """

    config_class = BhdBrainConfig
    name = "bhd_brain"

    def __init__(self, config: BhdBrainConfig) -> None:
        super().__init__(config)
        self.config = config
        self._is_connected = False
        self._brain: Brain | None = None
        self._host: Any = None  # of the robot that it drives
        self._streamer: GoalStreamer | None = None
        self._chunk: list[NDArray[np.float64]] = []
        self._results: list[CommandResult] = []

    @property
    def action_features(self) -> dict[str, type]:
        """The actions that it gives: those of the robot that it drives, if that is connected already."""
        names = action_names_of(self.config.brain)
        robots = connected_robots()
        if len(robots) == 1 and drives(self.config.brain, robots[0].config):
            names = robots[0].action_names
        return dict.fromkeys(names, float)

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._is_connected

    def connect(self, calibrate: bool = True) -> None:
        """Get ready; the robot may be connected later.

        Raises:
            DeviceAlreadyConnectedError: it is connected.
        """
        self.check_new()
        self._is_connected = True

    def get_action(self) -> dict[str, Any]:
        """Return what the brain wants, given the robot's last observation.

        Raises:
            DeviceNotConnectedError: `connect` was not called.
            TeleoperatorConfigError: there is no robot to drive, several and `robot_id` does not choose, or one that the
                brain does not drive.
        """
        self.check_connected()
        try:
            return self._next_action()
        except ConfigError as error:
            raise TeleoperatorConfigError(str(error)) from error

    def _next_action(self) -> dict[str, Any]:
        robot = self._find_robot()
        if robot.host is not self._host or self._brain is None:
            self._forget()
            if not drives(self.config.brain, robot.config):
                is_arm = robot.host.body.arm is not None and robot.host.body.drive is None
                example = " For example: --teleop.brain.type=reach --robot.scene=reach." if is_arm else ""
                raise ConfigError(
                    f"The brain {self._brain_name!r} does not drive a {robot.name}. Choose one that does by "
                    f"--teleop.brain.type: {', '.join(brains_for(robot.config))}.{example}"
                )
            self._brain = make_brain(self.config.brain)
            names, _ = robot.environment
            fps = self.config.fps or robot.config.fps
            body, cameras = robot.host.body, robot.camera_shapes
            self._brain.bind(RobotFeatures(robot.observation_names, robot.action_names, fps, names, body, cameras))
            self._brain.reset(np.zeros(1, np.intp), [self.config.seed], 1, [robot.instruction])
            self._host, self._results, self._chunk = robot.host, [], []
        seen = robot.last_observation
        state = np.array([[seen[name] for name in robot.observation_names]])
        images = {name: seen[name][None] for name in robot.camera_shapes}
        names, reported = robot.environment
        environment = reported[None] if is_privileged(self._brain, names) else None
        observation = Observation(robot.observation_names, state, images, environment, {0: self._results})
        wanted = self._brain.act(observation)
        if isinstance(wanted, Goals):
            action, self._results = self._stream(robot, wanted)
        else:
            action = self._next_of_chunk(wanted) if wanted is None or isinstance(wanted, Chunk) else wanted[0]
        return dict(zip(robot.action_names, action.tolist(), strict=True))

    def _next_of_chunk(self, wanted: Chunk | None) -> NDArray[np.float64]:
        """Return what a chunk asks for over the coming frame; when it is used up, its last."""
        if wanted is not None:
            self._chunk = list(wanted.actions[:, 0])
        if not self._chunk:
            raise ConfigError(f"The brain {self._brain_name!r} gave neither an action nor a chunk of them.")
        return self._chunk.pop(0) if len(self._chunk) > 1 else self._chunk[0]

    def _stream(self, robot: BhdRobot, goals: Goals) -> tuple[NDArray[np.float64], list[CommandResult]]:
        """Return the setpoint that goals mean for the coming frame, and the goals that ended."""
        body, rates = robot.host.body, robot.host.rates
        if body.arm is None or body.arm.actuation != "position":
            raise ConfigError(
                f"The brain {self._brain_name!r} gives goals; {robot} takes none. Use an arm with "
                "robot.control = servo."
            )
        if goals.setpoints is not None and 0 in goals.streamed:
            self._streamer = None  # the next goal begins where this leads to
            return goals.setpoints[0], []
        state = robot.host.bridge.state()
        if self._streamer is None:
            self._streamer = GoalStreamer(body, rates, state.command[0])
        reference, results = self._streamer.frame(goals.commands.get(0, ()), state.joint_positions[0])
        command = np.zeros((1, len(body.limits.names)))  # a base stands meanwhile
        command[0, : len(reference)] = reference
        return robot.host.to_action(command)[0], results

    def disconnect(self) -> None:
        """Forget the robot. May be called twice."""
        self._is_connected = False
        self._forget()

    def _forget(self) -> None:
        if self._brain is not None:
            self._brain.close()
        self._brain = self._host = self._streamer = None

    @property
    def _brain_name(self) -> str:
        return self.config.brain.get_choice_name(type(self.config.brain))

    def _find_robot(self) -> BhdRobot:
        robots = connected_robots()
        if self.config.robot_id is not None:
            robots = [robot for robot in robots if robot.id == self.config.robot_id]
            if not robots:
                names = [str(robot.id) for robot in connected_robots()]
                raise ConfigError(unknown_name("teleop.robot_id", self.config.robot_id, names))
        if len(robots) != 1:
            found = ", ".join(str(robot) for robot in robots) or "none"
            raise ConfigError(
                f"bhd_brain drives one simulated robot of its own process; connected are: {found}. Use --robot.type="
                f"{' or '.join(sorted(ROBOTS))}, and --teleop.robot_id if there are several."
            )
        return robots[0]
