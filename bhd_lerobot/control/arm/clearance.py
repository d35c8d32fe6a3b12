"""Setpoints that would bring an arm too near to itself or to the table: it slows down, and stops before contact."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import HELD, ArmChain, Capsule
from bhd_lerobot.control.geometry.chain import find_distances
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.record import GEOMETRY, PAIRS, SAMPLES, SHAPES
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

LOOKS = 2  # a frame: between two, an arm continues at the speed that the first permitted
# An arm that approaches has to stay so much further away than the least distance, for each metre that it needs to stop:
# directions change between two checks, and two samples of a fast stop are far apart.
_WIDER = 0.015
_ROUNDING = 1e-9  # [m] a distance that shrinks by less does not shrink
_TRIES = 3  # speeds from which there should be room enough to stop, each half of the one before
_TINY = 1e-12


def fill_geometry(row: Any, chain: ArmChain) -> None:
    """Write the shapes of a chain into a record of `GEOMETRY`.

    Raises:
        ConfigError: it has more than a record holds.
    """
    model = CollisionModel(chain)
    shapes, pairs = len(chain.capsules), len(chain.disjoint)
    if shapes > SHAPES or pairs > PAIRS:
        raise ConfigError(
            f"The arm and what is declared around it are {shapes} capsules, of which {pairs} pairs are kept apart; an "
            f"arm's record holds {SHAPES} and {PAIRS}. Declare fewer obstacles, larger ones in place of several."
        )
    dof = chain.dof
    row["shapes"], row["pairs"] = shapes, pairs
    model.fill(row)
    near = np.concatenate(model.slopes())
    row["slopes"][: pairs + shapes, :dof] = near
    # [m] no point moves further when a joint turns by 1 rad
    row["reach"][:dof] = near.max(axis=0)


def new_geometries(chain: ArmChain, n: int) -> NDArray[Any]:
    """Return the geometry of an arm, and room for those of n arms that hold something, shape (1 + n,)."""
    geometries = np.zeros(1 + n, GEOMETRY)
    held = Capsule(HELD, chain.dof, chain.tool.position, (0.0, 0.0, 0.2), 0.02)
    for one in (chain.holding(held), chain):  # both have to fit
        geometries[0] = 0
        fill_geometry(geometries[0], one)
    return geometries


@kernel()
def find_stop(arm: Any, limits: Any, geometry: Any, share: float) -> None:
    """Write how far joints turn that continue until the next check at a share of the wanted speed, and then stop.

    To the arm's `ways` [rad], `lengths`, how far that takes any point of the arm at the most [m], at the next check and
    at times after it, and `reached`, the speed at the next check.
    """
    longest = 0.0  # of the joints' stops: every joint brakes by itself, as hard as it may
    for k in range(limits.dof):
        change = limits.hardest[k] * limits.look_s
        arm.reached[k] = clamp(share * arm.wanted[k], arm.speed[k] - change, arm.speed[k] + change)
        longest = max(longest, limits.ramp_s[k] + abs(arm.reached[k]) / limits.hardest[k])
    for sample in range(SAMPLES):
        time = sample / (SAMPLES - 1) * longest
        arm.lengths[sample] = 0.0
        for k in range(limits.dof):
            fast = abs(arm.reached[k])
            braking = min(max(time - limits.ramp_s[k], 0.0), fast / limits.hardest[k])
            way = fast * (min(time, limits.ramp_s[k]) + braking) - limits.hardest[k] * braking * braking / 2
            arm.ways[sample, k] = arm.reached[k] * limits.look_s + math.copysign(way, arm.reached[k])
            arm.lengths[sample] += abs(arm.ways[sample, k]) * geometry.reach[k]


@kernel()
def is_near(arm: Any, limits: Any, geometry: Any, q: Array) -> bool:
    """Return whether an arm may come near to something on the way on which it would stop.

    Far from everything, no distances are computed: no point of the arm moves further than its joints turn times their
    reach.
    """
    for k in range(geometry.pairs + geometry.shapes):
        used = 0.0
        for joint in range(limits.dof):
            # What lies between here and where distances are known must not have used them up.
            far = abs(q[joint] - arm.known[joint]) + abs(arm.ways[SAMPLES - 1, joint])
            used += geometry.slopes[k, joint] * far
        if arm.distances[k] - (used + _WIDER * arm.lengths[SAMPLES - 1]) < limits.least:
            return True
    return False


@kernel()
def free_share(  # noqa: PLR0917
    arm: Any, limits: Any, geometry: Any, q: Array, itself: float, table: float
) -> float:
    """Return which share of the way on which an arm would stop is free.

    Args:
        q: where it is [rad].
        itself: its distance from itself there [m].
        table: its distance from the table there [m].
    """
    free = 1.0
    for sample in range(SAMPLES):
        for k in range(limits.dof):
            arm.needs[k] = q[k] + arm.ways[sample, k]
        found = find_distances(arm, geometry, arm.needs, False)
        wider = _WIDER * arm.lengths[sample]
        for before, after in ((itself, found[0] - wider), (table, found[1] - wider)):
            if after < limits.least and after < before - _ROUNDING:
                inside = clamp((before - limits.least) / (before - after), 0.0, 1.0)
                free = min(free, (sample + inside) / SAMPLES)
        itself, table = found[0] - wider, found[1] - wider
    return free


@kernel()
def permitted_share(arm: Any, limits: Any, geometry: Any, q: Array) -> float:
    """Return which share of the wanted speed lets an arm stop before it comes too near, as far as it is known.

    Setpoints pass the check that goals pass: with `ArmChain.min_distance` as the least distance, on the way on which
    the arm would come to rest if it was stopped at the next check. An arm that is too near already may move away. What
    the check does not know, such as objects, is for the force limit.
    """
    find_stop(arm, limits, geometry, 1.0)
    if not is_near(arm, limits, geometry, q):
        return 1.0
    for k in range(limits.dof):
        arm.known[k] = q[k]
    itself, table = find_distances(arm, geometry, q, True)
    free = free_share(arm, limits, geometry, q, itself, table)
    if free >= 1.0:
        return 1.0
    # To stop takes the square of the speed, the time until the next check the speed itself.
    square = linear = 0.0
    for k in range(limits.dof):
        fast = abs(arm.reached[k])
        square += geometry.reach[k] * fast * fast / (2 * limits.hardest[k])
        linear += geometry.reach[k] * fast * (limits.look_s + limits.ramp_s[k])
    room = free * (square + linear)
    share = min(2 * room / max(linear + math.sqrt(linear * linear + 4 * square * room), _TINY), 1.0)
    # Joints do not slow down in step, so that the way becomes another one: it is checked as well. If none is free,
    # the arm stops: it can, because that is how the way ended that was found free before.
    for _ in range(_TRIES):
        find_stop(arm, limits, geometry, share)
        if free_share(arm, limits, geometry, q, itself, table) >= 1.0:
            return share
        share *= 0.5
    return 0.0
