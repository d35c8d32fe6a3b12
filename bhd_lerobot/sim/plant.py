"""The joints of a world, as the cerebellum sees them."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Drive
from bhd_lerobot.errors import SimulationError
from bhd_lerobot.sim.world import World


class JointReading(Protocol):
    """What `SimulatedPlant.read` fills: any object with these three arrays, each of shape (n, joints)."""

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]
    has_effort: bool


MODES_WITH_MOTION = (2, 3, 4)  # `Mode.HOLD`, `TRACKING`, `STOPPING` of the cerebellum
_MOST_VIEWS = 8  # readings that are remembered
_CLOSING_S = 1.0  # [s] for which a brake only damps: what was pressed springs back
_CREEP = 0.001  # [rad/s] a joint that slips slower than this feels less than the slip torque
_Array = NDArray[np.float64]
_Views = tuple[_Array, _Array, _Array, list[tuple[_Array, _Array, _Array]]]


class SimulatedPlant:
    """Reads the joints of all simulations and writes their servos' commands.

    It has the calls of the cerebellum's plant and needs none of its code. A base's joints are its wheels, and their
    servos take speeds [rad/s]. An arm's are those of its chain [rad], whose servos take angles [rad] or torques [N m],
    and its gripper, whose position, speed and command are those of the opening, the sum of its two fingers [m].

    Args:
        world: the simulations.
    """

    takes = "actuators"
    latency_s, hint = 0.0, ""

    def __init__(self, world: World) -> None:
        self.n = world.n
        body, efforts = world.body, world.efforts
        self._fingers: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        arm = body.arm
        if arm is not None:
            joints, names = arm.chain.joints, arm.actuators
            positions, velocities = world.joint_slice(arm.gripper.joints)
            self._fingers = world.qpos[:, positions], world.qvel[:, velocities]
            self._grip = efforts[:, velocities.start]  # the force of their one actuator acts on each of them
        else:
            drive = body.need(Drive)
            joints, names = drive.joints, drive.actuators
        positions, velocities = world.joint_slice(joints)
        self._position, self._velocity = world.qpos[:, positions], world.qvel[:, velocities]
        self._effort = efforts[:, velocities]
        actuators = [world.model.actuator(name).id for name in names]
        if actuators != list(range(actuators[0], actuators[0] + len(actuators))):
            raise SimulationError(f"Actuators {list(names)} are not neighbours in the model.")
        self._ctrl = world.ctrl[:, actuators[0] : actuators[-1] + 1]
        self._brakes = _Brakes(world, arm) if arm is not None and arm.brake_damping else None
        # The views into the readings that are used, with the readings, which must live as long as their numbers count.
        self._views: dict[int, tuple[JointReading, _Views]] = {}

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
        position, velocity, effort, sums = entry[1]
        position[:] = self._position
        velocity[:] = self._velocity
        effort[:] = self._effort
        if self._fingers is not None:
            out.effort[:, -1] = self._grip
        for one, other, to in sums:
            np.add(one, other, out=to)

    def _bind(self, out: JointReading) -> "_Views":
        """Make the views into a reading once, not at every tick."""
        if self._fingers is None:
            return out.position, out.velocity, out.effort, []
        both = zip(self._fingers, (out.position, out.velocity), strict=True)
        sums = [(fingers[:, 0], fingers[:, 1], to[:, -1]) for fingers, to in both]
        return out.position[:, :-1], out.velocity[:, :-1], out.effort[:, :-1], sums

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the servos' commands, shape (n, joints)."""
        self._ctrl[:] = ctrl
        if self._brakes is not None:
            self._brakes.run()

    def open(self) -> None:
        """Connect to nothing."""

    def enable(self) -> None:
        """Switch nothing on."""

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the robots' modes, shape (n,): brakes are open in those with motion."""
        if self._brakes is not None:
            self._brakes.close(~np.isin(mode, MODES_WITH_MOTION))

    def recover(self) -> bool:
        """Return that no robot has moved by itself."""
        return False

    def close(self) -> None:
        """Disconnect from nothing."""


class _Brakes:
    """The brakes of n arms: dampers that work without any sensor's help, and after a while also friction."""

    def __init__(self, world: World, arm: Arm) -> None:
        brakes = [world.model.actuator(f"{joint}_brake").id for joint in arm.chain.joints]
        self._ctrl = world.ctrl[:, brakes[0] : brakes[-1] + 1]
        self._velocity = world.qvel[:, world.joint_slice(arm.chain.joints)[1]]
        self._friction = np.asarray(arm.brake_slip) / np.asarray(arm.brake_damping)  # [rad/s]
        self._closed, self._ticks = np.zeros(world.n, np.bool_), np.zeros(world.n, np.int64)
        self._closing_ticks = round(_CLOSING_S * world.body.control_hz)

    def close(self, mask: NDArray[np.bool_]) -> None:
        """Close the brakes in `mask`, shape (n,), and open the others."""
        self._ticks[~(mask & self._closed)] = 0
        self._closed[:], self._ctrl[:] = mask, mask[:, None]

    def run(self) -> None:
        """Advance by one tick."""
        self._ticks += self._closed
        held = self._ticks > self._closing_ticks
        if held.any():
            friction = self._friction / np.maximum(np.abs(self._velocity), _CREEP)
            np.copyto(self._ctrl, 1.0 + friction, where=held[:, None])
