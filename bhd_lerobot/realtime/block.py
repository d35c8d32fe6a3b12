"""What brain, cerebellum and monitor of one running robot share: words, queues, states.

The words are 64-bit integers, each written by one process (those that any may write are marked), and read by all.
"""

import time
from dataclasses import dataclass
from enum import IntEnum
from importlib.metadata import version
from typing import Any, Self

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from bhd_lerobot.control.estop_word import EstopWord
from bhd_lerobot.control.fifo import CommandFifo, StateRing
from bhd_lerobot.control.record import STATE
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.mailbox import Mailbox
from bhd_lerobot.realtime.requests import EVENT_DTYPE, request_dtype
from bhd_lerobot.realtime.shared_memory import SharedBlock
from bhd_lerobot.realtime.timing import TimingStatistics

WORDS = 64
_REQUESTS, _EVENTS = 16, 64
_VERSION = version("lerobot_robot_bhd")
_SCENE = np.dtype([("text", "S32768")])


class Word(IntEnum):
    """Where each word is."""

    START = 0
    """Monotonic time of tick 0 of the present segment [ns]; the cerebellum's time counts from there."""
    SEGMENT = 1
    """How often the loop has been started."""
    PHASE = 2
    """A `Phase`."""
    PAUSE = 3
    """Not 0: the loop is to stand still. Written by the brain's process."""
    END = 4
    """Not 0: the process is to end. Written by the brain's process."""
    ESTOP = 5
    """The last press of the emergency stop, monotonic [ns]: see `EstopWord`. Any process may write it."""
    ESTOP_ACKNOWLEDGED = 6
    """The press that a reset acknowledged; if it is not the last one: emergency stop. Written by the cerebellum."""
    ESTOP_LATCHED = 7
    """The last press that a tick has seen: what a reset may acknowledge. Written by the cerebellum."""
    BRAIN_ALIVE = 8
    """When the brain's process last showed that it lives, monotonic [ns]; 0: it is not watched."""
    CEREBELLUM_ALIVE = 9
    """The same of the cerebellum's process."""
    PLANT_LOST = 12
    """Not 0: what drives the robot has ended, and a reset cannot help. Written by the cerebellum."""
    CATCH_UP_LOST = 19
    """Ticks of the present segment by which the simulation fell behind, beyond what it may catch up at once."""
    RECORDER_FRAMES = 24
    """Frames of it that the brain's process has read. Written by the brain's process, as is the next."""
    RECORDER_DROPS = 25
    """States of it that were overwritten before the brain's process read them."""


class Phase(IntEnum):
    """What the loop's process is doing."""

    STARTING = 0
    """Importing, building the model, asking for privileges, warming up."""
    STANDING = 1
    """Ready; no tick runs, and the plant stands still."""
    RUNNING = 2
    """Ticks run."""
    ENDED = 3
    """The process has ended in order."""


@dataclass(frozen=True)
class LiveLayout:
    """Sizes of everything in a block.

    Attributes:
        state: dtype of the states.
        ring_capacity: states that a reader may lag behind.
        width: values in a command.
        fifo_capacity: commands that may wait.
        dof: joints of the arm; 0 if there is none.
        plans: bytes for what is planned in the brain's process.
    """

    state: np.dtype
    ring_capacity: int
    width: int = 1
    fifo_capacity: int = 1
    dof: int = 0
    plans: int = 0

    def create(self, name: str, about: dict[str, Any]) -> "LiveBlock":
        """Make the block.

        Raises:
            RealtimeError: a robot of this name is running, or there is no room.
        """
        sections = {
            "words": 8 * WORDS,
            "fifo": CommandFifo.nbytes(1),
            "ring": StateRing.nbytes(self.state, self.ring_capacity),
            "scenes": StateRing.nbytes(_SCENE, 2),
            "requests": Mailbox.nbytes(request_dtype(self.dof), _REQUESTS),
            "events": Mailbox.nbytes(EVENT_DTYPE, _EVENTS),
            "statistics": TimingStatistics.nbytes,
            "plan": self.plans,
        }
        described = {
            "width": self.width,
            "fifo_capacity": self.fifo_capacity,
            "dof": self.dof,
            "ring_capacity": self.ring_capacity,
            "state": npy.dtype_to_descr(self.state),
        }
        about = {**about, "version": _VERSION, "made_ns": time.monotonic_ns(), "layout": described}
        return LiveBlock(SharedBlock.create(name, sections, about))


