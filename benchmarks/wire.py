"""What reaches the actuators when a brain, or what lies between, goes mad: `python -m benchmarks.wire`.

Streams of commands that no sensible brain sends, one for each simulated robot: steps, reversals at every frame,
spirals that grow beyond every limit, values at the limits, huge ones, ones that are not finite, tool poses that turn on
the spot through singular postures. Then the same streams again, while the memory of the command queue and the
controller's own reference are overwritten at random. Every write to the plant is judged by limits that are stated here:
finite, in the actuator's range, and changes from tick to tick that the body permits. The second table is about readings
that are no measurements: false, drifting, wrapped, frozen, counting twice, from the future, of robots that move; with
the largest distance of a joint or a wheel from where the stop found it, and how many times as fast joints and tool are
after the stop, by physics. The third attacks impedance control: with such readings, late ones and speeds of the wrong
sign, walls that vanish, stiffnesses that change with every frame; with the largest speeds and forces. Exits
with 3 if anything unsafe was written, or a stop was followed by more motion than it needs.
"""

import argparse
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from benchmarks._impedance_attacks import ATTACKS, attack
from benchmarks._turns import status
from bhd_lerobot.bodies.body import Arm, Drive
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.messages import Mode, Request
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask

Array = NDArray[np.float64]
MONITORED = "wheels, monitored"
SO101, MOBILE = "joints, so101", "arm on a base"
SPACES = ("wheels", MONITORED, "joints", SO101, "tool", "impedance", MOBILE)
KINDS = ("steps", "reversals", "spirals", "at the limits", "huge", "not finite", "on the spot")
LIES = ("false", "drifting", "wrapped", "frozen", "counting twice", "from the future")
ROUNDING = 1.021  # a trajectory ends inside a tick
# [rad] that a stop may need, of joints and of wheels. A joint brakes from 2 rad/s within 0.2 rad, a wheel from its
# largest speed within 0.6, and one that carries an arm, whose stop is gentler, within 1.5; an arm that is found to be
# blocked for 50 ms goes on meanwhile.
_OF_ARM = dict.fromkeys(LIES, 0.2) | dict.fromkeys(("drifting", "frozen", "counting twice"), 0.35)
NEEDED: dict[str, dict[str, tuple[float, ...]]] = {
    "joints": {lie: (most,) for lie, most in _OF_ARM.items()},
    "wheels": dict.fromkeys(LIES, (0.6,)),
    MOBILE: {lie: (most, 1.5) for lie, most in _OF_ARM.items()},
}
# [rad/s, m/s] of joint and tool: a stop makes an arm no faster than this, or than it was, times what the servos of an
# arm that is speeding up lag behind.
SLOW, FASTER = (0.5, 0.25), 1.3


def wire_of_arm(arm: Arm, hz: int) -> tuple[Array, ...]:
    """Return the smallest and the largest command of an arm's actuators, its largest change, and of two changes."""
    limits, lead = arm.limits, np.asarray(arm.lead_s)
    effort = np.asarray(limits.effort[:-1])
    change = (np.asarray(limits.velocity) + 2 * lead * np.asarray(limits.stop_deceleration)) / hz
    bend = np.asarray(limits.stop_deceleration) * (1 / hz + 2 * lead) / hz
    # A joint that is led by its speed times a time passes the end of its range by no more than this while it stops.
    beyond = np.maximum(limits.stop_deceleration, limits.acceleration) * lead**2 / 2 + 1e-3
    lower, upper = np.asarray(limits.lower) - beyond, np.asarray(limits.upper) + beyond
    if arm.actuation == "torque":
        lower[:-1], upper[:-1], change[:-1] = -effort, effort, effort / 0.1 / hz
        bend[:-1] = np.inf
    return lower, upper, change, bend


def wire_of_drive(drive: Drive, hz: int) -> tuple[Array, ...]:
    """Return the same of wheels."""
    stop, most = drive.limits.stop_deceleration, drive.max_wheel_speed
    change = np.full(2, (stop[0] + stop[1] * drive.wheel_separation / 2) / drive.wheel_radius / hz)
    return np.full(2, -most), np.full(2, most), change, np.full(2, np.inf)


