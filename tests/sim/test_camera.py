import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import random_arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.world import World
from tests.cases import each_case

WIDTH, HEIGHT = 160, 120
POST = Shape("cylinder", 0.6, 0.0, 0.0, 0.1, 0.1)


@pytest.fixture(scope="module")
def world() -> World:
    return World(turtlebot3_burger(), 2)


@pytest.fixture(scope="module")
def camera(world: World) -> Iterator[Camera]:
    try:
        camera = Camera(world, WIDTH, HEIGHT)
    except RenderingError as error:
        pytest.skip(f"no image can be rendered on this machine: {error}")
    yield camera
    camera.close()


@pytest.fixture(autouse=True)
def empty(world: World) -> None:
    world.place([[], []])
    world.reset()


def test_an_image_has_the_requested_size_and_bytes_and_the_sky_above_the_floor(camera: Camera) -> None:
    for name in ("front", "overview"):
        image = camera.render(0, name)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert image.dtype == np.uint8
        assert image.std() > 1
    image = camera.render(0, "front").astype(int)
    blueness = image[..., 2] - image[..., 0]
    assert blueness[: HEIGHT // 4].mean() > blueness[-HEIGHT // 4 :].mean() + 5
    with pytest.raises(RenderingError, match=r"Did you mean 'front'\? Valid: follow, front, overview"):
        camera.render(0, "frnt")


def test_an_obstacle_in_front_changes_the_image_and_one_behind_does_not(world: World, camera: Camera) -> None:
    nothing = camera.render(0, "front")
    world.place([[Shape("cylinder", -0.6, 0.0, 0.0, 0.1, 0.1)]], [0])
    np.testing.assert_array_equal(camera.render(0, "front"), nothing)
    world.place([[POST]], [0])
    changed = (camera.render(0, "front") != nothing).any(axis=2)
    columns = np.flatnonzero(changed.any(axis=0))
    assert columns.min() + columns.max() == pytest.approx(WIDTH - 1, abs=2)  # in the middle
    # Left of the robot is left in the image.
    world.place([[Shape("cylinder", 0.6, 0.2, 0.0, 0.05, 0.05)]], [0])
    changed = (camera.render(0, "front") != nothing).any(axis=2)
    assert np.flatnonzero(changed.any(axis=0)).max() < WIDTH / 2


def test_the_same_state_gives_the_same_image_and_rendering_does_not_disturb_it(world: World, camera: Camera) -> None:
    arena = random_arena(5)
    world.place([arena.shapes, arena.shapes])
    world.reset(poses=np.array([arena.start, arena.start]))
    first = camera.render(0, "front")
    world.ctrl[0] = (6.0, 1.0)
    world.step(100, [0])
    before = world.snapshot().state.tobytes()
    assert (camera.render(0, "front") != first).any()
    assert world.snapshot().state.tobytes() == before
    np.testing.assert_array_equal(camera.render(1, "front"), first)
    np.testing.assert_array_equal(camera.render(1, "front"), first)


def test_two_cameras_work_in_one_process(world: World, camera: Camera) -> None:
    large = Camera(world, 2 * WIDTH, 2 * HEIGHT)
    world.place([[POST], []])
    small_image, large_image = camera.render(0, "front"), large.render(0, "front")
    assert large_image.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    np.testing.assert_array_equal(camera.render(0, "front"), small_image)
    halved = large_image.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved - small_image).mean() < 3
    large.close()
    large.close()
    np.testing.assert_array_equal(camera.render(0, "front"), small_image)
    with pytest.raises(RenderingError, match="closed"):
        large.render(0, "front")


def test_images_are_copies_or_go_into_the_caller_s_array(world: World, camera: Camera) -> None:
    first = camera.render(0, "front")
    kept = first.copy()
    world.place([[POST], []])
    out = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert camera.render(0, "front", out) is out
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(out, camera.render(0, "front"))
    assert (out != first).any()


