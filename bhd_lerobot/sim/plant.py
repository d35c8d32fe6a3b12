"""The joints of a world, as the cerebellum sees them."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, GripperSpec
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import SimulationError
from bhd_lerobot.sim.world import World


class JointReading(Protocol):
    """What `SimulatedPlant.read` fills: any object with these three arrays, each of shape (n, joints)."""

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]
    has_effort: bool


_HOLD, _STOPPING = int(Mode.HOLD), int(Mode.STOPPING)  # from the one to the other there is motion
_MOST_VIEWS = 8  # readings that are remembered
_CLOSING_S = 1.0  # [s] for which a brake only damps: what was pressed springs back
_CREEP = 0.001  # [rad/s] a joint that slips slower than this feels less than the slip torque
_Array = NDArray[np.float64]
_Views = tuple[_Array, _Array, _Array]


class _Part:
    """The joints of an arm with its gripper, or the wheels, of all simulations: neighbours in the model.

    Attributes:
        width: how many joints, the gripper as one.
        ctrl: the servos' commands, live, shape (n, width).
    """

    def __init__(
        self, world: World, joints: Sequence[str], actuators: Sequence[str], gripper: GripperSpec | None
    ) -> None:
        positions, velocities = world.joint_slice(joints)
        efforts, self._joints = world.efforts, len(joints)
        self._position, self._velocity = world.qpos[:, positions], world.qvel[:, velocities]
        self._effort = efforts[:, velocities]
        self._fingers: list[tuple[_Array, _Array, float]] = []
        if gripper is not None:
            places = world.joint_places(gripper.joints)
            self._fingers = [
                (world.qpos[:, at], world.qvel[:, dof], one)
                for at, dof, one in zip(*places, gripper.per_joint, strict=True)
            ]
            self._offset = gripper.offset
            self._grip = efforts[:, places[1][0]]  # the force of their one actuator acts on each of them
        servos = [world.model.actuator(name).id for name in actuators]
        if servos != list(range(servos[0], servos[0] + len(servos))):
            raise SimulationError(f"Actuators {list(actuators)} are not neighbours in the model.")
        self.width = len(servos)
        self.ctrl = world.ctrl[:, servos[0] : servos[-1] + 1]

    def read(self, position: _Array, velocity: _Array, effort: _Array) -> None:
        """Write what is read of them, each of shape (n, width)."""
        dof = self._joints
        if not self._fingers:
            position[:], velocity[:], effort[:] = self._position, self._velocity, self._effort
            return
        position[:, :dof], velocity[:, :dof], effort[:, :dof] = self._position, self._velocity, self._effort
        first, speed, per_joint = self._fingers[0]
        effort[:, dof] = self._grip / per_joint
        opening, rate = first * per_joint, speed * per_joint
        for first, speed, per_joint in self._fingers[1:]:
            opening += first * per_joint
            rate += speed * per_joint
        position[:, dof] = opening + self._offset
        velocity[:, dof] = rate


class SimulatedPlant:
    """Reads the joints of all simulations and writes their servos' commands.

    It has the calls of the cerebellum's plant. An arm's joints are those of its chain [rad], whose servos take angles
    [rad] or torques [N m], and its gripper, whose position, speed and command are those of the opening, the sum of its
    two fingers [m]. A base's are its wheels, and their servos take speeds [rad/s].

    Attributes:
        brakes: of arms with torque motors; None of others.

    Args:
        world: the simulations.
    """

    takes = "actuators"
    latency_s, hint = 0.0, ""

    def __init__(self, world: World) -> None:
        self.n = world.n
        body = world.body
        self._parts: list[_Part] = []
        if body.arm is not None:
            self._parts.append(_Part(world, body.arm.chain.joints, body.arm.actuators, body.arm.gripper))
        if body.drive is not None:
            self._parts.append(_Part(world, body.drive.joints, body.drive.actuators, None))
        arm = body.arm
        self.brakes = Brakes(world, arm) if arm is not None and arm.brake_damping else None
        # The views into the readings that are used, with the readings, which must live as long as their numbers count.
        self._views: dict[int, tuple[JointReading, list[_Views]]] = {}

    def read(self, out: JointReading) -> None:
        """Write the joints' positions, velocities and efforts, each of shape (n, joints), into `out`.

        The efforts are means over the physics steps of the last `World.step`: see `World.efforts`.
        """
        entry = self._views.get(id(out))
        if entry is None:
            if len(self._views) >= _MOST_VIEWS:
                self._views.clear()
            entry = self._views[id(out)] = out, self._bind(out)
            out.has_effort = True
        for part, views in zip(self._parts, entry[1], strict=True):
            part.read(*views)

    def _bind(self, out: JointReading) -> "list[_Views]":
        """Make the views into a reading once, not at every tick."""
        views, first = [], 0
        for part in self._parts:
            columns = slice(first, first := first + part.width)
            views.append((out.position[:, columns], out.velocity[:, columns], out.effort[:, columns]))
        return views

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the servos' commands, shape (n, joints)."""
        first = 0
        for part in self._parts:
            part.ctrl[:] = ctrl[:, first : first + part.width]
            first += part.width
        if self.brakes is not None:
            self.brakes.run()

    def open(self) -> None:
        """Connect to nothing."""

    def enable(self) -> None:
        """Switch nothing on."""

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the robots' modes, shape (n,): brakes are open in those with motion."""
        if self.brakes is not None:
            self.brakes.set_mode(mode)

    def recover(self) -> bool:
        """Return that no robot has moved by itself."""
        return False

    def close(self) -> None:
        """Disconnect from nothing."""