class Judge:
    """A plant between a cerebellum and its plant, which judges what is written.

    Attributes:
        writes: how many commands were written, of all robots.
        unsafe: how many of them were not safe.

    Args:
        simulation: whose plant it is.
    """

    def __init__(self, simulation: Any) -> None:
        self._plant, self.n = simulation.cerebellum.plant, simulation.n
        body, hz = simulation.body, simulation.rates.control_hz
        parts = [wire_of_arm(body.arm, hz)] if body.arm is not None else []
        if body.drive is not None:
            parts.append(wire_of_drive(body.drive, hz))
        lower, upper, change, bend = (np.concatenate(values) for values in zip(*parts, strict=True))
        self._lower, self._upper, self._change = lower - 1e-9, upper + 1e-9, change * ROUNDING + 1e-9
        self._bend = bend * ROUNDING + 1e-9
        self._last: Array | None = None
        self._rate: Array | None = None
        self._position = np.zeros((self.n, len(lower)))
        self.writes = self.unsafe = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def read(self, out: PlantReading) -> None:
        """Pass on, and remember where the joints are."""
        self._plant.read(out)
        self._position = out.position.copy()

    def write(self, ctrl: Array) -> None:
        """Judge and pass on."""
        safe = (ctrl >= self._lower) & (ctrl <= self._upper)  # false for what is not a number
        if self._last is not None:
            rate = ctrl - self._last
            safe &= np.abs(rate) <= self._change
            if self._rate is not None:  # a command may always come nearer to where the joint is
                nearer = rate * (self._position - ctrl) >= 0
                safe &= (np.abs(rate - self._rate) <= self._bend) | nearer
            self._rate = rate
        self.unsafe += int((~safe.all(axis=1)).sum())
        self.writes += len(ctrl)
        self._last = ctrl.copy()
        self._plant.write(ctrl)


def make(space: str, n: int) -> Any:
    """Return n simulated robots at the start of an episode."""
    if space in ("wheels", MONITORED):
        monitored = space == MONITORED
        base = Simulation(TurtleBot3Config(beams=360 if monitored else 36, collision_monitor=monitored), n)
        task = AvoidTask(AvoidConfig(), n, base.rates.fps)
        base.reset(np.arange(n), [task.sample(seed) for seed in range(n)], range(n))
        return base
    if space == SO101:
        small = Simulation(SO101Config(), n)
        small.reset(np.arange(n), [TableScene("empty", (), small.body.arm.home)] * n, range(n))
        return small
    if space == MOBILE:
        config = TurtleBot3ManipulationConfig(beams=36)
        mobile = Simulation(config, n)
        mobile.reset(np.arange(n), [config.start_scene()] * n, range(n))
        return mobile
    options: dict[str, Any] = {"joints": {}, "tool": {"action_space": "tool"}}.get(
        space, {"action_space": "tool", "control": "impedance"}
    )
    arm = Simulation(UR5Config(**options), n)
    arm.reset(np.arange(n), [TableScene("empty", (), arm.body.arm.home)] * n, range(n))
    return arm


def start_of(simulation: Any) -> Array:
    """Return the actions that keep the robots where they are."""
    command: Array = simulation.cerebellum.command
    if len(simulation.action_names) == command.shape[1]:
        return command.copy()
    tool = pose_vectors(simulation.kinematics.tool(command[:, :-1]))
    return np.concatenate([tool, command[:, -1:]], axis=1)


def ranges(space: str, first: Array) -> tuple[Array, Array]:
    """Return the smallest and the largest sensible action, each of shape (actions,)."""
    if space in ("wheels", MONITORED):
        return np.array([-0.22, -2.84]), np.array([0.22, 2.84])
    if space in ("joints", SO101):
        turns = np.full(len(first) - 1, 2 * np.pi)
        return np.array([*-turns, 0.0]), np.array([*turns, 0.085])
    if space == MOBILE:
        return np.array([*(-np.pi,) * 4, 0.0, -0.26, -1.82]), np.array([*(np.pi,) * 4, 0.055, 0.26, 1.82])
    lower, upper = first - 0.4, first + 0.4
    lower[3:7], upper[3:7], lower[7], upper[7] = -1.0, 1.0, 0.0, 0.085
    return lower, upper


