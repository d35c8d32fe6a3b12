"""No saved episode is ever lost: processes are killed with SIGKILL at random moments and at every single step."""

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bhd_lerobot.datasets.recovery.repair import repair
from tests.datasets import support
from tests.datasets.kill_support import KillServer
from tests.waiting import until


@pytest.fixture(scope="module")
def server() -> Iterator[KillServer]:
    server = KillServer()
    yield server
    server.close()


def saved_episodes(progress: Path) -> int:
    lines = progress.read_text().splitlines() if progress.exists() else []
    return max((int(line.split()[1]) + 1 for line in lines if line.startswith("saved")), default=0)


def wait_for(progress: Path, lines: int) -> None:
    until(lambda: progress.exists() and progress.read_text().count("\n") >= lines)


@pytest.mark.parametrize(("video", "kills"), [(False, 20), (True, 4)])
def test_random_kills_lose_nothing(server: KillServer, tmp_path: Path, video: bool, kills: int) -> None:
    """One dataset lives through many kills, while saving and while compacting, and goes on every time."""
    rng = random.Random(7)
    root, progress = tmp_path / "dataset", tmp_path / "progress"
    for kill in range(kills):
        # Every second victim finalises after each episode, so that kills hit the compaction as well.
        finalize = kill % 2 == 1
        before = progress.read_text().count("\n") if progress.exists() else 0
        job = {"root": str(root), "progress": str(progress), "video": video, "die_at": None, "finalize": finalize}
        pid = server.start({**job, "episodes": 1 if finalize else 10_000, "sessions": 10_000})
        wait_for(progress, before + rng.randrange(4))
        time.sleep(rng.uniform(0, 0.012))
        os.kill(pid, signal.SIGKILL)
        assert server.end() == -signal.SIGKILL
        if not root.exists():
            continue
        saved = saved_episodes(progress)
        report = repair(root)
        assert saved <= report.episodes <= saved + 1
        if report.episodes:
            support.verify(root, saved, video=video, stats=True)
        assert not repair(root), "a second repair finds nothing"
    assert saved_episodes(progress) > 0


@pytest.mark.parametrize("video", [False, True])
@pytest.mark.parametrize("phase", ["save", "finalize"])
def test_kill_at_every_step(server: KillServer, tmp_path: Path, video: bool, phase: str) -> None:
    """The process dies before its first, second, ... change of the disk, until it survives."""
    episodes, died_at = 3, 0
    while True:
        root, progress = tmp_path / f"dataset-{died_at}", tmp_path / f"progress-{died_at}"
        job = {"root": str(root), "progress": str(progress), "video": video, "episodes": episodes}
        server.start({**job, "die_at": died_at, "finalize": phase == "finalize"})
        code = server.end()
        saved = saved_episodes(progress)
        if code == 0:
            break
        assert code == -signal.SIGKILL
        if phase == "save":
            assert saved == episodes - 1
            # Stock LeRobot reads it as it lies there, before anything was repaired.
            support.verify(root, saved, video=video, exact=False)
            with support.resume(root, video=video) as recorder:
                assert recorder.num_episodes in (saved, saved + 1)
                # What was dropped is never taken for something else: the next episode has its place.
                saved = support.record(recorder, video=video) + 1
        else:
            assert saved == episodes
            repair(root)
            assert support.verify(root, saved, video=video, stats=True) == saved
        assert support.read_back(root) == saved
        assert not repair(root)
        assert not (root / ".bhd").exists()
        died_at += 1
    assert died_at > 10
