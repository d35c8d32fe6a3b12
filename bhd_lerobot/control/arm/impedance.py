"""The controller of arms with torque motors: a tool that behaves like a damped spring towards a commanded pose."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.arm.equilibrium import SPEED, TURN_SPEED, is_spring_at_rest, put_at_tool
from bhd_lerobot.control.arm.spring import publish_equilibrium, tell_spring
from bhd_lerobot.control.arm.wrench import OBSERVER_GAIN
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.rigid_bodies import find_dynamics
from bhd_lerobot.control.kernels import as_objects, clamp
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import ARM_LIMITS, new_springs, put
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

WIDTH = 8
_MOST_TOOL_SPEED, _MOST_JOINT_SPEED = 2.0, 1.1  # shares of the equilibrium's largest and of their own: beyond, a stop
_MOST_EFFORT = 0.8  # share of a joint's largest torque that the surroundings may put on it
_MOST_SWINGS = 2.0
_SET = ("wanted_stiffness", "ratio", "is_fixed", "fixed_damping", "largest")


class ImpedanceController(Controller):
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
        springs: the records of the impedances, shape (n,).
        wrench: the feed-forward wrench in force, force [N] and moment [N m] in the base frame, shape (n, 6).

    Args:
        body: the robot; the actuation of its arm is ``"torque"``.
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
        max_force: a larger force between the tool and its surroundings is a protective stop [N].

    Raises:
        ConfigError: the arm does not take torques or has no brakes, or there are too few ticks for the estimate of
            contacts or for a frame, or `max_force` is not above 0.
    """

    width = WIDTH

    def __init__(self, body: Body, n: int, control_hz: int, frame_ticks: int, max_force: float = 150.0) -> None:
        super().__init__(n)
        arm = body.need(Arm)
        if arm.actuation != "torque":
            raise ConfigError(f"The arm {body.name!r} has actuation={arm.actuation!r}; impedance needs 'torque'.")
        if not arm.brake_damping:
            raise ConfigError(f"The arm {body.name!r} has no brakes (Arm.brake_damping); impedance needs them.")
        if control_hz < OBSERVER_GAIN:
            raise ConfigError(f"control_hz is {control_hz}; impedance needs at least {OBSERVER_GAIN:g} ticks a second.")
        if not (max_force > 0.0 and frame_ticks > 0):
            raise ConfigError(f"max_force is {max_force} and frame_ticks is {frame_ticks}; both must be above 0.")
        self.arm = arm
        self.joints, self._dof = len(arm.limits.names), len(arm.chain.joints)
        self.numbers["arm_values"] = WIDTH
        self.springs, self.arm_limits = new_springs(n), np.zeros(1, ARM_LIMITS)
        self._put_limits(body, control_hz, frame_ticks, max_force)
        states, springs = self.states, self.springs
        self.command: Array = states["command"][:, :WIDTH]
        self.actuators: Array = states["actuators"][:, : self.joints]
        self.busy, self.protective_stop, self.limits = (states[k] for k in ("busy", "protective_stop", "limits"))
        self.wrench: Array = springs["wrench"]
        # As the functions of a tick take them.
        self._state_of, self._spring_of = as_objects(states), as_objects(springs)
        [self._limits_of] = as_objects(self.arm_limits)
        self.set_compliance(Compliance())
        self.restart(np.arange(n))

    def _put_limits(self, body: Body, control_hz: int, frame_ticks: int, max_force: float) -> None:
        """Write what a tick goes by."""
        row, arm, dof = self.arm_limits[0], self.arm, self._dof
        limits = arm.limits
        row["dof"], row["hz"], row["frame_ticks"] = dof, control_hz, frame_ticks
        for name, field in (("fastest", "velocity"), ("hardest", "acceleration")):
            put(row, name, getattr(limits, field))
        for name in ("lower", "upper", "effort"):
            put(row, name, getattr(limits, name))
        put(row, "stiffness", arm.servo_stiffness)  # of the gripper's servo, which is the last
        put(row, "damping", arm.servo_damping)
        # Positions beyond what the arm can ever reach are refused; nearer ones are for the spring to find out.
        row["most_reach"] = arm.chain.reach
        put(row, "most_speed", _MOST_JOINT_SPEED * np.asarray(limits.velocity[:dof]))
        put(row, "most_torque", _MOST_EFFORT * np.asarray(limits.effort[:dof]))
        row["most_tool_speed"] = _MOST_TOOL_SPEED * np.array([SPEED, TURN_SPEED])
        row["most_force"], row["most_swings"] = max_force, _MOST_SWINGS
        ArmDynamics(body).fill(row)

    # --- what a brain may set beside commands ------------------------------------------------------------------------

    def set_compliance(self, compliance: Compliance, mask: NDArray[np.bool_] | None = None) -> None:
        """Change stiffness and damping; a stiffness changes by at most 5000 N/m and 300 N m/rad in a second.

        Args:
            compliance: the new ones.
            mask: the arms, shape (n,); all if None.
        """
        to, springs = slice(None) if mask is None else mask, self.springs
        springs["wanted_stiffness"][to], springs["ratio"][to] = compliance.stiffness, compliance.damping_ratio
        springs["is_fixed"][to] = compliance.damping is not None
        springs["fixed_damping"][to] = 0.0 if compliance.damping is None else compliance.damping
        springs["largest"][to] = compliance.max_force, compliance.max_moment

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
        least = self.springs["largest"][to].min(axis=0, initial=np.inf)
        if (requested > least).any():
            raise ConfigError(
                f"The wrench has {requested[0]:.6g} N and {requested[1]:.6g} N m; max_force and max_moment of the "
                f"compliance are {least[0]:.6g} N and {least[1]:.6g} N m."
            )
        self.springs["wanted_wrench"][to] = values

    # --- between ticks -----------------------------------------------------------------------------------------------

    def tell(self, sim: int) -> None:
        """Take the modes that one robot has entered outside of a tick."""
        tell_spring(self._state_of[sim], self._spring_of[sim], self._limits_of)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether the equilibrium is at rest and pushes nothing, and with closed brakes whether the arm is."""
        return np.array([is_spring_at_rest(spring) for spring in self._spring_of])

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from where tool and fingers are, with the torque that the posture needs."""
        lower, upper = self.arm.limits.lower[-1], self.arm.limits.upper[-1]
        for sim in np.asarray(ids).tolist():
            self._put(sim, reading.position[sim, :-1], clamp(float(reading.position[sim, -1]), lower, upper))

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about arms that were put somewhere else; until they are configured they stay there."""
        kept = {name: self.springs[name][ids] for name in _SET}
        self.springs[ids] = new_springs(1)
        for name, values in kept.items():
            self.springs[name][ids] = values
        self.springs["stiffness"][ids] = self.springs["wanted_stiffness"][ids]
        self.protective_stop[ids] = self.limits[ids] = 0
        *posture, opening = self.arm.home
        first, *others = np.asarray(ids).tolist() or [None]
        if first is None:
            return
        self._put(first, np.asarray(posture), opening)
        for name in ("tool", "tool_turn", "place", "turn", "opening", "position", "carried"):
            self.springs[name][others] = self.springs[name][first]
        self.actuators[others], self.command[others] = self.actuators[first], self.command[first]

    def _put(self, sim: int, posture: Array, opening: float) -> None:
        """Put an equilibrium where the tool is in a posture, with motors that carry it."""
        state, spring, limits, dof = self._state_of[sim], self._spring_of[sim], self._limits_of, self._dof
        spring.position[:dof] = spring.carried[:dof] = posture
        find_dynamics(spring, limits, spring.position, spring.still)
        put_at_tool(spring)
        spring.opening, spring.opening_speed = opening, 0.0
        for k in range(dof):
            state.actuators[k] = clamp(spring.gravity[k], -limits.effort[k], limits.effort[k])
        state.actuators[dof] = opening
        publish_equilibrium(state, spring)