class Stream:
    """The commands of one mad brain.

    Args:
        kind: one of `KINDS`.
        space: one of `SPACES`.
        first: the action that keeps the robot where it is, shape (actions,).
        rng: where chance comes from.
    """

    def __init__(self, kind: str, space: str, first: Array, rng: np.random.Generator) -> None:
        self.kind, self.first, self.rng = kind, first, rng
        self._poses = space in ("tool", "impedance")
        self._lower, self._upper = ranges(space, first)
        self._held = first

    def action(self, frame: int) -> Array:
        """Return the action of a frame, shape (actions,)."""
        lower, upper, rng = self._lower, self._upper, self.rng
        middle, half, width = (lower + upper) / 2, (upper - lower) / 2, len(lower)
        action = self._held.copy()
        match self.kind:
            case "steps":
                if frame % 8 == 0:
                    action = rng.uniform(lower, upper)
            case "reversals":
                action = (lower if frame % 2 else upper).copy()
            case "spirals":
                action = middle + half * 0.03 * frame * np.sin(0.4 * frame + np.arange(width))
            case "at the limits":
                if frame % 20 == 0:
                    action = np.where(rng.random(width) < 0.5, lower, upper)
            case "huge":
                action = middle + half * 10.0 ** rng.integers(0, 300) * rng.choice([-1.0, 1.0], width)
            case "not finite":
                action = middle + half * rng.uniform(-0.3, 0.3, width)
                if rng.random() < 0.5:
                    action[rng.integers(width)] = rng.choice([np.nan, np.inf, -np.inf])
            case _ if self._poses:
                w, x, y, z = self.first[3:7]
                axis = rng.normal(size=3) * 0.02 + 0.012 * frame  # 0.5 rad/s, and a tremor
                x, y, z, w = (Rotation.from_rotvec(axis) * Rotation.from_quat([x, y, z, w])).as_quat()
                action[3:7] = w, x, y, z
            case _:
                action = middle + half * np.sin(0.05 * frame * (1 + np.arange(width)))
        if self._poses and self.kind not in {"huge", "not finite", "on the spot"}:
            action[3:7] /= max(float(np.linalg.norm(action[3:7])), 1e-3)
        self._held = action
        return action


def vandalise(simulation: Any, rng: np.random.Generator) -> None:
    """Overwrite memory that other processes share, or a faulty controller would spoil, with random bytes."""
    queues, controller = simulation.cerebellum.fifo.queues, simulation.cerebellum.controller
    what, spoiled = rng.integers(4, size=2)
    if what == 0:
        queues["values"] = rng.integers(0, 2**63, queues["values"].shape, np.uint64).view(np.float64)
    elif what == 1:
        queues["due_ns"] = rng.integers(-(2**62), 2**62, queues["due_ns"].shape)
    elif what == 2:
        queues["waits"] = rng.random(queues["waits"].shape) < 0.5
    else:
        queues["tail"], queues["head"] = rng.integers(-(2**40), 2**40, (2, len(queues)))
    if spoiled < 2:
        chosen = rng.random(simulation.n) < 0.3
        own = (controller.command, controller.actuators)
        if controller.springs is not None:  # which takes neither for its reference
            own = (controller.springs["place"], controller.springs["opening"])
        values = own[spoiled]
        values[chosen] = rng.choice([np.nan, np.inf, -1e300, 3.0, 0.0], values[chosen].shape)


@dataclass
class Outcome:
    """What became of the streams of an action space."""

    streams: int = 0
    writes: int = 0
    unsafe: int = 0
    faults: int = 0
    refused: int = 0
    touched: int = 0


def run(space: str, streams: int, frames: int, seed: int) -> tuple[Outcome, Outcome]:
    """Run streams without and with vandals; robots that latched a fault are reset at the next frame."""
    outcomes = Outcome(), Outcome()
    for vandals, outcome in zip((False, True), outcomes, strict=True):
        simulation = make(space, streams)
        judge = simulation.cerebellum.plant = Judge(simulation)
        first = start_of(simulation)
        made = [
            Stream(KINDS[stream % len(KINDS)], space, first[stream], np.random.default_rng([seed, stream]))
            for stream in range(streams)
        ]
        vandal = np.random.default_rng([seed, 10**6])
        touched = np.zeros(streams, np.bool_)
        for frame in range(frames):
            actions = np.array([stream.action(frame) for stream in made])
            if vandals:
                vandalise(simulation, vandal)
            report = simulation.step(actions)
            touched |= np.any(simulation.touches, axis=0)
            outcome.refused += int((report.sent.reasons != 0).sum())
            fault = report.mode == Mode.FAULT
            outcome.faults += int(fault.sum())
            for request in (Request.RESET, Request.ACTIVATE):
                simulation.cerebellum.request(request, np.flatnonzero(fault))
        outcome.streams += streams
        outcome.touched = int(touched.sum())
        outcome.writes, outcome.unsafe = judge.writes, judge.unsafe
    return outcomes


