"""The curves of training runs."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from bhd_lerobot.training import plots
from bhd_lerobot.training.plots import RECENT, draw_loss, recent

ROWS = [{"step": step, "loss": 1 / step, "lr": 1e-3, "held_out_loss": 2 / step} for step in (10, 20, 30)]


def drawn(rows: list[dict], path: Path, monkeypatch) -> Figure:
    figures = []

    class Spy(Figure):
        def __init__(self, *args, **kwargs) -> None:
            super().__init__(*args, **kwargs)
            figures.append(self)

    monkeypatch.setattr(plots, "Figure", Spy)
    draw_loss(rows, path, "toy", "loss of toy (l1)")
    assert path.stat().st_size > 1000
    return figures[0]


@pytest.mark.figures
def test_the_curve_shows_both_losses_on_a_log_scale(tmp_path: Path, monkeypatch) -> None:
    above, below = drawn(ROWS, tmp_path / "loss.png", monkeypatch).axes
    assert above.get_yscale() == "log"
    assert [line.get_label() for line in above.lines] == [
        "training, mean since the previous point: 0.0333 at step 30",
        "held-out episodes, not trained on: 0.0667 at step 30",
    ]
    assert [axes.get_ylabel() for axes in (above, below)] == ["loss of toy (l1), log scale", "learning\nrate"]
    assert below.get_xlabel() == "training step"
    assert above.lines[1].get_ydata().tolist() == [0.2, 0.1, 2 / 30]
    assert below.lines[0].get_xdata().tolist() == [10, 20, 30]


def test_a_point_stands_for_the_last_episodes_however_many_end_in_an_update() -> None:
    assert recent([{"step": 1, "lr": 1.0}], "success") is None  # before an episode has ended
    rng = np.random.default_rng(0)
    for most in (1, 7, 300):
        counts = rng.integers(0, most + 1, 60)
        ended = [rng.random(count) < 0.9 for count in counts]
        rows = [
            {"step": step, "lr": 1.0} | ({"episodes": len(one), "success": float(one.mean())} if len(one) else {})
            for step, one in enumerate(ended)
        ]
        points = recent(rows, "success")
        assert points is not None
        assert points[0] == [step for step, one in enumerate(ended) if len(one)]
        for step, value in zip(*points, strict=True):
            # As many updates as have that many episodes, from the last one backwards.
            window: list[bool] = []
            for one in ended[step::-1]:
                if len(window) < RECENT:
                    window += list(one)
            assert np.isclose(value, np.mean(window))
