"""Contact forces without a force sensor: what the joints feel beyond what they are commanded to."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.dynamics import DynamicsTerms, product
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

# [1/s] The estimate follows a contact with a time constant of 20 ms: a tenth of what an arm needs to answer one, and
# slow enough that a speed's noise is not taken for a force.
OBSERVER_GAIN = 50.0
# Directions in which the Jacobian's singular value is this small are halved; at 0.3, an ordinary one, 0.1 % is lost.
_DAMPING = 0.01


class ContactObserver:
    """Estimates the torques, and the wrench on the tool, that the surroundings put on n arms.

    It compares the generalised momentum with the one that the commanded torques account for, so that it needs no
    accelerations. What is not modelled counts as contact: friction in the joints, and a payload's weight.

    Attributes:
        torque: external joint torques [N m], shape (n, 6).
        wrench: the force [N] and the moment [N m] about the tool centre point that cause them if they act on the tool,
            in the base frame, shape (n, 6).

    Args:
        control_hz: ticks a second [Hz].
        gain: bandwidth of the estimate [1/s].
    """

    def __init__(self, n: int, dof: int, control_hz: int, gain: float = OBSERVER_GAIN) -> None:
        if not 0.0 < gain <= control_hz:
            raise ConfigError(f"The observer's gain is {gain} 1/s; it must be above 0 and at most {control_hz} 1/s.")
        self.torque: Array = np.zeros((n, dof))
        self.wrench: Array = np.zeros((n, 6))
        self._gain, self._dt = gain, 1.0 / control_hz
        self._expected, self._rate = np.zeros((n, dof)), np.zeros((n, dof))
        self._fresh = np.ones(n, np.bool_)

    def update(self, terms: DynamicsTerms, velocity: Array, applied: Array) -> None:
        """Take one tick into account.

        Args:
            velocity: joint speeds that were read [rad/s], shape (n, 6).
            applied: torques that the motors gave since the tick before [N m], shape (n, 6).
        """
        momentum = product(terms.mass, velocity)
        rate = product(np.swapaxes(terms.coriolis, 1, 2), velocity) - terms.gravity
        if self._fresh.any():
            np.copyto(self._expected, momentum, where=self._fresh[:, None])
            np.copyto(self._rate, rate, where=self._fresh[:, None])
            # The first reading says nothing about what led to it.
            applied = np.where(self._fresh[:, None], -rate, applied)
            self._fresh[:] = False
        self._expected += self._dt * (applied + 0.5 * (self._rate + rate))
        self._rate[:] = rate
        # The backward Euler step of torque' = gain * (momentum' - expected' - torque).
        self.torque[:] = (momentum - self._expected) * (self._gain / (1.0 + self._gain * self._dt))
        self._expected += self._dt * self.torque
        self.wrench[:] = tool_wrench(terms.jacobian, self.torque)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget arms that were put somewhere else."""
        self.torque[ids] = self.wrench[ids] = 0.0
        self._fresh[ids] = True


def tool_wrench(jacobian: Array, torque: Array, damping: float = _DAMPING) -> Array:
    """Return the wrench on the tool that joint torques amount to, by damped least squares.

    Args:
        jacobian: shape (n, 6, dof).
        torque: [N m], shape (n, dof).

    Returns:
        Force [N] and moment [N m] in the base frame, shape (n, 6); near zero in directions that a singular posture can
        feel nothing from.
    """
    square = jacobian @ np.swapaxes(jacobian, 1, 2) + damping**2 * np.eye(6)
    return np.asarray(np.linalg.solve(square, jacobian @ torque[..., None])[..., 0])
