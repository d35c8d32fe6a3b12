"""Contact forces without a force sensor: what the joints feel beyond what they are commanded to.

The generalised momentum is compared with the one that the commanded torques account for, so that no accelerations are
needed. What is not modelled counts as contact: friction in the joints, and a payload's weight.
"""

from typing import Any

from bhd_lerobot.control.geometry.chain import solve
from bhd_lerobot.control.kernels import kernel

# [1/s] The estimate follows a contact with a time constant of 20 ms: a tenth of what an arm needs to answer one, and
# slow enough that a speed's noise is not taken for a force.
OBSERVER_GAIN = 50.0
# Directions in which the Jacobian's singular value is this small are halved; at 0.3, an ordinary one, 0.1 % is lost.
_DAMPING = 0.01


@kernel()
def observe_contact(state: Any, spring: Any, limits: Any) -> None:
    """Take one tick into account, whose dynamics the record has.

    To the spring's `torque`, what the surroundings put on the joints [N m], and the robot's `wrench`, the force [N] and
    the moment [N m] about the tool centre point that cause it if they act on the tool, in the base frame; near zero in
    directions that a singular posture can feel nothing from.
    """
    by_sensors = spring.is_braked and state.has_effort  # what a brake gives is known to them alone
    for k in range(limits.dof):
        rate = spring.gradient[k] - spring.gravity[k]
        applied = state.effort[k] if by_sensors else state.written[k]
        if spring.is_fresh:  # the first reading says nothing about what led to it
            spring.expected[k] = spring.momentum[k]
        else:
            spring.expected[k] += (applied + 0.5 * (spring.rate[k] + rate)) / limits.hz
        spring.rate[k] = rate
        # The backward Euler step of torque' = gain * (momentum' - expected' - torque).
        torque = (spring.momentum[k] - spring.expected[k]) * (OBSERVER_GAIN / (1.0 + OBSERVER_GAIN / limits.hz))
        spring.torque[k] = torque
        spring.expected[k] += torque / limits.hz
    spring.is_fresh = False
    for i in range(6):
        state.wrench[i] = 0.0
        for k in range(limits.dof):
            state.wrench[i] += spring.jacobian[i, k] * spring.torque[k]
        for j in range(6):
            spring.square[i, j] = _DAMPING * _DAMPING if i == j else 0.0
            for k in range(limits.dof):
                spring.square[i, j] += spring.jacobian[i, k] * spring.jacobian[j, k]
    solve(spring.square, state.wrench, 6)
