"""No saved episode is ever lost: processes are killed with SIGKILL at random moments and at every single step.

Here at some of the steps; ``make sweep`` kills them at all.
"""

import random
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from bhd_lerobot.datasets.recovery.repair import repair
from tests.datasets import kill_jobs, support
from tests.datasets.sweeps.faults import IS_FULL
from tests.forks import Fork
from tests.waiting import until


def saved_episodes(progress: Path) -> int:
    lines = progress.read_text().splitlines() if progress.exists() else []
    return max((int(line.split()[1]) + 1 for line in lines if line.startswith("saved")), default=0)


def wait_for(progress: Path, lines: int) -> None:
    until(lambda: progress.exists() and progress.read_text().count("\n") >= lines)


def test_random_kills_lose_nothing(tmp_path: Path) -> None:
    """One dataset lives through many kills, while saving and while compacting, and goes on every time."""
    rng = random.Random(7)
    root, progress = tmp_path / "dataset", tmp_path / "progress"
    for kill in range(20 if IS_FULL else 6):
        # Every second victim finalises after each episode, so that kills hit the compaction as well.
        finalize = kill % 2 == 1
        before = progress.read_text().count("\n") if progress.exists() else 0
        save = partial(kill_jobs.save, finalize=finalize, sessions=10_000)
        victim = Fork(save, root, progress, 1 if finalize else 10_000)
        wait_for(progress, before + rng.randrange(4))
        time.sleep(rng.uniform(0, 0.012))
        assert victim.kill() == -signal.SIGKILL
        if not root.exists():
            continue
        saved = saved_episodes(progress)
        report = repair(root)
        assert saved <= report.episodes <= saved + 1
        if report.episodes:
            support.verify(root, saved, video=True, stats=True)
        assert not repair(root), "a second repair finds nothing"
    assert saved_episodes(progress) > 0


@pytest.mark.parametrize(("phase", "first", "stride"), [("save", 1, 3), ("finalize", 2, 6)])
def test_kill_at_every_step(tmp_path: Path, phase: str, first: int, stride: int) -> None:
    """The process dies before its first, second, ... change of the disk, until it survives."""
    first, stride = (0, 1) if IS_FULL else (first, stride)
    episodes, died_at = 3, first
    while True:
        root, progress = tmp_path / f"dataset-{died_at}", tmp_path / f"progress-{died_at}"
        save = partial(kill_jobs.save, die_at=died_at, finalize=phase == "finalize")
        code = Fork(save, root, progress, episodes).wait()
        saved = saved_episodes(progress)
        if code == 0:
            break
        assert code == -signal.SIGKILL
        if phase == "save":
            assert saved == episodes - 1
            # Stock LeRobot reads it as it lies there, before anything was repaired.
            support.verify(root, saved, video=True, exact=False)
            with support.resume(root, video=True) as recorder:
                assert recorder.num_episodes in (saved, saved + 1)
                # What was dropped is never taken for something else: the next episode has its place.
                saved = support.record(recorder, video=True) + 1
        else:
            assert saved == episodes
            repair(root)
            assert support.verify(root, saved, video=True, stats=True) == saved
        assert support.read_back(root) == saved
        assert not repair(root)
        assert not (root / ".bhd").exists()
        died_at += stride
    assert died_at > 10
