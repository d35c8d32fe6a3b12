"""What the distance check of setpoints may leave out: nothing that could matter."""

import numpy as np

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.geometry.collision import CollisionModel

ARM = ur5()


def test_no_distance_changes_by_more_than_its_slopes() -> None:
    model = CollisionModel(ARM.arm.chain)
    slopes = np.concatenate(model.slopes())
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (2000, 6))
    step = rng.uniform(-0.3, 0.3, q.shape) * (rng.random(q.shape) < 0.5)
    before, after = model.each(q), model.each(q + step)
    lifted = np.isfinite(before[:, 0])  # the others are not held against the table
    change, most = np.abs(after[lifted] - before[lifted]), (slopes @ np.abs(step).T)[lifted]
    assert (change <= most + 1e-9).all()
    assert (change > 0.3 * most)[most > 0].any()  # and the bounds are no empty words
    pairs, heights = (one.min(axis=0) for one in np.split(model.each(q), [len(model.slopes()[0])]))
    expected = model.distances(q)
    np.testing.assert_array_equal(pairs, expected[0])
    np.testing.assert_array_equal(heights, expected[1])
