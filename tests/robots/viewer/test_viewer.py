"""A robot in MuJoCo's viewer, of which a stand-in takes the place: it writes what it is shown into a file.

The law: whatever becomes of the viewer, the robot does the same, to the last bit.
"""

import json
import os
import signal
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.scenes import scene_from_json
from bhd_lerobot.cli.evaluate import main as evaluate
from bhd_lerobot.cli.record import main as record
from bhd_lerobot.cli.ros2 import main as ros2
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_simulation
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.viewer.viewer import Viewer
from tests.forks import Fork
from tests.recording.support import data_columns, episode_rows, options
from tests.robots.host.support import drive, is_alive, is_gone, turtlebot, unique
from tests.waiting import until

# Imported by every interpreter that starts with its folder on the path, before anything else.
STAND_IN = """
import contextlib, json, os, sys, types

FOLDER = os.path.dirname(__file__)

class Handle:
    def __init__(self, model, data):
        self.model, self.data = model, data
        import mujoco
        self.opt, self.cam = mujoco.MjvOption(), mujoco.MjvCamera()
    def lock(self):
        return contextlib.nullcontext()
    def is_running(self):
        return not os.path.exists(os.path.join(FOLDER, "closed"))
    def sync(self):
        shown = {"qpos": self.data.qpos.tolist(), "geoms": self.model.geom_pos.tolist()}
        with open(os.path.join(FOLDER, "writing"), "w") as file:
            json.dump(shown, file)
        os.replace(os.path.join(FOLDER, "writing"), os.path.join(FOLDER, "shown.json"))

def launch_passive(model, data, **options):
    import threading
    if os.path.exists(os.path.join(FOLDER, "broken")):
        raise_it = threading.Thread(target=lambda: 1 / 0)
        raise_it.start()
        raise_it.join()
        threading.Event().wait()
    return Handle(model, data)

viewer = types.ModuleType("mujoco.viewer")
viewer.launch_passive = launch_passive
sys.modules["mujoco.viewer"] = viewer
glfw = types.ModuleType("glfw")
glfw.init, glfw.terminate, glfw.set_error_callback = lambda: True, lambda: None, lambda callback: None
sys.modules["glfw"] = glfw
"""


class StandIn:
    """The stand-in's side of the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "sitecustomize.py").write_text(STAND_IN, encoding="utf-8")

    def shown(self) -> dict[str, Any] | None:
        try:
            return dict(json.loads((self.folder / "shown.json").read_text()))
        except FileNotFoundError:
            return None

    def until_shown(self, qpos: np.ndarray) -> dict[str, Any]:
        def there() -> Any:
            shown = self.shown()
            return shown if shown is not None and np.array_equal(shown["qpos"], qpos) else None

        return dict(until(there, "the viewer shows the state"))


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StandIn:
    folder = tmp_path / "stand_in"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return StandIn(folder)


def made(**overrides: object) -> tuple[Simulation, Any]:
    """Return one simulation on the lockstep clock, and its scene."""
    config: Any = parse(RecordConfig, options(Path("unused"), robot__camera="false", **overrides)).robot
    simulation = make_simulation(config)
    return simulation, config.start_scene()


def run(simulation: Simulation, scene: Any, frames: int) -> np.ndarray:
    """Let it move; return all that its world went through."""
    simulation.reset(np.zeros(1, np.intp), [scene], [1])
    target = simulation.to_action(simulation.cerebellum.command)
    states = []
    for frame in range(frames):
        action = target + 0.02 * np.sin(0.3 * frame)
        simulation.step(action)
        states.append(np.concatenate([part[0] for part in simulation.physics]))
    return np.array(states)


ROBOTS: list[dict[str, object]] = [
    {},
    {"robot.type": "ur5", "robot.scene": "pick", "robot.beams": None, "brain.type": "pick", "task.type": "pick"},
]


@pytest.mark.law
@pytest.mark.parametrize("overrides", ROBOTS, ids=["turtlebot3", "ur5"])
def test_it_shows_the_robot_and_what_is_around_it(stand_in: StandIn, overrides: dict[str, object]) -> None:
    simulation, scene = made(**overrides)
    with closing(simulation), closing(Viewer(simulation)):
        run(simulation, scene, 5)
        shown = stand_in.until_shown(simulation.world.qpos[0])
        assert shown["geoms"] == simulation.world.copy_model(0).geom_pos.tolist()
        simulation.reset(np.zeros(1, np.intp), [scene], [2])
        stand_in.until_shown(simulation.world.qpos[0])


def stop(viewer: Viewer) -> None:
    os.kill(viewer.pid, signal.SIGSTOP)


def kill(viewer: Viewer) -> None:
    os.kill(viewer.pid, signal.SIGKILL)
    until(lambda: not is_alive(viewer.pid), "the viewer is gone")


@pytest.mark.law
def test_whatever_becomes_of_it_the_robot_does_the_same(stand_in: StandIn) -> None:
    def close_window(viewer: Viewer) -> None:
        (stand_in.folder / "closed").touch()
        until(lambda: not is_alive(viewer.pid), "the viewer ends")

    simulation, scene = made()
    with closing(simulation):
        alone = run(simulation, scene, 40)
        for fate in (lambda viewer: None, stop, kill, Viewer.close, close_window):
            with closing(Viewer(simulation)) as viewer:
                run(simulation, scene, 3)
                fate(viewer)
                assert np.array_equal(run(simulation, scene, 40), alone), fate
            assert not is_alive(viewer.pid), fate


def test_a_robot_on_the_wall_clock_goes_on_without_it(stand_in: StandIn) -> None:
    name = unique("viewed")
    with turtlebot(name) as robot:
        link = robot.host.link
        for fate in (stop, kill):
            (stand_in.folder / "shown.json").unlink(missing_ok=True)
            with closing(Viewer(robot.host)) as viewer:
                drive(robot)
                until(stand_in.shown, "the robot is shown")
                assert scene_from_json(link.block.scene[1]) == robot.make_scene()
                assert mapped_for_writing(viewer.pid, name) == []
                fate(viewer)
                ticks = len(link.block.ring)
                until(lambda ticks=ticks: len(link.block.ring) > ticks + 200, "ticks go on")
                drive(robot)
                assert robot.get_observation()["x.vel"] > 0.1
            assert not is_alive(viewer.pid)
    assert is_gone(name)


def mapped_for_writing(pid: int, name: str) -> list[str]:
    """Return where a process maps a robot's memory so that it could write to it."""
    lines = [line for line in Path(f"/proc/{pid}/maps").read_text().splitlines() if f"bhd-{name}." in line]
    assert lines
    return [line for line in lines if "w" in line.split()[1]]


