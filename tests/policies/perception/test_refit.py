"""A camera that was moved is found from objects whose places are known, whatever else was taken for them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.tabletop import SCENE_CAMERA, CameraView
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.refit import fit_view
from tests.policies.perception.rig import HEIGHT, WIDTH

SIZE = (WIDTH, HEIGHT)
LOW, HIGH = (0.35, -0.3, 0.02), (0.65, 0.3, 0.1)


@given(
    shift=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    target=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    roll=st.floats(-0.1, 0.1),
    seed=st.integers(0, 99),
)
def test_points_are_shown_where_they_were_seen_though_some_were_taken_for_others(shift, target, roll, seed):
    position, middle = np.add(SCENE_CAMERA.position, shift), np.add(SCENE_CAMERA.target, target)
    true = CameraView(tuple(position), tuple(middle), SCENE_CAMERA.fovy, roll)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    places = rng.uniform(LOW, HIGH, (40, 3))
    pixels = Projection(true, *SIZE).pixels(places)
    pixels[:4] += rng.uniform(-30, 30, (4, 2))
    found = Projection(fit_view(SCENE_CAMERA, SIZE, places, pixels), *SIZE)
    assert np.abs(found.pixels(places[4:]) - pixels[4:]).max() < 2.0  # of 30 px that the false ones are off
