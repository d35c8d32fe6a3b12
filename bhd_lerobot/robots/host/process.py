"""The real-time process: the cerebellum of one robot, and its plant, ticking on the wall clock.

The plant is a simulated world or, with `robot.plant`, another package's class, which talks to a robot.

Started by `LiveLink` as a program of its own, ``python -m bhd_lerobot.robots.host.process``, never forked and not by
`multiprocessing`, whose children import the main module of their parent: it imports neither torch nor LeRobot, and
MuJoCo only for a simulated robot. While its loop stands it takes messages from a pipe; while the loop runs it reads
shared memory only.
"""

import contextlib
import gc
import os
import pkgutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from bhd_lerobot.bodies.body import Body, Rates
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Request, Watchdog
from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.block import LiveBlock, Phase, Word
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.realtime.limits import LoopLimits
from bhd_lerobot.realtime.loop import RealtimeLoop
from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings
from bhd_lerobot.realtime.requests import RequestServer
from bhd_lerobot.realtime.timing import TimingStatistics
from bhd_lerobot.robots.host.checked_plant import CheckedPlant
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.state import StatePublisher
from bhd_lerobot.ros2.live.network import NetworkConfig

if TYPE_CHECKING:  # it takes 100 MB, and a base plans nothing
    from bhd_lerobot.control.motion.planning import Planning

_WARM_UP_S = 0.2  # ticks before the first real one: caches, pages and branches are as they will be
_POLL_S = 0.02
_ORPHAN_S = 5.0  # so long at the most a robot whose brain is gone may take to come to rest before the process ends