class Brakes:
    """The brakes of n arms: dampers that work without any sensor's help, and after a while also friction.

    Attributes:
        ticks: for how many ticks each is closed, shape (n,); -1 if it is open.
        friction: slip torque by damping [rad/s], shape (joints,).
        closing_ticks: ticks for which a brake only damps: what was pressed springs back.
    """

    def __init__(self, world: World, arm: Arm) -> None:
        brakes = [world.model.actuator(f"{joint}_brake").id for joint in arm.chain.joints]
        self.first = brakes[0]
        self._ctrl = world.ctrl[:, brakes[0] : brakes[-1] + 1]
        self._velocity = world.qvel[:, world.joint_slice(arm.chain.joints)[1]]
        self.friction = np.asarray(arm.brake_slip) / np.asarray(arm.brake_damping)
        self.ticks: NDArray[np.int64] = np.full(world.n, -1, np.int64)
        self.closing_ticks = round(_CLOSING_S * world.body.control_hz)

    def set_mode(self, modes: NDArray[np.int8]) -> None:
        """Close the brakes in modes without motion, and open the others; `modes` has shape (n,)."""
        for sim, mode in enumerate(modes.tolist()):
            set_brake(self.ticks, sim, mode)
        self._ctrl[:] = self.ticks[:, None] >= 0  # also of robots that nothing is written to yet

    def run(self) -> None:
        """Advance by one tick."""
        for sim in range(len(self.ticks)):
            run_brake(self.ticks, self._ctrl[sim], self._velocity[sim], sim, self.friction, self.closing_ticks)


@kernel()
def set_brake(ticks: NDArray[np.int64], sim: int, mode: int) -> None:
    """Close the brake of an arm in a mode without motion, and open it in others."""
    ticks[sim] = -1 if _HOLD <= mode <= _STOPPING else max(ticks[sim], 0)


@kernel()
def run_brake(  # noqa: PLR0917
    ticks: NDArray[np.int64], ctrl: _Array, speed: _Array, sim: int, friction: _Array, closing_ticks: int
) -> None:
    """Advance the brake of an arm by one tick; whoever put the arm somewhere else may have written to its command."""
    is_closed = ticks[sim] >= 0
    ticks[sim] += is_closed
    for k in range(len(ctrl)):
        ctrl[k] = is_closed
        if ticks[sim] > closing_ticks:
            ctrl[k] += friction[k] / max(abs(speed[k]), _CREEP)
