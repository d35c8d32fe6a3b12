"""What grippers hold, as far as it can be known without eyes: something that stood on the table when they closed."""

from typing import Any

from bhd_lerobot.bodies.body import HELD, ArmChain, Capsule, Handling
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.motion.supervision import GRIPPER_STILL

_INSIDE = 0.005  # [m] a gripper that stalls so far from where it is commanded to holds something
_SLACK = 0.0002  # [m] by which it may come nearer to the table than when it was taken: it can be put back


@kernel()
def follow_gripper(state: Any, arm: Any, limits: Any) -> bool:
    """Count for how long a closing gripper has stood still; return whether it holds or loses something now.

    It holds something if it stands still though it is commanded to close further, for as long as a goal of the gripper
    takes for that. It is forgotten when the gripper opens, or closes without it.
    """
    last, holds = limits.dof, arm.held_ticks >= limits.stall_ticks
    # What is held may move the fingers: it is lost when they get to where they are commanded to.
    is_away = state.position[last] - state.command[last] > _INSIDE
    stays = is_away and (holds or abs(state.velocity[last]) < GRIPPER_STILL)
    if stays and arm.held_ticks == 0:
        for k in range(limits.dof):
            arm.held_at[k] = state.command[k]
    arm.held_ticks = arm.held_ticks + 1 if stays else 0
    return (arm.held_ticks >= limits.stall_ticks) != holds


def held_capsule(
    chain: ArmChain, forward: ForwardKinematics, state: Any, arm: Any, highest: float = Handling.highest
) -> Capsule | None:
    """Return what a gripper holds; None if it holds nothing, or what it holds did not stand on the table.

    It is taken to reach as far down as the table was when the fingers stopped, and to be as thick as they were apart.
    `highest`: see `Handling`.
    """
    if not arm["held_ticks"]:
        return None
    dof = forward.dof
    tool = forward.tool(arm["held_at"][:dof])
    below = float(tool[2, 3]) - chain.min_distance - _SLACK
    if not 0.0 < below < highest:
        return None
    radius = min(float(state["position"][dof]) / 2, 0.9 * below)  # a capsule with a direction
    at = chain.tool.matrix()
    down = at[:3, :3] @ tool[2, :3]  # the third row is the vertical in the tool's frame
    x, y, z = at[:3, 3] - down * (below - radius)
    return Capsule(HELD, dof, chain.tool.position, (float(x), float(y), float(z)), radius)
