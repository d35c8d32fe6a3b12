"""Imported once by the process from which `tests.forks` forks: what programs of this package import when they begin."""

import ctypes
import gc
from pathlib import Path

# Libraries that are imported on first use, so that every child would import them again.
import av
import mcap.writer
import pandas as pd
import pyarrow.dataset
import rosbags.rosbag2
import stable_baselines3
import torch
from lerobot.datasets import lerobot_dataset
from lerobot.scripts import lerobot_record, lerobot_replay

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.remote import hub, local, store
from bhd_lerobot.evaluation import evaluate
from bhd_lerobot.hub import transfer
from bhd_lerobot.recording import record
from bhd_lerobot.rosbag.messages.types import type_store
from bhd_lerobot.training import train
from bhd_lerobot.training.rl import train as rl
from tests.datasets import corruption_jobs, kill_jobs
from tests.datasets.sweeps import faults

__all__ = [
    "av", "corruption_jobs", "evaluate", "faults", "hub", "kill_jobs", "lerobot_dataset", "lerobot_record",
    "lerobot_replay", "local", "mcap", "pd", "pyarrow", "record", "rl", "rosbags", "stable_baselines3", "store",
    "torch", "train", "transfer",
]  # fmt: skip

_LARGE_PAGE = 2 << 20
_COLLAPSE = 25  # MADV_COLLAPSE of Linux 6.1, which the standard library does not name


def _use_large_pages() -> None:
    """Put the memory that is in use into large pages: copying the table of small ones is most of what a fork costs.

    Where the kernel has none, or has no room, it refuses and nothing changes.
    """
    madvise = ctypes.CDLL(None).madvise
    for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
        addresses, rights, *_, name = [*line.split(maxsplit=5), ""][:6]
        if "w" not in rights or name not in ("", "[heap]"):
            continue
        start, end = (int(address, 16) for address in addresses.split("-"))
        for page in range(-(-start // _LARGE_PAGE) * _LARGE_PAGE, end - _LARGE_PAGE + 1, _LARGE_PAGE):
            madvise(ctypes.c_void_p(page), ctypes.c_size_t(_LARGE_PAGE), _COLLAPSE)


type_store()
main._parser()  # imports every command
gc.collect()
gc.freeze()  # or a child that collects garbage copies every page
_use_large_pages()
