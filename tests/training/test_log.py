import io
from pathlib import Path

import pytest
from rich.console import Console

from bhd_lerobot.training.log import MetricsFile, RunProgress, read_metrics

ROWS = [{"step": step, "loss": 1 / step, "lr": 1e-3, "held_out_loss": 2 / step} for step in (10, 20, 30)]


@pytest.mark.law
def test_rows_come_back_with_all_their_bits(tmp_path: Path) -> None:
    file = MetricsFile(tmp_path / "metrics.jsonl")
    for row in ROWS:
        file.append(row)
    assert read_metrics(file.path) == ROWS == file.rows
    assert read_metrics(file.path, 20) == ROWS[:2]


def test_an_incomplete_file_and_values_that_are_not_finite(tmp_path: Path) -> None:
    assert read_metrics(tmp_path / "metrics.jsonl") == []
    file = MetricsFile(tmp_path / "metrics.jsonl", [*ROWS, {"step": 40, "grad_norm": float("inf")}])
    with file.path.open("a") as stream:
        stream.write('{"step": 50, "lo')
    assert read_metrics(file.path) == [*ROWS, {"step": 40, "grad_norm": None}]


@pytest.mark.parametrize(("completed", "said"), [(0, "15:00:00 left, by the first step. Take less."), (90, "")])
def test_the_time_left_is_printed_from_the_first_step_on(completed, said, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("bhd_lerobot.training.log.time.monotonic", lambda: now[0])
    printed = io.StringIO()
    total = 100 if completed else 10_801
    with RunProgress(Console(file=printed, width=100), "training", total, completed, slow="Take less.") as progress:
        for step in range(completed + 1, completed + 3):
            now[0] += 5.0
            progress.advance(step)
        progress.log("step 2/100", "loss 1")
    lines = printed.getvalue().splitlines()
    assert lines[:-1] == ([said] if said else [])
    assert lines[-1] == f"step 2/100  loss 1  {'14:59:55' if not completed else '0:00:40'} left"
