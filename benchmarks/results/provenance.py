"""When, where and with what something was measured."""

import os
import platform
import re
import subprocess
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import torch

# What the numbers depend on, beside the packages.
_SOURCES = ("bhd_lerobot", "benchmarks", "configs")
_PACKAGES = ("lerobot_robot_bhd", "lerobot", "mujoco", "torch", "stable-baselines3", "gymnasium")


def provenance(root: Path) -> str:
    """Return the date, the machine and the versions, as they follow on "made".

    Args:
        root: folder of the repository, whose commit is named; it is left out where git does not know one.
    """
    versions = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return f"on {datetime.now():%Y-%m-%d}, on {_machine()}, with {_commit(root)}{versions}"


def _commit(root: Path) -> str:
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        is_changed = git("status", "--porcelain", "--", *_SOURCES)
        return f"commit {git('rev-parse', '--short=10', 'HEAD')}{' and changes' if is_changed else ''}, "
    except (OSError, subprocess.CalledProcessError):
        return ""


def _machine() -> str:
    try:
        model = re.search(r"^model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        model = None
    processor = model[1] if model else "an unknown processor"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{os.cpu_count()} processors ({processor}, {platform.system()}), {gpu}"