@dataclass(frozen=True)
class LiveSpec:
    """What the process is to run; everything in it can be pickled without LeRobot.

    Attributes:
        host: module and class of the simulation, or of the host of a plant, ``"package.module:Class"``.
        plant: module and class of the plant that is driven; empty for a simulated one.
    """

    host: str
    plant: str
    values: dict[str, Any]
    rates: Rates
    body: Body
    block: str
    privileges: RealtimeSettings
    limits: LoopLimits

    @classmethod
    def of(cls, host: Host, block: str) -> Self:
        """Return what runs a host like one of this process, with the block that its robot publishes in."""
        config: Any = host.config
        kind = getattr(host, "runs", type(host))
        kinds = (bool, int, float, str, tuple, type(None), np.integer, np.floating, NetworkConfig)
        return cls(
            host=f"{kind.__module__}:{kind.__qualname__}",
            plant=config.plant,
            # Those that a simulation or a plant reads, and that need no class of LeRobot.
            values={key: value for key, value in vars(config).items() if isinstance(value, kinds)}
            | getattr(config, "plant_values", dict)(),
            rates=host.rates,
            body=host.body,
            block=block,
            privileges=config.realtime.privileges(config.require_realtime),
            limits=config.realtime.limits(),
        )

    @property
    def _config(self) -> Any:
        body = self.body
        return SimpleNamespace(**self.values, rates=self.rates, body=lambda: body)

    @property
    def oldest_ns(self) -> int:
        """A reading of a plant that is older than this is none of the present [ns]; at least three ticks."""
        return max(3 * NANOSECONDS // self.rates.control_hz, round(self.limits.plant_timeout_s * NANOSECONDS))

    def make_plant(self) -> CheckedPlant:
        """Return the plant; it is not opened yet."""
        return CheckedPlant.made(self.plant, self._config, self.body, self.oldest_ns)

    def make_host(self, plant: CheckedPlant | None = None, planning: "Planning | None" = None) -> Any:
        """Return the host of a plant, or without one a simulation of one robot."""
        planned = () if planning is None else (planning,)
        return pkgutil.resolve_name(self.host)(self._config, *((plant,) if plant else (1, 1)), *planned)


class LiveProcess:
    """The process's side of the pipe."""

    def __init__(self, spec: LiveSpec, connection: Connection) -> None:
        self._connection = connection
        self._block = LiveBlock.attach(spec.block)
        self._words = self._block.words
        planning: Planning | None = None
        if len(plans := self._block.section("plan")) and spec.body.arm is not None:
            from bhd_lerobot.realtime.planning_link import PlanningLink

            arm = spec.body.arm
            planning = PlanningLink(plans, len(arm.chain.joints), len(arm.limits.names), spec.rates.control_hz)
        self._plant = spec.make_plant() if spec.plant else None
        if self._plant is not None:
            self._plant.open()
        self._host: Host = spec.make_host(self._plant, planning=planning)
        cerebellum = self._host.cerebellum
        cerebellum.fifo, cerebellum.estop = self._block.fifo, self._block.estop
        self._host.load()
        self._requests = RequestServer(cerebellum, self._block.requests, self._block.events)
        self._publisher = StatePublisher(
            self._host, self._block.ring, age_ns=self._age_ns if self._plant else None, problem=self._problem
        )
        # A tick is for the time that it was due at. How far stamps are ahead of now is checked where they are read.
        cerebellum.readings.accept_until(spec.oldest_ns, spec.oldest_ns)
        period = NANOSECONDS // spec.rates.control_hz
        self._statistics = TimingStatistics(period, self._block.section("statistics"))
        self._warm_up_ticks = round(_WARM_UP_S * spec.rates.control_hz)
        self._brain = int(self._block.about["brain_pid"])
        self._orphan_ticks = 0
        self._standing_ticks = 0
        self._most_orphan_ticks = round(_ORPHAN_S * spec.rates.control_hz)
        self._warm = False
        self._loop = RealtimeLoop(
            cerebellum,
            self._words,
            spec.limits,
            serve=self._serve,
            run=self._host.run_tick,
            publish=self._publisher.publish,
            count=self._statistics.add,
            may_stand=None if self._plant is None else self._may_stand,
        )

    def work(self) -> None:
        """Take messages until the brain's process says end, or is gone; one that it forked may hold the pipe open."""
        answers: dict[str, Callable[..., Any]] = {"place": self._place, "run": self._run}
        while not self._words[Word.END] and os.getppid() == self._brain:
            self._words[Word.PHASE] = Phase.STANDING
            self._block.show_life(Word.CEREBELLUM_ALIVE)
            if not self._connection.poll(_POLL_S):
                continue
            try:
                kind, *arguments = self._connection.recv()
            except EOFError:
                return
            if kind == "end":
                return
            try:
                self._connection.send((kind, answers[kind](*arguments)))
            except BhdError as error:
                self._connection.send(("refused", str(error)))
            except BrokenPipeError:
                return

    def _place(self, scene: Any, seed: int) -> None:
        if not self._warm:
            self._warm_up(scene, seed)
        self._reset(scene, seed)

    def _reset(self, scene: Any, seed: int) -> None:
        if self._plant is not None:
            self._plant.prepare(self._host.cerebellum.reading)
        self._host.reset(np.zeros(1, np.intp), [scene], [seed])
        gc.collect()  # the loop runs without a collector

    def _warm_up(self, scene: Any, seed: int) -> None:
        """Run ticks before the first real one: first executions take longest."""
        self._reset(scene, seed)
        if self._plant is not None:
            self._plant.is_muted = True
        grid = TickGrid(0, self._loop.period_ns)
        for tick in range(self._warm_up_ticks):
            self._host.cerebellum.stamp_origin_ns = time.monotonic_ns() - tick * self._loop.period_ns
            self._host.run_tick(tick * self._loop.period_ns, 1)
            self._requests.serve(0)
            self._publisher.publish(Slot(tick, 0, 0, 0), 0, 0, grid)
            self._statistics.add(0, 0, 0, 0)
        if self._plant is not None:
            self._plant.is_muted = False
        self._warm = True

    def _run(self, start_ns: int) -> tuple[int, int]:
        """Run a segment that begins at a monotonic time [ns]."""
        self._statistics.reset()
        self._publisher.restart(int(self._words[Word.SEGMENT]) + 1)
        # What is so before the first tick: the first frame's observation.
        before = Slot(-1, start_ns - self._loop.period_ns, 0, 0)
        self._publisher.publish(before, before.due_ns, before.due_ns, TickGrid(start_ns, self._loop.period_ns))
        self._standing_ticks = 0
        grid = self._loop.run(start_ns)
        self._publisher.restate()
        return grid.executed, grid.skipped

    def _problem(self) -> str:
        plant, cerebellum = self._plant, self._host.cerebellum
        self._words[Word.PLANT_LOST] = plant is not None and plant.is_lost
        named = cerebellum.readings.problem or (plant.not_ready(cerebellum.reading) if plant else "")
        cause = cerebellum.controller.cause
        return named or cerebellum.readings.silence or f"{cause} {plant.hint if cause and plant else ''}".rstrip(" .")

    def _serve(self, now_ns: int) -> None:
        self._requests.serve(time.monotonic_ns())  # they expire on the clock that both processes share
        if os.getppid() == self._brain:
            return
        # The brain's process has ended: come to rest (its watchdog sees to that, a real robot stops at once), then end.
        self._orphan_ticks += 1
        if self._plant is not None:
            self._host.cerebellum.interrupt(Watchdog.BRAIN, Mode.FAULT)
        moving = self._host.cerebellum.mode[0] in (Mode.TRACKING, Mode.STOPPING)
        if not moving or self._orphan_ticks > self._most_orphan_ticks:
            self._words[Word.END] = 1

    def _may_stand(self) -> bool:
        """Bring a robot that continues without the loop to rest; return whether it is."""
        cerebellum = self._host.cerebellum
        mode = cerebellum.mode[0]
        if mode in (Mode.HOLD, Mode.TRACKING):
            cerebellum.request(Request.DEACTIVATE)
        self._standing_ticks += 1
        moves = mode in (Mode.HOLD, Mode.TRACKING, Mode.STOPPING) or not cerebellum.controller.at_rest()[0]
        return not moves or self._standing_ticks > self._most_orphan_ticks

    def _age_ns(self) -> int:
        """Return how long ago the newest of what a plant reads was measured [ns]."""
        reading = self._host.cerebellum.reading
        if reading.stamp_ns is None:
            return 0
        newest = int(reading.stamp_ns[0])
        newest = max(newest, int(reading.sensors_ns[0])) if reading.sensors.shape[1] else newest
        return max(0, time.monotonic_ns() - newest)

    def close(self) -> None:
        """Free everything."""
        self._words[Word.PHASE] = Phase.ENDED
        if self._plant is not None:
            self._plant.close()
        self._host.close()
        self._block.close()


def main() -> int:
    """Run the process; its one argument is the descriptor of its pipe."""
    connection = Connection(int(sys.argv[1]))
    # Keys of the terminal are for the brain's process, which decides what becomes of the robot.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec: LiveSpec = connection.recv()
    try:
        with Privileges() as privileges:
            process = LiveProcess(spec, connection)
            try:
                grants = [grant.as_dict() for grant in privileges.acquire(spec.privileges)]
                heavy = sorted({"torch", "lerobot", "mujoco"} & set(sys.modules))
                connection.send(("ready", {"grants": grants, "pid": os.getpid(), "heavy": heavy}))
                process.work()
            finally:
                process.close()
    except BhdError as error:
        _send_failure(connection, str(error))
        return 2
    except Exception:
        _send_failure(connection, traceback.format_exc())
        return 1
    return 0


def _send_failure(connection: Connection, message: str) -> None:
    with contextlib.suppress(OSError):  # the brain's process has ended
        connection.send(("failed", message))


if __name__ == "__main__":
    sys.exit(main())