class LiveBlock:
    """A block in use.

    Attributes:
        words: the words, shape (64,).
        estop: the word of the emergency stop.
        fifo: the commands.
        ring: the states.
        requests: requests for modes and goals.
        events: replies to them, and results of goals.

    Args:
        block: the memory.

    Raises:
        RealtimeError: its records are those of another version.
    """

    def __init__(self, block: SharedBlock) -> None:
        self._block = block
        layout = block.about["layout"]
        self.name, self.about = block.name, block.about
        self.words: NDArray[np.int64] = np.frombuffer(block.section("words"), np.int64)
        self.state_dtype = npy.descr_to_dtype(_tuples(layout["state"]))
        fields = self.state_dtype.fields or {}
        if "state" in fields and fields["state"][0] != STATE:
            block.close()
            raise RealtimeError(
                f"The robot {self.name!r} runs version {self.about.get('version')} of bhd_lerobot and this is version "
                f"{_VERSION}, whose record is another. Run the same version on both sides."
            )
        self.estop = EstopWord(1, self.words[Word.ESTOP : Word.ESTOP_LATCHED + 1])
        self.fifo = CommandFifo(1, layout["width"], layout["fifo_capacity"], block.section("fifo"))
        self.ring = StateRing(self.state_dtype, layout["ring_capacity"], block.section("ring"))
        self._scenes = StateRing(_SCENE, 2, block.section("scenes"))
        self.requests = Mailbox(request_dtype(layout["dof"]), _REQUESTS, block.section("requests"))
        self.events = Mailbox(EVENT_DTYPE, _EVENTS, block.section("events"))

    @classmethod
    def attach(cls, name: str) -> Self:
        """Open the block of a running robot.

        Raises:
            RealtimeError: there is none.
        """
        return cls._of(SharedBlock.attach(name))

    @classmethod
    def watch(cls, name: str) -> Self:
        """Open the block of a running robot to read it; nothing in it can be written but by `set_estop`.

        Raises:
            RealtimeError: there is none.
        """
        return cls._of(SharedBlock.watch(name))

    @classmethod
    def _of(cls, block: SharedBlock) -> Self:
        try:
            return cls(block)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            block.close()
            raise RealtimeError(f"The memory of the robot {block.name!r} is damaged, or of another version.") from error

    @property
    def phase(self) -> Phase:
        """What the loop's process is doing.

        Raises:
            RealtimeError: another process has overwritten it.
        """
        phase = int(self.words[Word.PHASE])
        if phase not in Phase:
            raise RealtimeError(f"The memory of the robot {self.name!r} was overwritten: its phase is {phase}.")
        return Phase(phase)

    @property
    def is_held(self) -> bool:
        """Whether a process of the robot still holds the block that this one watches; for the result of `watch`."""
        return self._block.is_held

    def set_estop(self) -> None:
        """Press the emergency stop of a robot that is watched."""
        self._block.write("words", 8 * Word.ESTOP, np.int64(time.monotonic_ns()).tobytes())

    def publish_scene(self, text: str) -> None:
        """Tell who watches in which scene the robot is, as JSON; one that is too long is left out."""
        content = text.encode()
        self._scenes.publish(np.array((content if len(content) <= _SCENE.itemsize else b"null",), _SCENE))

    @property
    def scene(self) -> tuple[int, str]:
        """The scene that the robot is in, as JSON, and how many there have been."""
        count, newest = len(self._scenes), self._scenes.latest()
        return (0, "null") if newest is None else (count, newest["text"].item().decode())

    def section(self, name: str) -> memoryview:
        """Return the memory of a further section."""
        return self._block.section(name)

    def show_life(self, word: Word) -> None:
        """Note that this process lives."""
        self.words[word] = time.monotonic_ns()

    def close(self) -> None:
        """Leave the block; the last process that does so removes it."""
        self._block.close()


def _tuples(value: Any) -> Any:
    """Return what JSON made lists of as numpy wants it: a list of fields, each a tuple, with shapes as tuples."""
    if not isinstance(value, list):
        return value
    return [tuple(tuple(part) if index == 2 else _tuples(part) for index, part in enumerate(one)) for one in value]
