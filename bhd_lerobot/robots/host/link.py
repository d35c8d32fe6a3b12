"""Starts, feeds and ends the real-time process of one robot on the wall clock, from the brain's process."""

import contextlib
import math
import os
import pickle
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.scenes import scene_to_json
from bhd_lerobot.control.kernels import fence
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.programs import start_program
from bhd_lerobot.realtime.block import LiveLayout, Word
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.process import LiveSpec
from bhd_lerobot.robots.host.state import published_dtype

_LIFE_S = 0.02  # between two signs of life of this process
_START_S = 120.0  # that a process may take to import, build its model and warm up
_ANSWER_S = 30.0  # that it may take to place a scene
_HEAD_START_S = 0.02  # from the order to run to the first tick
_END_S = 10.0  # that a process has to end in order before it is killed; a LeRobot device may take half of it
_FIFO = 256
_REST_S = 0.002  # between two checks of the planner for a request


class LiveLink:
    """The real-time process of one robot.

    Attributes:
        block: what both processes share.
        planner: plans goals, on a thread; None for a robot that takes none.
        grants: what the real-time process was granted or refused, as plain values.

    Args:
        mirror: a host like the one that is to run; this process's image of the robot.
    """

    def __init__(self, mirror: Host, config: Any, name: str) -> None:
        realtime: RealtimeConfig = config.realtime
        rates = mirror.rates
        goals = getattr(mirror.cerebellum.controller, "goals", None)
        dof, plans = 0 if mirror.body.arm is None else len(mirror.body.arm.chain.joints), 0
        if goals is not None:  # planning takes 100 MB, and a base plans nothing
            from bhd_lerobot.realtime.planning_link import PlanningLink, PlanServer

            plans = PlanningLink.nbytes(dof, len(mirror.body.need(Arm).limits.names), rates.control_hz)
        layout = LiveLayout(
            published_dtype(mirror),
            max(64, math.ceil(realtime.buffer_s * rates.control_hz) + 2),
            mirror.cerebellum.width,
            _FIFO,
            dof,
            plans,
        )
        about = {
            "robot": config.type,
            "fps": rates.fps,
            "control_hz": rates.control_hz,
            "actions": list(mirror.action_names),
            "commands": list(mirror.body.limits.names),
            "observations": list(mirror.sensed_names),
            "drives": mirror.body.drive is not None,
            "brain_pid": os.getpid(),
        }
        self.grants: list[dict[str, Any]] = []
        self._plant: str = config.plant
        self._process: subprocess.Popen[bytes] | None = None
        self._stop = threading.Event()
        self._failure = ""
        self._threads: list[threading.Thread] = []
        self.block = layout.create(name, about)
        self.planner: PlanServer | None = None
        if goals is not None:
            self.planner = PlanServer(self.block.section("plan"), goals.planner)
            pause = partial(time.sleep, _REST_S)
            plan = threading.Thread(target=self.planner.serve, args=(self._stop.is_set, pause), daemon=True)
            self._threads.append(plan)
        ours, theirs = socket.socketpair()
        self._pipe = Connection(ours.detach())
        try:
            with theirs:
                self._start(mirror, theirs.fileno())
        except BaseException:
            self.close()
            raise

    def _start(self, mirror: Host, descriptor: int) -> None:
        spec = LiveSpec.of(mirror, self.block.name)
        pickle.dumps(spec)  # what cannot be sent is found out before a process waits for it
        self._process = start_program("bhd_lerobot.robots.host.process", descriptor, descriptors=(descriptor,))
        self._pipe.send(spec)
        self.block.show_life(Word.BRAIN_ALIVE)
        self._threads.append(threading.Thread(target=self._live, name="bhd-brain-life", daemon=True))
        for thread in self._threads:
            thread.start()
        self.about = self._answer("ready", _START_S)
        self.grants = self.about["grants"]

    @property
    def pid(self) -> int:
        """Number of the real-time process."""
        return 0 if self._process is None else self._process.pid

    def place(self, scene: Any, seed: int) -> None:
        """Put the robot into a scene, at rest; its loop stands."""
        self.pause()
        self._ask("place", scene, seed)
        self._answer("place", _ANSWER_S)
        self.block.publish_scene(scene_to_json(scene))

    def run(self) -> int:
        """Start the loop; return when its tick 0 is due, monotonic [ns]."""
        words = self.block.words
        words[Word.PAUSE] = 0
        segment = int(words[Word.SEGMENT])
        start = time.monotonic_ns() + round(_HEAD_START_S * NANOSECONDS)
        self._ask("run", start)
        self._running = True
        self._until(lambda: words[Word.SEGMENT] > segment, _ANSWER_S, "The loop did not start")
        fence()
        return start

    _running = False

    def pause(self) -> None:
        """Let the loop stand; the simulated world stands still with it."""
        if self._running:
            self.block.words[Word.PAUSE] = 1
            self._answer("run", _ANSWER_S)
            self._running = False

    def check(self) -> None:
        """Raise if the process has ended."""
        status = None if self._process is None else self._process.poll()
        if status is None:
            return
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        what = "The plant stops the robot by itself." if self._plant else "The simulated robot ended with it."
        raise RealtimeError(f"The cerebellum's process {how}. {what} Episodes that were saved are intact.{self._why()}")

    def _why(self) -> str:
        """Return what the process that has ended sent of it, on lines of its own."""
        with contextlib.suppress(EOFError, OSError):
            while self._pipe.poll():
                kind, value = self._pipe.recv()
                self._failure = f"\n{value}" if kind == "failed" else self._failure
        return self._failure

    def close(self) -> None:
        """End the process. May be called twice."""
        if self._stop.is_set():
            return
        words = self.block.words
        words[Word.PAUSE] = words[Word.END] = 1
        with contextlib.suppress(OSError):
            self._pipe.send(("end",))
        if (process := self._process) is not None:
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()  # stopped, or stuck: nothing it holds survives it
                process.wait()
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(5.0)
        self._pipe.close()
        self.block.close()

    # --- waiting -----------------------------------------------------------------------------------------------------

    def _live(self) -> None:
        while not self._stop.wait(_LIFE_S):
            self.block.show_life(Word.BRAIN_ALIVE)

    def wait(self) -> None:
        """Wait for about a tick."""
        self.check()
        time.sleep(0.0005)

    def _until(self, condition: Callable[[], Any], seconds: float, message: str) -> None:
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise RealtimeError(f"{message} within {seconds:g} s.")
            self.wait()

    def _ask(self, kind: str, *arguments: Any) -> None:
        try:
            self._open_pipe().send((kind, *arguments))
        except OSError:
            self.check()
            raise

    def _open_pipe(self) -> Connection:
        if self._stop.is_set():
            raise RealtimeError("The robot's process has ended.")
        return self._pipe

    def _answer(self, wanted: str, seconds: float) -> Any:
        connection = self._open_pipe()
        end = time.monotonic() + seconds
        while not connection.poll(0.01):
            self.check()
            if time.monotonic() > end:
                raise RealtimeError(f"The cerebellum's process did not answer ({wanted}) within {seconds:g} s.")
        try:
            kind, value = connection.recv()
        except (EOFError, OSError):
            if self._process is not None:
                self._process.wait(5.0)
            self.check()
            raise RealtimeError("The cerebellum's process closed its pipe.") from None
        if kind in ("failed", "refused"):
            raise RealtimeError(f"The cerebellum's process refused the request: {value}")
        if kind != wanted:
            raise RealtimeError(f"The cerebellum's process answered {kind!r} where {wanted!r} was expected.")
        return value
