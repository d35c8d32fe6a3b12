#!/bin/sh
# Ruckig plans a far slower motion, as a success, from a state of its own trajectory.
#
# Versions: ruckig 0.19.4; Python 3.12, Linux, x86-64.
#
# One axis goes from rest at 0 to rest at 2; the limits are 1 (velocity), 8 (acceleration) and 80 (jerk). Every state of
# that trajectory, one each 2 ms, is given to Ruckig again as the current state, with the same target and the same limits;
# states that Ruckig's own check of the limits refuses are left out. While the acceleration falls to zero at the velocity
# limit, v + a^2 / (2 j) equals the limit to the last bit. From 24 of these states the new trajectory takes up to 1.78 s
# longer than the rest of the first one, with Result.Working. With a velocity limit of 1 + 1e-9 the same state gives the
# right one.
#
# Expected: from a state of a trajectory, the rest of it is a solution, so no time-optimal one takes longer.
#
# Output seen:
#   ruckig 0.19.4: from rest to the target in 2.225 s
#   24 of 1099 states: slower; at 0.126 s: 3.874 s where 2.099 s are left, Result.Working
#   the same state with a velocity limit of 1 + 1e-9: 2.099 s
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ruckig==0.19.4
"$folder/venv/bin/python" - <<'EOF'
import sys
from importlib.metadata import version

import ruckig


def plan(position, velocity, acceleration, max_velocity=1.0):
    """Return Ruckig's result and trajectory; None if it refuses the state."""
    axis = ruckig.InputParameter(1)
    axis.current_position, axis.current_velocity, axis.current_acceleration = [position], [velocity], [acceleration]
    axis.target_position = [2.0]
    axis.max_velocity, axis.max_acceleration, axis.max_jerk = [max_velocity], [8.0], [80.0]
    generator, trajectory = ruckig.Ruckig(1), ruckig.Trajectory(1)
    try:
        generator.validate_input(axis, check_current_state_within_limits=True, check_target_state_within_limits=True)
    except ruckig.RuckigError:
        return None
    return generator.calculate(axis, trajectory), trajectory


_, first = plan(0.0, 0.0, 0.0)
print(f"ruckig {version('ruckig')}: from rest to the target in {first.duration:.3f} s")
states = [(time, [values[0] for values in first.at_time(time)]) for time in (k * 0.002 for k in range(1, 1113))]
plans = [(time, state, plan(*state)) for time, state in states]
plans = [entry for entry in plans if entry[2] is not None]
slower = [entry for entry in plans if entry[0] + entry[2][1].duration > first.duration + 0.01]
print(f"{len(slower)} of {len(plans)} states: slower", end="")
if not slower:
    sys.exit("\nNo state gives a slower trajectory any more.")
time, state, (result, again) = slower[0]
left = first.duration - time
print(f"; at {time:.3f} s: {again.duration:.3f} s where {left:.3f} s are left, {result}")
_, near = plan(*state, max_velocity=1.0 + 1e-9)
print(f"the same state with a velocity limit of 1 + 1e-9: {near.duration:.3f} s")
sys.exit(int(abs(near.duration - left) > 0.001))
EOF
