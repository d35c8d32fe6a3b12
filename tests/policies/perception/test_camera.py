"""Where the fixed camera sees what: the same as the renderer."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.tabletop import SCENE_CAMERA, TableObject, TableScene
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

WIDTH, HEIGHT = 320, 240
PROJECTION = Projection(SCENE_CAMERA, WIDTH, HEIGHT)


@pytest.mark.law
@given(st.tuples(st.floats(0.2, 0.8), st.floats(-0.5, 0.5), st.floats(0.0, 0.2)))
def test_the_pixel_of_a_point_shows_that_point(point: tuple[float, float, float]) -> None:
    pixel = PROJECTION.pixels(np.array(point))
    assert PROJECTION.on_plane(pixel, point[2]) == pytest.approx(np.array(point), abs=1e-9)


def test_a_roll_turns_the_image_about_its_middle_and_nothing_else() -> None:
    rolled = Projection(replace(SCENE_CAMERA, roll=0.3), WIDTH, HEIGHT)
    points = np.random.default_rng(0).uniform((0.35, -0.3, 0.0), (0.65, 0.3, 0.13), (20, 3))
    middle = np.array([WIDTH, HEIGHT]) / 2
    upright, turned = (one.pixels(points) - middle for one in (PROJECTION, rolled))
    # The camera turns clockwise, so what it sees turns the other way; rows count downwards.
    cos, sin = np.cos(0.3), np.sin(0.3)
    assert turned == pytest.approx(upright @ np.array([[cos, -sin], [sin, cos]]), abs=1e-9)
    assert rolled.on_plane(rolled.pixels(points[0]), points[0, 2]) == pytest.approx(points[0], abs=1e-9)


def test_the_region_holds_the_box_and_its_sides_are_multiples() -> None:
    low, high = (0.35, -0.3, 0.0), (0.65, 0.3, 0.13)
    left, top, right, bottom = PROJECTION.region(low, high, 0.05, 8)
    corners = PROJECTION.pixels(np.array([[x, y, z] for x in (0.35, 0.65) for y in (-0.3, 0.3) for z in (0.0, 0.13)]))
    assert (right - left) % 8 == (bottom - top) % 8 == 0
    assert ((corners > (left, top)) & (corners < (right, bottom))).all()
    assert left >= 0
    assert bottom <= HEIGHT
    with pytest.raises(ValueError, match="does not see"):
        PROJECTION.region((3.0, -0.1, 0.0), (3.2, 0.1, 0.1), 0.0, 8)


def test_an_object_is_rendered_where_the_projection_says() -> None:
    table = Tabletop(World(ur5(), 1))
    try:
        camera = Camera(table.world, WIDTH, HEIGHT)
    except RenderingError as error:
        pytest.skip(f"no image can be rendered on this machine: {error}")
    table.place([TableScene("test", (), ur5().arm.home)])
    table.world.forward()
    empty = camera.render(0, "scene").astype(int)
    for x, y in ((0.38, -0.25), (0.5, 0.0), (0.62, 0.27)):
        thing = TableObject("box", "blue", 0.02, 0.02, 0.04, x, y, style="plain")
        table.place([TableScene("test", (thing,), ur5().arm.home)])
        table.world.forward()
        row, column = np.nonzero(np.abs(camera.render(0, "scene").astype(int) - empty).sum(axis=-1) > 60)
        middle = np.array([column.mean() + 0.5, row.mean() + 0.5])
        assert middle == pytest.approx(PROJECTION.pixels(np.array([x, y, 0.02])), abs=1.5)
    camera.close()