def test_the_image_obeys_the_pinhole_and_nothing_casts_a_shadow(world: World, camera: Camera) -> None:
    """What a tall box changes lies within the projection of its corners: no shadow on the floor beside it."""
    for yaw in (0.0, math.pi / 4):
        world.place([[]], [0])
        nothing = camera.render(0, "overview")
        box = Shape("box", 0.5, 0.6, yaw, 0.2, 0.1, 1.5)
        world.place([[box]], [0])
        changed = (camera.render(0, "overview") != nothing).any(axis=2)
        model = world.model
        number = model.camera("overview").id
        focal = HEIGHT / 2 / math.tan(math.radians(model.cam_fovy[number]) / 2)
        rotation = model.cam_mat0[number].reshape(3, 3)
        corners = []
        for a in (-0.2, 0.2):
            for b in (-0.1, 0.1):
                x = 0.5 + math.cos(yaw) * a - math.sin(yaw) * b
                y = 0.6 + math.sin(yaw) * a + math.cos(yaw) * b
                corners += [(x, y, 0.0), (x, y, 1.5)]
        seen = (np.array(corners) - model.cam_pos[number]) @ rotation
        columns = WIDTH / 2 - focal * seen[:, 0] / seen[:, 2]
        rows = HEIGHT / 2 + focal * seen[:, 1] / seen[:, 2]
        found_rows, found_columns = np.nonzero(changed)
        assert found_columns.min() == pytest.approx(columns.min(), abs=1.5)
        assert found_columns.max() + 1 == pytest.approx(columns.max(), abs=1.5)
        assert found_rows.min() == pytest.approx(rows.min(), abs=1.5)
        assert found_rows.max() + 1 == pytest.approx(rows.max(), abs=1.5)


FORK = """
import json, os, sys
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.sim.world import World
import bhd_lerobot.sim.camera as camera

def run(program):
    world = World(turtlebot3_burger())
    world.step(10)
    assert world.time[0] > 0
    exec(program, globals())
    try:
        camera.Camera(world)
    except RenderingError as error:
        print(error)

printed = {}
for name, (program, environment) in json.loads(sys.argv[1]).items():
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(writing, 1)
        os.environ.update(environment)
        try:
            run(program)
            sys.stdout.flush()
        finally:
            os._exit(sys.exc_info()[0] is not None)
    os.close(writing)
    with open(reading) as pipe:
        printed[name] = [pipe.read(), os.waitpid(child, 0)[1]]
print(json.dumps(printed))
"""
ABSENT = "sys.modules['OpenGL'] = None"
# MuJoCo's OSMesa refuses to load when PyOpenGL was bound to EGL before.
FAILING = """
import types
def open_(backend, width, height):
    if backend == "egl":
        os.environ["PYOPENGL_PLATFORM"] = "egl"
        sys.modules["OpenGL"] = sys.modules["OpenGL.platform"] = types.ModuleType("OpenGL")
        raise ImportError("no EGL")
    assert "PYOPENGL_PLATFORM" not in os.environ and "OpenGL" not in sys.modules
    print("next:", backend)
    raise RenderingError("stop")
camera._open = open_
"""
PROGRAMS = {
    "absent": (ABSENT, {}),
    "absent egl": (ABSENT, {"MUJOCO_GL": "egl"}),
    "absent osmesa": (ABSENT, {"MUJOCO_GL": "osmesa"}),
    "nonsense": ("", {"MUJOCO_GL": "nonsense"}),
    "no window system": ("", {"MUJOCO_GL": "glfw"}),
    "failing egl": (FAILING, {}),
}


@pytest.fixture(scope="module")
def messages() -> dict[str, str]:
    """Return what the programs print, each in a process forked from one that has imported MuJoCo."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", FORK, json.dumps(PROGRAMS)],
        env=inherited,
        cwd=Path(__file__).resolve().parents[2],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=True,
    )
    printed = json.loads(done.stdout)
    assert all(status == 0 for _, status in printed.values()), done.stderr
    return {name: text for name, (text, _) in printed.items()}


@each_case(
    ("name", "parts"),
    [
        ("absent", ("egl: ", "osmesa: ", "apt-get install libegl1", "turn the cameras off")),
        ("absent egl", ("egl: ", "apt-get install libegl1", "turn the cameras off")),
        ("absent osmesa", ("osmesa: ", "apt-get install libegl1", "turn the cameras off")),
        ("nonsense", ("'nonsense'. Valid: egl, glfw, osmesa.",)),
        ("no window system", ("apt-get install libegl1",)),
        ("failing egl", ("next: osmesa",)),  # the next one is tried, of which nothing was left behind
    ],
)
def test_without_opengl_the_physics_runs_and_the_error_names_choices_and_remedy(
    name: str, parts: tuple[str, ...], messages: dict[str, str]
) -> None:
    assert [part for part in parts if part not in messages[name]] == []
