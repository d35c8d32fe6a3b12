"""The arithmetic of `benchmarks.sight`, and that what it runs untrained finds as much as can be there."""

from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import sight
from benchmarks.realtime import NotMeasuredError
from benchmarks.results.speed import sight_rows
from benchmarks.sight import ATTEMPTS, BESIDE, GOALS, HEIGHT, NOOP, PERCEPTION, SAME, WIDTH, rows, untrained_perception
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS
from bhd_lerobot.policies.perception.perceiver import Perceiver, PerceptionOptions


def block(brain: str, number: int, wake: float, *, core: str = SAME, rate: float = 25.0) -> dict[str, Any]:
    times = {"wake_p50": wake / 2, "wake_p99": wake, "wake_max": 3 * wake, "tick_p99": 100.0}
    brains = {"frames_per_s": rate, "cpu_ms": 9.0, "inference_p50": 8.0, "inference_p99": 9.0, "objects": None}
    counts = {"ticks": 5000, "late": 5, "missed": 1, "late_share": 1e-3, "stops": 0}
    return {"round": number, "core": core, "brain": brain, **times, **brains, **counts}


def test_a_ratio_is_taken_within_a_round_and_on_the_same_core() -> None:
    blocks = [block(NOOP, 0, 10.0), block(PERCEPTION, 0, 12.0), block(NOOP, 1, 100.0), block(PERCEPTION, 1, 140.0)]
    blocks += [block(NOOP, 0, 1.0, core=BESIDE), block(PERCEPTION, 0, 3.0, core=BESIDE)]
    table = {(row["core"], row["brain"]): row for row in rows(blocks)}
    assert table[SAME, PERCEPTION]["ratios"]["wake_p99"] == pytest.approx(1.3)
    assert table[SAME, PERCEPTION]["met"]
    assert (table[SAME, PERCEPTION]["ticks"], table[SAME, PERCEPTION]["missed"]) == (10_000, 2)
    assert table[BESIDE, PERCEPTION]["ratios"]["wake_p99"] == pytest.approx(3.0)
    assert not table[BESIDE, PERCEPTION]["met"]
    assert "ratios" not in table[SAME, NOOP]


def test_what_is_too_slow_misses_its_goal_and_the_page_says_so() -> None:
    table = rows([block(NOOP, 0, 10.0), block(PERCEPTION, 0, 10.0, rate=20.0)])
    assert not table[1]["met"]
    shown = sight_rows({"rows": table, "goals": GOALS})
    assert [row.met for row in shown] == [True, True, False]
    assert "20.00, beside noop 25.00" in shown[2].value


def test_more_late_ticks_than_beside_noop_in_the_same_round_miss_the_goal() -> None:
    for late, met in ((2e-3, True), (3e-3, False)):
        blocks = [block(NOOP, 0, 10.0), {**block(PERCEPTION, 0, 10.0), "late_share": late}]
        table = rows(blocks)
        assert table[1]["met"] == met
        assert [row.met for row in sight_rows({"rows": table, "goals": GOALS})] == [True, met, True]


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
        table = rows(sight.measure(1, 1.0, {}))
        assert asked.count(PERCEPTION) == stopped + len(table) // 3
        assert {row["brain"]: row["stops"] for row in table if row["core"] == SAME}[PERCEPTION] == stopped
        told = sight_rows({"rows": table, "goals": GOALS})[1]
        assert (f"stopped and run again {stopped}, beside noop 0" in told.value) == bool(stopped)
        assert told.met == (not stopped)
        missed = [(row["core"], row["brain"]) for row in table if row.get("met") is False]
        assert missed == ([(SAME, PERCEPTION)] if stopped else [])
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