def view_and_vanish(report: Path) -> None:
    simulation, scene = made()
    viewer = Viewer(simulation)
    run(simulation, scene, 3)
    report.write_text(f"{viewer.pid}")
    os._exit(9)


def test_it_ends_with_the_robots_process_however_that_ends(stand_in: StandIn, tmp_path: Path) -> None:
    report = tmp_path / "pid"
    assert Fork(view_and_vanish, report).wait() == 9
    until(lambda: not is_alive(int(report.read_text())), "the viewer ends")


def test_a_window_that_cannot_be_opened_is_reported(stand_in: StandIn) -> None:
    (stand_in.folder / "broken").touch()
    simulation, _ = made()
    with closing(simulation), pytest.raises(RenderingError, match=r"division by zero.*bhd-monitor --3d"):
        Viewer(simulation)


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def serving(root: Path) -> list[str]:
    return ["serve", "--robot.type=turtlebot3", "--view=true"]


def evaluating(root: Path) -> list[str]:
    options = ["--robot.type=turtlebot3", "--task.type=avoid", "--brain.type=avoidance", "--view=true"]
    return [*options, f"--output_dir={root}"]


def recording(root: Path, **more: object) -> list[str]:
    return options(root, view="true", **more)


@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (ros2, serving),
        (record, recording),
        (record, lambda root: recording(root, robot__clock="realtime")),
        (evaluate, evaluating),
    ],
    ids=["serve", "record", "record on the wall clock", "eval"],
)
def test_without_a_display_nothing_is_begun(
    command: Callable[[list[str]], int],
    arguments: Callable[[Path], list[str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert command(arguments(tmp_path / "data")) == 2
    printed = capsys.readouterr()
    assert "no display here (X11: The DISPLAY environment variable is missing)" in printed.err
    assert "bhd-monitor --3d" in printed.err
    assert printed.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_the_same_with_and_without_it(
    stand_in: StandIn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert record(options(tmp_path / "alone")) == 0
    monkeypatch.setattr("bhd_lerobot.robots.viewer.viewer.require_display", lambda: None)
    assert record(options(tmp_path / "viewed", view="true", n_envs=2)) == 0
    assert stand_in.shown() is not None
    assert data_columns(tmp_path / "viewed") == data_columns(tmp_path / "alone")
    assert episode_rows(tmp_path / "viewed") == episode_rows(tmp_path / "alone")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"robot__plant": "ros2", "robot__clock": "realtime"}, "'turtlebot3' is not simulated here; bhd-monitor --3d"),
        ({"engine": "ray"}, "view is true and engine is 'ray'"),
    ],
)
def test_what_is_not_simulated_here_is_refused(
    overrides: dict[str, object], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert record(recording(tmp_path / "data", **overrides)) == 2
    assert message in capsys.readouterr().err
