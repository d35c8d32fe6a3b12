"""The controller of arms with torque motors: a tool that behaves like a damped spring towards a commanded pose."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.arm.compliance import Compliance, critical_damping
from bhd_lerobot.control.arm.equilibrium import SPEED, TURN_SPEED, Equilibrium
from bhd_lerobot.control.arm.rotations import rotation_matrices, rotation_vectors
from bhd_lerobot.control.arm.wrench import OBSERVER_GAIN, ContactObserver
from bhd_lerobot.control.controller import SteppedController
from bhd_lerobot.control.geometry.dynamics import ArmDynamics, DynamicsTerms, product
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.guard import FULL_TORQUE_S
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

WIDTH = 8
_JOINT_DAMPING = 0.01  # [s/rad] share of a joint's largest torque that brakes it at 1 rad/s, in every posture
_FORCE_RATE, _MOMENT_RATE = 100.0, 20.0  # [N/s, N m/s] of the feed-forward wrench
_MOBILITY_DAMPING = 1e-3  # [1/kg, 1/(kg m^2)] beside about 0.1 1/kg: no direction weighs more than 1000 kg
_STILL = 0.05  # [rad/s] the joints' speed below which a hard stop is over
_STIFFENING, _TURN_STIFFENING = 5000.0, 300.0  # [N/m/s, N m/rad/s] a spring that stiffens gains energy
# From the first speed on the spring pushes less, from the second on no more, at the third the arm is stopped: shares of
# the equilibrium's largest for the tool, of their own for joints.
_FREE_PUSH = (15.0, 3.0)  # [N, N m] what a tool in free motion needs at most
_TOOL_SPEED, _JOINT_SPEED = (1.0, 1.4, 2.0), (0.7, 1.0, 1.1)
_MOST_EFFORT = 0.8  # share of a joint's largest torque that the surroundings may put on it
_GAINED = 0.8  # share of the tool's largest speed that it may gain while torques fall
# A joint that turns at this speed [rad/s] one way and the other in turns, more often than every so many seconds and the
# equilibrium, is part of a loop that swings: its readings are late.
_SWING_SPEED, _SWING_S, _MOST_SWINGS = 0.15, 0.4, 2.0
_PARTS, _TINY = (slice(3), slice(3, 6)), 1e-12
_LIGHT_N = 20.0  # [N] what presses less is no obstacle to an activation
_ROOM_RAD = 0.1  # so far from where a brake closed does the torque that carries the arm's weight follow the readings
_NORM_RANGE = (0.5, 2.0)  # a quaternion with a norm beyond this is no orientation with a rounding error


class ImpedanceController(SteppedController):
    """Tool poses and the gripper's opening, held by a spring and a damper; beside them a feed-forward wrench.

    A command is the equilibrium: the tool's position in the base frame x, y, z [m], its orientation as a quaternion
    w, x, y, z, and the gripper's opening [m]. The motors are given

        torque = J^T (K error + wrench + D (equilibrium's velocity - tool's velocity)) - joint damping + own dynamics

    with the error in the base frame, the rotation as a vector. The opening goes to the gripper's position servo. The
    equilibrium moves within limits, so that a far target does not jump; spring and feed-forward together are limited,
    and so are each motor's torque and its change.

    The feed-forward wrench is part of what is commanded: it acts while setpoints are followed, and every stop ends it.
    After a hard stop (`ESTOP`, `FAULT`) the equilibrium is where the tool is then: what was pressed is let go.

    Attributes:
        contact: the estimate of the wrench that the surroundings put on the tool.
        equilibrium: the equilibrium that moves.
        wrench: the feed-forward wrench in force, force [N] and moment [N m] in the base frame, shape (n, 6).

    Args:
        body: the robot; the actuation of its arm is ``"torque"``.
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
        max_force: a larger force between the tool and its surroundings is a protective stop [N].

    Raises:
        ConfigError: the arm does not take torques.
    """

    width = WIDTH

    def __init__(self, body: Body, n: int, control_hz: int, frame_ticks: int, max_force: float = 150.0) -> None:
        super().__init__(n)
        arm = body.need(Arm)
        if arm.actuation != "torque":
            raise ConfigError(f"The arm {body.name!r} has actuation={arm.actuation!r}; impedance needs 'torque'.")
        if not arm.brake_damping:
            raise ConfigError(f"The arm {body.name!r} has no brakes (Arm.brake_damping); impedance needs them.")
        self.arm, self.n, self._max_force = arm, n, max_force
        self.joints = len(arm.limits.names)
        self.dynamics = ArmDynamics(body)
        dof = self.dynamics.dof
        self.contact = ContactObserver(n, dof, control_hz, OBSERVER_GAIN)
        self.contact_wrench = self.contact.wrench
        opening_limits = (arm.limits.velocity[-1], arm.limits.acceleration[-1])
        self.equilibrium = Equilibrium(n, control_hz, frame_ticks, opening_limits)
        self.command, self.actuators = np.zeros((n, WIDTH)), np.zeros((n, self.joints))
        self.busy, self.protective_stop = np.zeros(n, np.bool_), np.zeros(n, np.int64)
        self.wrench: Array = np.zeros((n, 6))
        self._wanted_wrench = np.zeros((n, 6))
        self._wrench_step = np.repeat([_FORCE_RATE, _MOMENT_RATE], 3) / control_hz
        self._stiffness, self._wanted_stiffness, self._fixed_damping = (np.zeros((n, 6, 6)) for _ in range(3))
        self._ratio, self._is_fixed = np.ones(n), np.zeros(n, np.bool_)
        self._largest = np.zeros((n, 2))
        self._effort = np.asarray(arm.limits.effort[:dof])
        self._torque_rate = self._effort / FULL_TORQUE_S  # [N m/s]
        self._effort_step = self._torque_rate / control_hz
        most_stiffening = np.repeat([_STIFFENING, _TURN_STIFFENING], 3)
        self._stiffening = np.sqrt(np.outer(most_stiffening, most_stiffening)) / control_hz
        tool_speed = np.outer([SPEED, TURN_SPEED], _TOOL_SPEED)
        joint_speed = np.outer(arm.limits.velocity[:dof], _JOINT_SPEED)
        self._tool_speed, self._joint_speed = tool_speed, joint_speed  # shape (2, 3), (dof, 3)
        # An opening and positions beyond what the arm can ever reach; nearer ones are for the spring to find out.
        reach = arm.chain.reach
        self._lower = np.array([*(-reach,) * 3, arm.limits.lower[-1]])
        self._upper = np.array([*(reach,) * 3, arm.limits.upper[-1]])
        self._swung, self._swings = np.zeros((n, dof + 6)), np.zeros((n, dof))  # last directions, turns of the joints'
        self._swing_decay = 1.0 / (_SWING_S * control_hz)
        self._braked = np.ones(n, np.bool_)  # in a mode without motion
        self._carried = np.zeros((n, dof))  # the posture whose weight is carried then [rad]
        self._position = np.zeros((n, dof))
        self._still = np.ones(n, np.bool_)
        self.limits = self.equilibrium.limits  # the same array
        self.set_compliance(Compliance())
        self.restart(np.arange(n))

    # --- what a brain may set beside commands ------------------------------------------------------------------------

    def set_compliance(self, compliance: Compliance, mask: NDArray[np.bool_] | None = None) -> None:
        """Change stiffness and damping; a stiffness changes by at most 5000 N/m and 300 N m/rad in a second.

        Args:
            compliance: the new ones.
            mask: the arms, shape (n,); all if None.
        """
        to = slice(None) if mask is None else mask
        self._wanted_stiffness[to], self._ratio[to] = compliance.stiffness, compliance.damping_ratio
        self._is_fixed[to] = compliance.damping is not None
        self._fixed_damping[to] = 0.0 if compliance.damping is None else compliance.damping
        self._largest[to] = compliance.max_force, compliance.max_moment

    def set_wrench(self, wrench: ArrayLike, mask: NDArray[np.bool_] | None = None) -> None:
        """Push with a wrench while setpoints are followed, until the next stop; it comes and goes gradually.

        Args:
            wrench: force [N] and moment [N m] that the tool is to put on its surroundings, base frame, shape (6,).
            mask: the arms, shape (n,); all if None.

        Raises:
            ConfigError: it is not 6 finite numbers, or more than the compliance of an arm allows.
        """
        values, to = np.asarray(wrench, np.float64), slice(None) if mask is None else mask
        if values.shape != (6,) or not np.isfinite(values).all():
            raise ConfigError(f"The wrench is {values.tolist()}; it must be 6 finite numbers.")
        requested = np.array([np.linalg.norm(values[:3]), np.linalg.norm(values[3:])])
        least = self._largest[to].min(axis=0, initial=np.inf)
        if (requested > least).any():
            raise ConfigError(
                f"The wrench has {requested[0]:.6g} N and {requested[1]:.6g} N m; max_force and max_moment of the "
                f"compliance are {least[0]:.6g} N and {least[1]:.6g} N m."
            )
        self._wanted_wrench[to] = values

    # --- motion ------------------------------------------------------------------------------------------------------

    def set_setpoint(self, values: Array, mask: NDArray[np.bool_]) -> None:
        """Head for new equilibria."""
        norms = np.linalg.norm(np.where(np.isfinite(values), values, 0.0)[:, 3:7].clip(-10, 10), axis=1)
        bad = mask & ~(np.isfinite(values).all(axis=1) & (norms > _NORM_RANGE[0]) & (norms < _NORM_RANGE[1]))
        if bad.any():
            # Commands are checked when they are sent; a queue in shared memory is written by another process.
            self.limits[bad] |= int(Limit.NON_FINITE)
            self.stop(bad, Mode.FAULT)
            mask = mask & ~bad
        if not mask.any():
            return
        setpoint = np.where(mask[:, None], values, self.command)
        places = setpoint[:, [0, 1, 2, 7]]
        clipped = np.minimum(np.maximum(places, self._lower), self._upper)
        self.limits[mask & (clipped != places).any(axis=1)] |= int(Limit.POSITION)
        self.equilibrium.set_setpoint(clipped[:, :3], rotation_matrices(setpoint[:, 3:7]), clipped[:, 3:], mask)

    def stop(self, mask: NDArray[np.bool_], cause: Mode) -> None:
        """Brake the equilibrium to rest and stay there; in a mode without motion carry the weight, and no more."""
        self.equilibrium.drop(mask)
        self._wanted_wrench[mask] = 0.0
        closed = cause not in (Mode.HOLD, Mode.STOPPING)
        new = mask & (self._braked != closed)
        if new.any():
            self._braked[new] = closed
            self._carried[new] = self._position[new]
            self._swung[new] = self._swings[new] = 0.0
            self._put(np.flatnonzero(new))

    def go_back(self, mask: NDArray[np.bool_], actuators: Array, rate: Array) -> None:
        """Put the equilibrium where the tool is, and continue from the torques that the motors have."""
        ids = np.flatnonzero(mask)
        self.actuators[ids] = actuators[ids]
        self.equilibrium.place_opening(ids, actuators[ids, -1])
        self.wrench[ids] = 0.0
        self._put(ids)

    def run(self, reading: PlantReading) -> None:
        """Advance by one tick."""
        dof, braked = self.dynamics.dof, self._braked[:, None]
        position, velocity = reading.position[:, :dof], reading.velocity[:, :dof]
        self._position[:] = position
        terms = self.dynamics.terms(position, velocity)
        before = self.actuators[:, :dof]
        # What a brake gives is known to the sensors of the efforts alone.
        applied = np.where(braked, reading.effort[:, :dof], before) if reading.has_effort else before
        self.contact.update(terms, velocity, applied)
        self.protective_stop[:] = 0
        self._supervise(velocity, product(terms.jacobian, velocity))
        change = self._wanted_stiffness - self._stiffness
        if change.any():
            most = np.abs(change / self._stiffening).max(axis=(1, 2), keepdims=True)
            self._stiffness += change / np.maximum(most, 1.0)
        self.equilibrium.run()
        self._advance_wrench()
        torque = self._torque(terms, velocity)
        if self._braked.any():
            near = np.minimum(np.maximum(position, self._carried - _ROOM_RAD), self._carried + _ROOM_RAD)
            still = np.zeros_like(near)
            np.copyto(torque, self.dynamics.torque(near, still, still), where=braked)
        self._publish_command()
        given = np.minimum(np.maximum(torque, before - self._effort_step), before + self._effort_step)
        given = np.minimum(np.maximum(given, -self._effort), self._effort)
        self.limits[(given != torque).any(axis=1)] |= int(Limit.EFFORT)
        self.actuators[:, :dof] = given
        self.actuators[:, dof:] = self.equilibrium.opening
        self._still[:] = (np.abs(velocity) < _STILL).all(axis=1)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether the equilibrium is at rest and pushes nothing, and with closed brakes whether the arm is."""
        rest = self.equilibrium.at_rest() & ~self.wrench.any(axis=1)
        return np.asarray(rest & (self._still | ~self._braked))

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from where tool and fingers are, with the torque that the posture needs."""
        dof = self.dynamics.dof
        terms = self.dynamics.terms(reading.position[:, :dof], reading.velocity[:, :dof])
        self._carried[ids] = self._position[ids] = reading.position[ids, :dof]
        self._put(ids)
        lower, upper = self._lower[3], self._upper[3]
        self.equilibrium.place_opening(ids, np.minimum(np.maximum(reading.position[ids, dof], lower), upper))
        self.actuators[ids, :dof] = np.minimum(np.maximum(terms.gravity, -self._effort), self._effort)[ids]
        self.actuators[ids, dof:] = self.equilibrium.opening[ids]
        self._publish_command()

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about arms that were put somewhere else; until they are configured they stay there."""
        home = np.asarray(self.arm.home)
        terms = self.dynamics.terms(home[None, :-1], np.zeros((1, self.dynamics.dof)))
        self.equilibrium.place_opening(ids, np.full(len(ids), home[-1]))
        self.actuators[ids] = (*terms.gravity[0], home[-1])
        self.contact.restart(ids)
        self.wrench[ids] = self._wanted_wrench[ids] = 0.0
        self._stiffness[ids] = self._wanted_stiffness[ids]
        self._carried[ids] = self._position[ids] = home[:-1]
        self._put(ids)
        self._braked[ids] = self._still[ids] = True
        self.protective_stop[ids] = self.limits[ids] = 0
        self._swung[ids] = self._swings[ids] = 0.0
        self._publish_command()

    def pressed(self) -> Array:
        """Return the force between each tool and its surroundings [N], shape (n,); 0 if it is small."""
        force = np.linalg.norm(self.contact.wrench[:, :3], axis=1)
        return np.where(self._braked & self._still & (force > _LIGHT_N), force, 0.0)

    # --- reports -----------------------------------------------------------------------------------------------------

    def efforts(self, reading: PlantReading) -> Array:
        """Return the torques of the motors, weight included [N m], and the commanded force of the gripper [N]."""
        efforts = self.actuators.copy()
        stiffness, damping = self.arm.servo_stiffness[-1], self.arm.servo_damping[-1]
        efforts[:, -1] = (efforts[:, -1] - reading.position[:, -1]) * stiffness - reading.velocity[:, -1] * damping
        return efforts

    def measured(self, reading: PlantReading) -> Array:
        """Return the tool's pose and the opening as they are, shape (n, 8)."""
        dof = self.dynamics.dof
        tool = self.dynamics.terms(reading.position[:, :dof], reading.velocity[:, :dof]).tool
        return np.concatenate([pose_vectors(tool), reading.position[:, dof:]], axis=1)

    # --- inside a tick -----------------------------------------------------------------------------------------------

    def _supervise(self, velocity: Array, tool_speed: Array) -> None:
        """Begin a protective stop of arms that are too fast, or in too hard a contact."""
        moves = ~self._braked
        fast = (np.abs(velocity) > self._joint_speed[:, 2]).any(axis=1)
        hard = np.linalg.norm(self.contact.wrench[:, :3], axis=1) > self._max_force
        hard |= (np.abs(self.contact.torque) > _MOST_EFFORT * self._effort).any(axis=1)
        for part, (*_, most) in zip(_PARTS, self._tool_speed, strict=True):
            fast |= np.linalg.norm(tool_speed[:, part], axis=1) > most
        motion = np.concatenate([velocity * (np.abs(velocity) > _SWING_SPEED), self.equilibrium.speed], axis=1)
        direction = np.where(motion == 0.0, self._swung, np.sign(motion))
        turned, dof = direction * self._swung < 0.0, self.dynamics.dof
        wanted = self._swing_decay + turned[:, dof:].any(axis=1, keepdims=True)
        self._swings = np.maximum(self._swings - wanted, 0.0) + turned[:, :dof]
        self._swung = direction
        fast |= (self._swings > _MOST_SWINGS).any(axis=1)
        self.protective_stop |= np.where(fast & moves, int(Watchdog.SPEED), 0)
        self.protective_stop |= np.where(hard & moves, int(Watchdog.FORCE), 0)

    def _torque(self, terms: DynamicsTerms, velocity: Array) -> Array:
        """Return the torques that are wanted [N m], shape (n, dof)."""
        error = np.empty((self.n, 6))
        error[:, :3] = self.equilibrium.position - terms.tool[:, :3, 3]
        error[:, 3:] = rotation_vectors(self.equilibrium.rotation @ np.swapaxes(terms.tool[:, :3, :3], 1, 2))
        push, speed = product(self._stiffness, error), product(terms.jacobian, velocity)
        mobility, transposed = terms.mobility(_MOBILITY_DAMPING), np.swapaxes(terms.jacobian, 1, 2)
        # The damper's pull by the equilibrium's speed ends where the spring's is the largest.
        lead, tether = self.equilibrium.speed.copy(), np.ones((self.n, 2))
        for number, part in enumerate(_PARTS):
            size, largest = np.linalg.norm(push[:, part], axis=1), self._largest[:, number]
            tether[:, number] = largest / np.maximum(size, largest)
            lead[:, part] *= np.clip(2.0 * (1.0 - size / largest), 0.0, 1.0)[:, None]
            push[:, part] *= tether[:, number, None]
            push[:, part] += self.wrench[:, part]
        # What is pressed may give way at once, and the motors' torques need their time to fall.
        fall_s = (np.abs(product(transposed, push)) / self._torque_rate).max(axis=1)
        gained = product(mobility, push) * (0.5 * fall_s)[:, None]
        sizes = [np.linalg.norm(gained[:, part], axis=1) for part in _PARTS]
        share = 1.0 / np.sqrt(np.maximum(np.max(sizes / (_GAINED * self._tool_speed[:, :1]), axis=0), 1.0))
        self.equilibrium.keep_near(terms.tool, tether * share[:, None])
        for number, part in enumerate(_PARTS):
            size, largest = np.linalg.norm(push[:, part], axis=1), self._largest[:, number]
            self.limits[(tether[:, number] * share < 1.0) | (size > largest)] |= int(Limit.EFFORT)
            # The faster the tool moves where it is pushed to, the less it is pushed.
            first, last, _ = self._tool_speed[number]
            along = (push[:, part] * speed[:, part]).sum(axis=1) / np.maximum(size, _TINY)
            least = np.minimum(_FREE_PUSH[number], largest) * np.clip((last - along) / (last - first), 0.0, 1.0)
            allowed = np.minimum(np.clip(largest * (1.0 - along / first), least, largest), size * share)
            push[:, part] *= (allowed / np.maximum(size, _TINY))[:, None]
        damping = self._fixed_damping.copy()
        if not self._is_fixed.all():
            designed = critical_damping(mobility, self._stiffness, self._ratio)
            np.copyto(damping, designed, where=~self._is_fixed[:, None, None])
        push += product(damping, lead - speed)
        torque = product(transposed, push)
        first, last = self._joint_speed[:, 0], self._joint_speed[:, 1]
        torque *= np.clip((last - velocity * np.sign(torque)) / (last - first), 0.0, 1.0).min(axis=1, keepdims=True)
        own = product(terms.coriolis, velocity) + terms.gravity
        return torque + own - _JOINT_DAMPING * self._effort * velocity

    def _advance_wrench(self) -> None:
        """Move the feed-forward wrench towards what is wanted; none without setpoints, none at once if held."""
        wanted = np.where(self.equilibrium.active[:, None], self._wanted_wrench, 0.0)
        step = np.minimum(np.maximum(wanted - self.wrench, -self._wrench_step), self._wrench_step)
        self.wrench += step
        self.wrench[self._braked] = 0.0

    def _put(self, ids: NDArray[np.intp]) -> None:
        """Put the equilibrium of some arms where the tool is."""
        position = self._position[ids]
        self.equilibrium.place(ids, self.dynamics.terms(position, np.zeros_like(position)).tool)

    def _publish_command(self) -> None:
        equilibrium = self.equilibrium
        pose = np.zeros((self.n, 4, 4))
        pose[:, :3, :3], pose[:, :3, 3] = equilibrium.rotation, equilibrium.position
        self.command[:, :7] = pose_vectors(pose)
        self.command[:, 7:] = equilibrium.opening
