"""Readings that are no measurements, surroundings that change and brains without sense, against impedance control.

Truth is the simulator's. Walls are stiff springs that push on the tool, so that each arm can have its own.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]

LIES = ("frozen", "one frozen", "wrong sign", "late", "drifting positions", "drifting", "false", "from the future")
SURROUNDINGS = ("wall", "vanishing wall", "switching stiffness", "stiff, vanishing wall")
ATTACKS = (*LIES, *SURROUNDINGS)
LATE_TICKS = 25
WALL = (2e4, 100.0)  # [N/m, N s/m]
_SOFT = Compliance((0.0,) * 6, max_force=120.0, max_moment=20.0)
_STIFF = Compliance((5000.0,) * 3 + (300.0,) * 3, max_force=120.0, max_moment=20.0)
# Largest speed of a tool [m/s]: 0.25 is the equilibrium's. What drifts moves the tool by its own speed as well.
MOST_SPEED = dict.fromkeys(ATTACKS, 0.45) | {"late": 0.7, "drifting": 0.7} | dict.fromkeys(SURROUNDINGS, 0.3)
MOST_FORCE = 130.0  # [N] on a wall; what remains of it half a second after a stop is less than 20 N
MOST_MOTION = 0.1  # [rad] of a joint after a stop


@dataclass
class Effect:
    """What an attack did.

    Attributes:
        stopped: share of the arms that were stopped, in `FAULT`.
        speed: largest speed of a tool [m/s].
        joint_speed: largest speed of a joint [rad/s].
        moved: largest way of a joint from where a stop found it [rad].
        force: largest force on a wall [N].
        pressed: largest force half a second after a stop or later [N].
    """

    stopped: float
    speed: float
    joint_speed: float
    moved: float
    force: float
    pressed: float

    def is_safe(self, attack: str) -> bool:
        """Return whether it is within what is stated here."""
        within = self.speed <= MOST_SPEED[attack] and self.moved <= MOST_MOTION
        return within and self.force <= MOST_FORCE and self.pressed <= 20.0


class Liar:
    """A plant whose readings are falsified, of each arm from a tick of its own on; see `ATTACKS`."""

    def __init__(self, simulation: Any, attack: str, rng: np.random.Generator) -> None:
        self._plant, self.n, self._attack = simulation.cerebellum.plant, simulation.n, attack
        self._hz, self._tick = simulation.rates.control_hz, 0
        self._begin = np.zeros(self.n, int) if attack == "late" else rng.integers(self._hz // 4, self._hz, self.n)
        self._rows, self._joint = np.arange(self.n), rng.integers(6, size=self.n)
        self._by = rng.uniform(0.05, 0.3, self.n) * rng.choice([-1, 1], self.n)
        self._past: list[Array] = []
        self._held = np.zeros((2, self.n, 6))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def read(self, out: PlantReading) -> None:
        """Read, and falsify."""
        self._plant.read(out)
        position, velocity = values = out.position[:, :6], out.velocity[:, :6]
        rows, joint = self._rows, self._joint
        since = self._tick - self._begin
        lies = since >= 0
        self._held = np.where((since <= 0)[:, None], values, self._held)
        self._past = [*self._past[-LATE_TICKS:], np.array(values)]
        out.stamp_ns = np.full(self.n, self._tick * 10**9 // self._hz)
        match self._attack:
            case "frozen":
                position[lies], velocity[lies] = self._held[0, lies], 0.0
            case "one frozen":
                position[rows[lies], joint[lies]] = self._held[0, rows[lies], joint[lies]]
                velocity[rows[lies], joint[lies]] = 0.0
            case "wrong sign":
                velocity[lies] *= -1.0
            case "late":
                position[:], velocity[:] = self._past[0]
            case "drifting positions" | "drifting":
                position[rows, joint] += self._by * np.maximum(since, 0) / self._hz
                velocity[rows, joint] += self._by * lies * (self._attack == "drifting")
            case "false":
                position[rows, joint] += self._by * lies
            case "from the future":
                out.stamp_ns += np.where(lies, np.abs(self._by * 1e9), 0).astype(np.int64)
        self._tick += 1


class Surroundings:
    """Walls before the tools, which may vanish; and what the simulator says of the arms, tick by tick."""

    def __init__(self, simulation: Any, attack: str, first: Array, rng: np.random.Generator) -> None:
        world, n = simulation.world, simulation.n
        self._simulation, self._step, self._n = simulation, world.step, n
        self._applied, self._gripper = world.derived("xfrc_applied"), world.model.body("gripper").id
        self._centre, self._tool = world.derived("xipos"), world.site("tool").position
        self._is_there, self.face = attack in SURROUNDINGS, first[:, 0] + rng.uniform(0.02, 0.08, n)
        hz = simulation.rates.control_hz
        self._vanishes = rng.integers(hz, 2 * hz, n) if "vanishing" in attack else np.full(n, np.iinfo(int).max)
        self._hz, self._tick, self._before = hz, 0, self._tool.copy()
        self._stopped_at, self._found = np.full(n, -1), np.zeros((n, 6))
        self.speed = self.joint_speed = self.moved = self.force = self.pressed = 0.0
        world.step = self._advance

    def _advance(self, *arguments: Any, **options: Any) -> None:
        force = self._push() if self._is_there else np.zeros(self._n)
        self._before = self._tool.copy()
        self._step(*arguments, **options)
        self._tick += 1
        world = self._simulation.world
        position, stopped = world.qpos[:, :6], self._simulation.cerebellum.mode >= Mode.ESTOP
        new = stopped & (self._stopped_at < 0)
        self._found[new], self._stopped_at[new] = position[new], self._tick
        long = stopped & (self._tick > self._stopped_at + self._hz // 2)
        self.speed = max(self.speed, float(np.linalg.norm(self._tool - self._before, axis=1).max()) * self._hz)
        self.joint_speed = max(self.joint_speed, float(np.abs(world.qvel[:, :6]).max()))
        self.moved = max(self.moved, float((np.abs(position - self._found)[stopped]).max(initial=0.0)))
        self.force, self.pressed = max(self.force, force.max()), max(self.pressed, force[long].max(initial=0.0))

    def _push(self) -> Array:
        """Let the walls push on the tools; return the forces [N], shape (n,)."""
        stiffness, damping = WALL
        depth, speed = self._tool[:, 0] - self.face, (self._tool - self._before)[:, 0] * self._hz
        is_in = (depth > 0) & (self._tick < self._vanishes)
        force = np.where(is_in, np.maximum(stiffness * depth + damping * speed, 0.0), 0.0)
        self._applied[:, self._gripper] = 0.0
        self._applied[:, self._gripper, 0] = -force
        lever = self._tool - self._centre[:, self._gripper]
        self._applied[:, self._gripper, 3:] = np.cross(lever, self._applied[:, self._gripper, :3])
        return force


def attack(simulation: Any, kind: str, frames: int, seed: int) -> Effect:
    """Attack arms whose tools are commanded 0.1 m to either side, or 0.2 m into a wall.

    Args:
        simulation: arms under impedance control, at the start of an episode.
        kind: one of `ATTACKS`.
        frames: how many are commanded.
    """
    rng = np.random.default_rng([seed, ATTACKS.index(kind)])
    first = simulation.cerebellum.command.copy()
    simulation.cerebellum.plant = Liar(simulation, kind, rng)
    around = Surroundings(simulation, kind, first, rng)
    rate = rng.uniform(1.0, 8.0, (simulation.n, 3))
    if kind.startswith("stiff"):
        simulation.controller.set_compliance(_STIFF)
    for frame in range(frames):
        if kind == "switching stiffness":
            simulation.controller.set_compliance(_STIFF if frame % 2 else _SOFT)
        action = first.copy()
        if kind in SURROUNDINGS:
            action[:, 0] = around.face + 0.2
        else:
            action[:, :3] += 0.1 * np.sign(np.sin(rate * frame / simulation.rates.fps))
        simulation.step(action)
    stopped = float((simulation.modes == Mode.FAULT).mean())
    return Effect(stopped, around.speed, around.joint_speed, around.moved, around.force, around.pressed)