@dataclass
class Followed:
    """What became of robots whose readings were none."""

    streams: int = 0
    stopped: int = 0
    unsafe: int = 0
    moved: tuple[float, ...] = ()
    faster: float = 0.0

    def is_short(self, space: str, lie: str) -> bool:
        """Return whether the stops were followed by no more motion than they need."""
        return all(moved <= most for moved, most in zip(self.moved, NEEDED[space][lie], strict=True))


class Liar:
    """A plant whose readings are falsified, of each robot from a tick of its own on.

    Attributes:
        dof: the joints of its arm.
        moved: how far each joint was, at the most, from where a stop found it [rad], shape (n, joints and wheels).
        faster: how many times as fast a joint or the tool was after the stop as in the 0.1 s before it, or as `SLOW`.

    Args:
        simulation: whose plant it is.
        lie: one of `LIES`.
        rng: where chance comes from.
    """

    def __init__(self, simulation: Any, lie: str, rng: np.random.Generator) -> None:
        self._plant, self.n, self._lie = simulation.cerebellum.plant, simulation.n, lie
        self._cerebellum, self._hz = simulation.cerebellum, simulation.rates.control_hz
        arm, drive = simulation.body.arm, simulation.body.drive
        self.dof = 0 if arm is None else len(arm.chain.joints)
        wheels = () if drive is None else range(len(simulation.body.joints) - 2, len(simulation.body.joints))
        self._columns = [*range(self.dof), *wheels]  # of joints and wheels
        joints = len(self._columns)
        self._begin, self._tick = rng.integers(self._hz // 4, self._hz, self.n), 0
        self._rows, self._joint = np.arange(self.n), rng.integers(joints, size=self.n)
        self._by = rng.uniform(0.12, 3.0, self.n) * rng.choice([-1, 1], self.n)
        self._held = np.zeros((self.n, joints))
        self._found, self._stopped = np.zeros((self.n, joints)), np.zeros(self.n, np.bool_)
        self.moved, self.faster = np.zeros((self.n, joints)), np.zeros(self.n)
        self._tool = ForwardKinematics(arm.chain) if arm is not None else None
        self._speeds = np.zeros((self._hz // 10, 2, self.n))  # of the fastest joint, and of the tool
        self._before, self._last = np.zeros((2, self.n)), np.full((self.n, joints), np.nan)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def read(self, out: PlantReading) -> None:
        """Read, and falsify."""
        self._plant.read(out)
        position, velocity = out.position[:, self._columns], out.velocity[:, self._columns]
        self._measure(position.copy())
        since = self._tick - self._begin
        lies, rows, joint = since >= 0, self._rows, self._joint
        self._held = np.where((since <= 0)[:, None], position, self._held)
        out.stamp_ns = np.full(self.n, self._tick * 10**9 // self._hz)
        if self._lie == "false":
            position[rows, joint] += self._by * lies
        elif self._lie == "drifting":
            position[rows, joint] += self._by * np.maximum(since, 0) / self._hz
            velocity[rows, joint] += self._by * lies
        elif self._lie == "wrapped":
            wrapped = (position + self._by[:, None]) % (2 * np.pi) - self._by[:, None]
            position[:] = np.where(lies[:, None], wrapped, position)
        elif self._lie == "counting twice":
            position[:] = np.where(lies[:, None], 2 * position - self._held, position)
            velocity[lies] *= 2
        elif self._lie == "frozen":
            position[:] = np.where(lies[:, None], self._held, position)
            velocity[lies] = 0.0
        else:
            out.stamp_ns += np.where(lies, np.abs(self._by * 1e9), 0).astype(np.int64)
        out.position[:, self._columns], out.velocity[:, self._columns] = position, velocity
        self._tick += 1

    def _measure(self, position: Array) -> None:
        stopped = self._cerebellum.mode >= Mode.ESTOP
        new = stopped & ~self._stopped
        self._found[new], self._stopped = position[new], stopped
        away = np.abs(position - self._found)
        np.maximum(self.moved, away, out=self.moved, where=stopped[:, None])
        rate = np.nan_to_num(position - self._last) * self._hz
        self._last = position.copy()
        speed = np.abs(rate[:, : self.dof or 2]).max(axis=1), np.zeros(self.n)
        if self._tool is not None:
            moves = self._tool.jacobian(position[:, : self.dof])[:, :3] @ rate[:, : self.dof, None]
            speed = speed[0], np.linalg.norm(moves[..., 0], axis=1)
        self._before[:, new] = self._speeds[:, :, new].max(axis=0)
        faster = (np.array(speed) / np.maximum(self._before, np.array(SLOW)[:, None])).max(axis=0)
        np.maximum(self.faster, faster, out=self.faster, where=stopped & ~new)
        self._speeds[self._tick % len(self._speeds)] = speed


def deceive(space: str, lie: str, streams: int, frames: int, seed: int) -> Followed:
    """Run robots that sway, and whose readings become false."""
    simulation = make(space, streams)
    rng = np.random.default_rng([seed, LIES.index(lie), SPACES.index(space)])
    liar = simulation.cerebellum.plant = Liar(simulation, lie, rng)
    judge = simulation.cerebellum.plant = Judge(simulation)
    first, gripper = start_of(simulation), liar.dof
    size, rate = rng.uniform(0.1, 0.5, first.shape), rng.uniform(0.5, 2.0, first.shape)
    for frame in range(frames):
        action = first + size * np.sin(rate * frame / simulation.rates.fps)
        if simulation.body.arm is not None:
            action[:, gripper] = first[:, gripper]
        simulation.step(action)
    parts = (liar.moved[:, : liar.dof], liar.moved[:, liar.dof :])
    moved = tuple(float(part.max()) for part in parts if part.size)
    stopped = int((simulation.modes == Mode.FAULT).sum())
    return Followed(streams, stopped, judge.unsafe, moved, float(liar.faster.max()))


def impedance_table(streams: int, frames: int, seed: int) -> tuple[Table, int]:
    """Attack impedance control; return a table of what came of it, and how many writes and attacks were not safe."""
    unsafe = 0
    forced = Table(title="Impedance control")
    for column in (
        "attack",
        "streams",
        "stopped",
        "unsafe",
        "tool",
        "joint",
        "motion after the stop",
        "force",
        "later",
    ):
        forced.add_column(column, justify="left" if column == "attack" else "right")
    for kind in ATTACKS:
        arm = make("impedance", streams)
        judge = arm.cerebellum.plant = Judge(arm)
        effect = attack(arm, kind, frames, seed)
        unsafe += judge.unsafe + (not effect.is_safe(kind))
        forced.add_row(
            kind,
            f"{streams:,}",
            f"{100 * effect.stopped:.0f} %",
            f"{judge.unsafe:,}",
            f"{effect.speed:.2f} m/s",
            f"{effect.joint_speed:.2f} rad/s",
            f"{effect.moved:.3f} rad",
            f"{effect.force:.0f} N",
            f"{effect.pressed:.0f} N",
        )
    return forced, unsafe


def main(arguments: list[str] | None = None) -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=1000, help="of each action space, and again with vandals")
    parser.add_argument("--frames", type=int, default=60, help="of each stream")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--spaces", nargs="+", choices=SPACES, default=SPACES, help="the action spaces")
    options = parser.parse_args(arguments)
    console = Console(width=120)
    table = Table(title="What was written to the plants")
    for column in (
        "actions",
        "memory",
        "streams",
        "writes",
        "unsafe",
        "frames in FAULT",
        "commands refused",
        "touched",
    ):
        table.add_column(column, justify="left" if column in ("actions", "memory") else "right")
    unsafe = 0
    with np.errstate(all="ignore"):
        for space in options.spaces:
            outcomes = run(space, options.streams, options.frames, options.seed)
            for memory, one in zip(("as it is", "garbage"), outcomes, strict=True):
                unsafe += one.unsafe
                numbers = (one.streams, one.writes, one.unsafe, one.faults, one.refused, one.touched)
                table.add_row(space, memory, *(f"{number:,}" for number in numbers))
    console.print(table)
    lies = Table(title="Readings that are no measurements")
    for column in (
        "robot",
        "reading",
        "streams",
        "stopped",
        "unsafe",
        "largest motion after the stop",
        "times as fast",
    ):
        lies.add_column(column, justify="left" if column in ("robot", "reading") else "right")
    for space in (one for one in NEEDED if one in options.spaces):
        for lie in LIES:
            told = deceive(space, lie, options.streams, options.frames, options.seed)
            unsafe += told.unsafe + (not told.is_short(space, lie)) + (space != "wheels" and told.faster > FASTER)
            counts = (f"{told.streams:,}", f"{told.stopped:,}", f"{told.unsafe:,}")
            lies.add_row(space, lie, *counts, " / ".join(f"{way:.3f} rad" for way in told.moved), f"{told.faster:.2f}")
    console.print(lies)
    if "impedance" in options.spaces:
        table, found = impedance_table(options.streams, options.frames, options.seed)
        console.print(table)
        unsafe += found
    return status(met=not unsafe)


if __name__ == "__main__":
    sys.exit(main())
