"""Where the fixed camera sees what: the same as the renderer."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs import FeatureType, PolicyFeature

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.tabletop import SCENE_CAMERA, TableObject, TableScene, scene_camera
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.errors import ConfigError, RenderingError
from bhd_lerobot.policies.perception.camera import Projection
from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_ur import UR3eConfig, UR5Config
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World
from tests.cases import each_case
from tests.policies.perception.rig import IMAGE

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


@pytest.mark.law
@each_case("robot", [UR5Config, UR3eConfig, SO101Config])
def test_every_arm_has_its_table_before_a_camera_that_its_perception_knows(robot: Any) -> None:
    """What is not said of camera and table is the arm's: an object is rendered where the perception expects it."""
    body = robot().body()
    arm = body.need(Arm)
    config = PerceptionConfig(input_features={IMAGE: PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH))})
    config.stand_before(arm.workspace)
    left, top, right, bottom = config.region
    assert (right - left) * (bottom - top) > 0.25 * WIDTH * HEIGHT
    table = Tabletop(World(body, 1))
    try:
        camera = Camera(table.world, WIDTH, HEIGHT)
    except RenderingError as error:
        pytest.skip(f"no image can be rendered on this machine: {error}")
    table.place([TableScene("test", (), arm.home)])
    table.world.forward()
    empty = camera.render(0, "scene").astype(int)
    x0, y0, x1, y1 = config.area
    for across, along in ((0.1, 0.1), (0.5, 0.5), (0.9, 0.95)):
        x, y, half = x0 + across * (x1 - x0), y0 + along * (y1 - y0), 0.02 * config.scale
        thing = TableObject("box", "blue", half, half, 2 * half, x, y, style="plain")
        table.place([TableScene("test", (thing,), arm.home)])
        table.world.forward()
        row, column = np.nonzero(np.abs(camera.render(0, "scene").astype(int) - empty).sum(axis=-1) > 60)
        middle = np.array([column.mean() + 0.5, row.mean() + 0.5])
        assert middle == pytest.approx(config.projection.pixels(np.array([x, y, half])), abs=1.5)
        assert (middle > (left, top)).all()
        assert (middle < (right, bottom)).all()
    camera.close()


def test_the_camera_beside_a_ur5_is_where_it_always_was() -> None:
    assert scene_camera(ur5().need(Arm).workspace) == SCENE_CAMERA
    config = PerceptionConfig()
    config.stand_before(ur5().need(Arm).workspace)
    assert (config.area, config.object_height, config.scale) == ([0.35, -0.30, 0.65, 0.30], 0.13, 1.0)


@pytest.mark.parametrize("said", [{"camera_position": [0.37, 0.02, 1.0]}, {"camera_target": [1.22, -0.62, 0.1]}])
def test_a_camera_of_which_half_is_said_does_not_look_straight_down(said: dict[str, list[float]]) -> None:
    config = PerceptionConfig(**said)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="not look straight down"):
        config.settle()
