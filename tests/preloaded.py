"""Imported once by the process from which `tests.forks` forks: what programs of this package import when they begin."""

import gc

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

from bhd_lerobot.cli import evaluate, record
from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.remote import hub, local, store
from bhd_lerobot.hub import transfer
from bhd_lerobot.ros2.messages.types import type_store
from bhd_lerobot.training import train
from bhd_lerobot.training.rl import train as rl
from tests import shortcuts
from tests.datasets import corruption_jobs, kill_jobs
from tests.datasets.sweeps import faults

__all__ = [
    "av", "corruption_jobs", "evaluate", "faults", "hub", "kill_jobs", "lerobot_dataset", "lerobot_record",
    "lerobot_replay", "local", "mcap", "pd", "pyarrow", "record", "rl", "rosbags", "stable_baselines3", "store",
    "torch", "train", "transfer",
]  # fmt: skip

type_store()
main._parser()  # imports every command
shortcuts.install()
gc.collect()
gc.freeze()  # or a child that collects garbage copies every page
