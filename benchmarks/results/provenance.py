"""When, where and with what something was measured."""

import os
import platform
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import torch

_PACKAGES = ("lerobot_robot_bhd", "lerobot", "mujoco", "torch", "stable-baselines3", "gymnasium")


def provenance() -> str:
    """Return the date, the machine and the versions, as they follow on "made"."""
    versions = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return f"on {datetime.now():%Y-%m-%d}, on {_machine()}, with {versions}"


def _machine() -> str:
    model = "an unknown processor"
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{os.cpu_count()} processors ({model}, {platform.system()}), {gpu}"
