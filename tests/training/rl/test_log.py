"""The curve of training: few episodes that end between the others do not look like all."""

import numpy as np

from bhd_lerobot.training.rl.log import RECENT, recent


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
