"""The arithmetic of `benchmarks.sight`, and that what it runs untrained finds as much as can be there."""

from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import sight
from benchmarks._report import Report, Row
from benchmarks.realtime import NotMeasuredError
from benchmarks.sight import (
    ATTEMPTS,
    HEIGHT,
    PERCEPTION,
    SAME,
    WIDTH,
    summarise_blocks,
    untrained_perception,
)
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS
from bhd_lerobot.policies.perception.perceiver import Perceiver, PerceptionOptions


def block(brain: str, number: int, wake: float, *, core: str = SAME) -> dict[str, Any]:
    times = {"wake_p50": wake / 2, "wake_p99": wake, "wake_max": 3 * wake, "tick_p99": 100.0}
    brains = {"frames_per_s": 25.0, "cpu_ms": 9.0, "inference_p50": 8.0, "inference_p99": 9.0, "objects": None}
    counts = {"ticks": 5000, "late": 5, "missed": 1, "late_share": 1e-3, "stops": 0}
    return {"round": number, "core": core, "brain": brain, **times, **brains, **counts}


def report(blocks: list[dict[str, Any]]) -> dict[str, Row]:
    """Return the rows by core, brain and what is measured."""
    found, first, second = Report(""), "UR5 at 500 Hz beside ", " at 25 Hz, cerebellum"
    summarise_blocks(found, blocks)
    return {row.what.replace(first, "").replace(second, ""): row for row in found.rows}


def test_a_block_whose_robot_was_stopped_is_run_again_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def run(name: str, *_: Any) -> dict[str, Any]:
        asked.append(name)
        if name == PERCEPTION and asked.count(name) <= stopped:
            raise NotMeasuredError("the episode ended with fault")
        found = block(name, 0, 10.0)
        return {key: found[key] for key in found.keys() - {"core", "stops"}}

    monkeypatch.setattr(sight, "block", run)
    for stopped in range(ATTEMPTS):
        asked.clear()
        blocks = sight.measure(1, 1.0, {})
        assert asked.count(PERCEPTION) == stopped + len(blocks) // 3
        row = report(blocks)[f"{PERCEPTION} on {SAME}: ticks later than 0.1 ms"]
        assert (f"stopped and run again {stopped}, beside noop 0" in row.value) == bool(stopped)
        assert row.met == (not stopped)
    stopped = ATTEMPTS
    asked.clear()
    with pytest.raises(NotMeasuredError, match="ended with fault"):
        sight.measure(1, 1.0, {})


def test_the_untrained_perception_finds_as_many_objects_as_there_can_be(tmp_path: Path) -> None:
    torch.manual_seed(0)
    image = torch.rand(1, 3, HEIGHT // 8, WIDTH // 8).repeat_interleave(8, 2).repeat_interleave(8, 3)
    perceiver = Perceiver(PerceptionOptions(str(untrained_perception(tmp_path, image))))
    pixels = (255 * image[0].permute(1, 2, 0)).round().to(torch.uint8).numpy()
    found = perceiver.look({"scene": pixels[None]}, 0)
    assert MAX_OBJECTS - 1 <= len(found) <= MAX_OBJECTS  # two at one place are one
