"""The memory that a node's process shares with the one that uses it."""

import mmap
import os
import time
from enum import IntEnum
from typing import Any

import numpy as np

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.ros2.live.spec import NodeSpec

_STATES, _COMMANDS, _IMAGES = 8, 8, 4  # capacities
PROBLEM_BYTES = 1000


class Word(IntEnum):
    """Single numbers."""

    ALIVE = 0
    """When the node was last at work, monotonic [ns]."""
    GUARD_ALIVE = 1
    """When the guard was last at work, monotonic [ns]."""
    END = 2
    """Whether the processes are to end."""
    DRIVEN = 3
    """Whether a command has been sent."""
    CHECKS = 4
    """How often the node has looked who else is there."""
    OTHERS = 5
    """How many other publishers it found on the topics of commands."""
    UNRECEIVED = 6
    """How many of these topics nobody receives whose commands have to arrive."""


class Channel:
    """States and images one way, commands the other; neither side ever waits.

    Attributes:
        states: counts, times and numbers of the inputs; mean times between two messages of inputs and cameras.
        images: of each camera, records of `image_dtypes`.

    Args:
        descriptor: of the memory; a new one is made if None.
    """

    def __init__(self, spec: NodeSpec, descriptor: int | None = None) -> None:
        inputs = len(spec.inputs)
        width = spec.columns[-1].stop if inputs else 0
        sent = spec.command_columns[-1].stop if spec.outputs else 0
        self.state_dtype = np.dtype(
            [
                ("count", np.int64, (inputs,)),
                ("arrived_ns", np.int64, (inputs,)),
                ("measured_ns", np.int64, (inputs,)),
                ("dropped", np.int64, (inputs,)),
                ("period_ns", np.int64, (inputs + len(spec.cameras),)),
                ("values", np.float64, (width,)),
                ("problem", np.bytes_, PROBLEM_BYTES),
            ]
        )
        self.command_dtype = np.dtype([("stamp_ns", np.int64), ("values", np.float64, (sent,))])
        self.image_dtypes = [
            np.dtype([("measured_ns", np.int64), ("pixels", np.uint8, (camera.height, camera.width, 3))])
            for camera in spec.cameras
        ]
        sizes = [
            8 * len(Word),
            StateRing.nbytes(self.state_dtype, _STATES),
            StateRing.nbytes(self.command_dtype, _COMMANDS),
            *(StateRing.nbytes(dtype, _IMAGES) for dtype in self.image_dtypes),
        ]
        offsets = np.cumsum([0, *(-(-size // 64) * 64 for size in sizes)]).tolist()
        if descriptor is None:
            self.descriptor = os.memfd_create(f"bhd-ros2-{spec.name}")
            os.ftruncate(self.descriptor, offsets[-1])
        else:
            self.descriptor = descriptor
        memory: Any = memoryview(mmap.mmap(self.descriptor, offsets[-1]))
        self.words = np.frombuffer(memory, np.int64, len(Word))
        self.states = StateRing(self.state_dtype, _STATES, memory[offsets[1] :])
        self.commands = StateRing(self.command_dtype, _COMMANDS, memory[offsets[2] :])
        self.images = [
            StateRing(dtype, _IMAGES, memory[offset:])
            for dtype, offset in zip(self.image_dtypes, offsets[3:], strict=False)
        ]

    def show_life(self, word: Word) -> None:
        """Note that a process is at work."""
        self.words[word] = time.monotonic_ns()

    def silence_s(self, word: Word) -> float:
        """Return how long ago a process was at work [s]."""
        return (time.monotonic_ns() - int(self.words[word])) / 1e9

    def close(self) -> None:
        """Close the descriptor; the memory is freed with the last process that maps it."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1
