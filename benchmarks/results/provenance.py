"""When, where and with what something was measured."""

import hashlib
import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import torch
import yaml

# What the numbers depend on, beside the packages. No configuration tells that a default in the code has changed.
_SOURCES = ("bhd_lerobot", "benchmarks", "configs")
_PACKAGES = ("lerobot_robot_bhd", "lerobot", "mujoco", "torch", "stable-baselines3", "gymnasium")


def provenance(root: Path) -> str:
    """Return the date, the machine and the versions, as they follow on "made".

    Args:
        root: folder of the repository, whose commit is named; it is left out where git does not know one.
    """
    versions = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return f"on {datetime.now():%Y-%m-%d}, on {_machine()}, with {_commit(root)}{versions}"


def digests(commands: Iterable[str], root: Path) -> dict[str, str]:
    """Return the SHA-256 of what every configuration says that commands name, or that such a configuration names.

    Args:
        commands: as a person would type them.
        root: folder that the paths in them begin in.
    """
    found: dict[str, str] = {}
    texts = list(commands)
    while texts:
        for path in re.findall(r"configs/[\w/]+\.yaml", texts.pop()):
            if path not in found:
                content = (root / path).read_text(encoding="utf-8") if (root / path).exists() else ""
                text = json.dumps(yaml.safe_load(content), sort_keys=True)  # comments count for nothing
                found[path] = hashlib.sha256(text.encode()).hexdigest()
                texts.append(text)
    return found


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
