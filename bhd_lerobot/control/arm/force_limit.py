"""How hard an arm presses, from its motors' efforts: what it may do no more than for a moment."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.arm.wrench import tool_wrench
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

_PERIOD_S = 0.02  # between two estimates
_SHARE = 0.7  # of what is new in an estimate: one reading's noise must not be a force
# Directions in which a singular posture feels little are left out: errors of the joints' torques, such as 16 N m in the
# hardest reversals of a simulated UR5, would be large forces there. A force with a lever of 0.2 m is felt to 80 %.
_DAMPING = 0.1
# A load that was not declared hangs on the tool: the force on it points down, at rest, for so long.
_LOAD_N, _LOAD_S = 20.0, 0.3
_DOWN = 0.9  # the least cosine between that force and the vertical
_STILL = 0.02  # [rad/s]
_GRAVITY = 9.81  # [m/s^2]
# A force alone, without a moment, is found in more directions: in those in which the strongest motors feel it with a
# lever of less than 0.1 m, by less than half.
_FORCE_DAMPING = 0.1
_LEAST_TORQUE = 4.0  # [N m] where no joint feels more, nothing is estimated: 10 N with a lever of 0.4 m
# Efforts that are all exactly 0 are none that were measured: motors that carry this much [N m] give some.
_CARRIES = 4.0
_LOST_S = 0.1  # without any effort that was measured


class ForceLimit:
    """Estimates the forces on the tools of n arms, and states which are too large.

    The motors' efforts, averaged over 20 ms, are compared with those that the motion of that time needs, and explained
    by a force on the tool, and by a force with a moment; the larger force counts. Of a force on the tool 98 % are found
    in the median, and 71 % in 99 of 100 postures and directions. A force elsewhere on the arm counts with the force on
    the tool that would load the joints alike: half-way to the tool, about half of it is felt. What is not modelled
    counts too: friction, and the weight of a load that was not declared. Of that no more than 20 N is permitted: an arm
    at rest whose tool is pulled down by more has another load than its motions were planned with.

    Attributes:
        force: the newest estimates [N], shape (n,); 0 where the joints feel too little to ask.
        torque: what the motors give more than the posture and its motion need [N m], shape (n, dof).
        wrench: what the surroundings put on the tools, in the base frame: forces [N] and moments about the tool centre
            points [N m], shape (n, 6); shape (n, 0) if it is not asked for.
        pressing: the forces that are more than a load which need not be declared, shape (n,); 0 for the others.
        exceeded: whether each is above the largest, or a load hangs on the tool that was not declared, shape (n,).
        measured: whether the newest efforts were measurements, shape (n,): of the others nothing is known.
        lost: whether they have been none for 0.1 s though the motors carry the arm's weight, shape (n,).

    Args:
        control_hz: ticks a second [Hz].
        largest: with which the tool may press [N].
        wrench: estimate also the wrenches.

    Raises:
        ConfigError: the largest force is not positive.
    """

    def __init__(self, body: Body, n: int, control_hz: int, largest: float, *, wrench: bool = False) -> None:
        arm = body.need(Arm)
        if not largest > 0.0:
            raise ConfigError(f"max_force is {largest}; it must be positive [N]. With .inf nothing is too much.")
        self.largest, self._load = largest, arm.load
        self._hung: NDArray[np.int64] = np.zeros(n, np.int64)  # estimates at rest with a load that was not declared
        self._most_hung = round(_LOAD_S / _PERIOD_S)
        self._pull = np.zeros(n)
        self._dynamics, self._forward = ArmDynamics(body), ForwardKinematics(arm.chain)
        self._dof = dof = self._dynamics.dof
        effort = np.asarray(arm.limits.effort[:dof])
        self._certain = effort.max() / effort  # weights: torques are as wrong as their motors are large
        self._period = max(1, round(_PERIOD_S * control_hz))
        self._hz = control_hz / self._period
        self._sum, self._ticks = np.zeros((n, dof)), 0
        self._zeros: NDArray[np.int64] = np.zeros(n, np.int64)  # readings of this period without any effort
        self._lost_periods: NDArray[np.int64] = np.zeros(n, np.int64)
        self._most_lost = max(1, round(_LOST_S * control_hz / self._period))
        self._position, self._velocity, self.torque = (np.zeros((n, dof)) for _ in range(3))
        self._fresh = np.ones(n, np.bool_)
        self.force, self.pressing = np.zeros((2, n))
        self.wrench: Array = np.zeros((n, 6 if wrench else 0))
        self.exceeded, self.measured, self.lost = np.zeros((3, n), np.bool_)

    def update(
        self, reading: PlantReading, resting: NDArray[np.bool_] | bool = False, position: Array | None = None
    ) -> bool:
        """Take one tick into account; return whether there is a new estimate that is too large for any arm.

        Args:
            resting: the arms that are at rest whatever speeds are read, shape (n,).
            position: where the joints are, if not where they are read to be [rad], shape (n, dof).
        """
        if not reading.has_effort:
            self.measured[:] = False
            return False
        dof = self._dof
        position = reading.position[:, :dof] if position is None else position
        effort = reading.effort[:, :dof]
        self._sum += effort
        if np.count_nonzero(effort) < effort.size:
            self._zeros += ~effort.any(axis=1)
        self._ticks += 1
        if self._ticks < self._period:
            return False
        velocity = reading.velocity[:, :dof]
        middle, speed = (position + self._position) / 2, (velocity + self._velocity) / 2
        change = (velocity - self._velocity) * self._hz
        moving = np.logical_not(resting).reshape(-1, 1)
        speed, change = speed * moving, change * moving
        given = self._sum / np.maximum(self._ticks - self._zeros, 1)[:, None]
        residual = given - self._dynamics.torque(middle, speed, change)
        self._position[:], self._velocity[:] = position, velocity
        ticks, self._sum[:], self._ticks = self._ticks, 0.0, 0
        residual[self._fresh] = 0.0  # where they came from is not known yet
        self._fresh[:] = False
        torque = self.torque
        if self._zeros.any() or self._lost_periods.any():
            self._judge_zeros(ticks, position, residual)
        else:
            self.measured[:] = True
        torque += _SHARE * (residual - torque)
        if self.wrench.size:
            every = np.ascontiguousarray(self._forward.jacobian(position))
            np.negative(tool_wrench(every, torque, _DAMPING), out=self.wrench)
        self.force[:] = self.pressing[:] = self._pull[:] = 0.0
        self.exceeded[:] = False
        felt = np.abs(torque).max(axis=1) > _LEAST_TORQUE
        if not np.count_nonzero(felt):
            self._hung[:] = 0
            return False
        # Products of matrices that lie otherwise in memory round otherwise: with it the number of arms would count.
        jacobian = np.ascontiguousarray(self._forward.jacobian(position[felt]))
        both = tool_wrench(jacobian, torque[felt], _DAMPING)[:, :3], self._tool_force(jacobian, torque[felt])
        sizes = [np.linalg.norm(force, axis=1) for force in both]
        force = np.where((sizes[0] > sizes[1])[:, None], *both)
        self.force[felt] = np.maximum(*sizes)
        np.greater(self.force, self.largest, out=self.exceeded)
        self._pull[felt] = force[:, 2]  # the tool pulls it up
        hangs = (self._pull > _LOAD_N) & (self._pull > _DOWN * self.force) & (np.abs(velocity) < _STILL).all(axis=1)
        self.pressing[:] = self.force
        self.pressing[(self._pull > _DOWN * self.force) & (self.force < _LOAD_N)] = 0.0
        self._hung += 1
        self._hung *= hangs
        self.exceeded |= self._hung >= self._most_hung
        return bool(np.count_nonzero(self.exceeded))

    def _judge_zeros(self, ticks: int, position: Array, residual: Array) -> None:
        """Keep the estimates of arms without efforts in this period; forget them of those without for longer."""
        none = self._zeros == ticks
        self._zeros[:] = 0
        self._lost_periods += 1
        self._lost_periods *= none
        self.measured |= ~none
        self.measured &= self._lost_periods < self._most_lost
        self.torque[~self.measured] = 0.0
        np.copyto(residual, self.torque, where=none[:, None])
        weight = np.abs(self._dynamics.torque(position, np.zeros_like(position), np.zeros_like(position)))
        self.lost[:] = (self._lost_periods >= self._most_lost) & (weight.max(axis=1) > _CARRIES)

    def _tool_force(self, jacobian: Array, torque: Array) -> Array:
        """Return the forces on the tools alone, without moments, that torques amount to [N], shape (k, 3)."""
        lever = jacobian[:, :3] * self._certain
        square = lever @ np.swapaxes(lever, 1, 2) + _FORCE_DAMPING**2 * np.eye(3)
        return np.asarray(np.linalg.solve(square, lever @ (torque * self._certain)[..., None])[..., 0])

    def explain(self) -> str:
        """Return as text which force was too large."""
        if (self._hung >= self._most_hung).any():
            return (
                f"About {self._load + self._pull.max() / _GRAVITY:.1f} kg hang on the tool, or it presses upwards; "
                f"declared are {self._load:g} kg. Declare what it carries with robot.payload."
            )
        return (
            f"The tool pressed with {self.force.max():.0f} N; {self.largest:g} N is the most. Find out what is in its "
            "way, or allow more with robot.max_force."
        )

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget arms that were put somewhere else."""
        self._fresh[ids] = True
        self._hung[ids] = 0
        self._zeros[ids] = 0
        self._sum[ids] = self.torque[ids] = self.force[ids] = self.pressing[ids] = 0.0
        self.wrench[ids] = 0.0
        self.exceeded[ids] = False
