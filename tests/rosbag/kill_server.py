"""Exports and imports bags in forked processes that kill themselves; see `kill_server`, whose jobs it does as well."""

import contextlib
import io
import itertools
import os
import signal
from pathlib import Path
from typing import Any

import mcap.writer  # noqa: F401  as kill_server says
import rosbags.rosbag2  # noqa: F401

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.storage import disk
from bhd_lerobot.rosbag.exporter.export import ExportOptions, export_bags
from bhd_lerobot.rosbag.messages.types import type_store
from bhd_lerobot.rosbag.messages.views import RobotView
from bhd_lerobot.rosbag.storage import write
from tests.datasets import kill_server

type_store()
plain_run = kill_server.run


def run(job: dict[str, Any]) -> None:
    """Export or import, and die before a given change of the disk, or before a given bag is written or closed."""
    if job.get("edit") not in ("export", "import"):
        plain_run(job)
        return
    steps = itertools.count()

    def before_step(*arguments: object) -> None:
        if next(steps) == job["die_at"]:
            os.kill(os.getpid(), signal.SIGKILL)

    disk._before_step = before_step
    for name in ("__enter__", "write", "__exit__"):
        stepped(name, before_step)
    target, source = (Path(root) for root in job["roots"])
    if job["edit"] == "export":
        export_bags(source, target, view=RobotView(), options=ExportOptions(one_bag=job["one_bag"]))
    else:
        with contextlib.redirect_stdout(io.StringIO()):  # the server answers on the real one
            assert main.main(["import", str(source), "--repo_id=t/t", f"--root={target}"]) == 0


def stepped(name: str, before_step: Any) -> None:
    """Let a method of the writer of bags count as a step."""
    plain = getattr(write.BagWriter, name)

    def method(*arguments: Any) -> Any:
        before_step()
        return plain(*arguments)

    setattr(write.BagWriter, name, method)


if __name__ == "__main__":
    kill_server.run = run
    kill_server.main()
