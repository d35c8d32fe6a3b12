"""The page that the results are written to."""

import os
import platform
from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

import torch

from benchmarks.results.section import Section

_PACKAGES = ("lerobot_robot_bhd", "lerobot", "mujoco", "torch", "stable-baselines3", "gymnasium")


def write_page(path: Path, sections: Sequence[Section], *, is_short: bool) -> None:
    """Write the sections as a page of Markdown."""
    lines = [
        "# Results",
        "",
        "Written by `make results`, which runs the commands below each table; nothing here was typed by hand. Rates",
        "are with their Wilson 95 % intervals, means and differences with Student's, corrected for skewness, over the",
        "same held-out episodes for all brains of a table. Times of training include the start of the program.",
        "",
        f"Made on {datetime.now():%Y-%m-%d}, on {_machine()}.",
        f"Versions: {', '.join(f'{name} {version(name)}' for name in _PACKAGES)}.",
        "",
    ]
    if is_short:
        lines += ["**A short run, to try the commands: these numbers are not to be quoted.**", ""]
    for section in sections:
        lines += section.markdown()
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


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
