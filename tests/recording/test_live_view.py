"""`--display_data=true`: what the viewers get, that the run does not wait for them, and what happens without them."""

import io
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.utils import visualization_utils as helpers
from rich.console import Console

from bhd_lerobot.cli.record import main
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording import live_view as module
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.live_view import PACKAGES, LiveView, check_display, live_view, points
from bhd_lerobot.registry import make_simulation
from bhd_lerobot.robots.host.simulation import Simulation
from tests.forks import Fork
from tests.recording.support import data_columns, options, run_record


def display(**overrides: Any) -> Any:
    defaults = {
        "display_data": True,
        "display_mode": "foxglove",
        "display_ip": None,
        "display_port": None,
        "display_compressed_images": False,
    }
    return SimpleNamespace(**defaults | overrides)


class Helpers:
    """Stand-ins for LeRobot's helpers: keep what they are given; the first frame can be held up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.started: list[Any] = []
        self.frames: list[dict[str, Any]] = []
        self.ended: list[str] = []
        self.gate = threading.Event()
        self.gate.set()
        self.reached = threading.Event()
        self.error: Exception | None = None
        monkeypatch.setattr(helpers, "init_visualization", self.start)
        monkeypatch.setattr(helpers, "log_visualization_data", self.log)
        monkeypatch.setattr(helpers, "shutdown_visualization", self.ended.append)

    def start(self, mode: str, **arguments: Any) -> None:
        self.started.append((mode, arguments))

    def log(self, mode: str, **arguments: Any) -> None:
        self.reached.set()
        assert self.gate.wait(30)
        if self.error is not None:
            raise self.error
        self.frames.append({"mode": mode, **arguments})


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Helpers:
    return Helpers(monkeypatch)


@pytest.fixture
def robot() -> Simulation:
    config: Any = parse(RecordConfig, options(Path("unused"), robot__beams=8, robot__odometry="true"))
    return make_simulation(config.robot)


def columns(robot: Simulation, number: int = 0) -> dict[str, Any]:
    state = np.arange(len(robot.observation_names), dtype=np.float32) + 100 * number
    return {
        keys.OBSERVATION_STATE: state,
        keys.PHYSICS_STATE: np.arange(13.0),
        keys.ENVIRONMENT_STATE: np.array([7.0, 8.0]),
        keys.ACTION: np.array([0.2, -1.0], np.float32),
        keys.APPLIED_ACTION: np.array([0.15, -0.5]),
        keys.TIME: 0.1 * number,
        keys.LATENESS: 25e-6,
        keys.MODE: np.int8(Mode.TRACKING),
        keys.EVENT: 0,
    }


def test_every_number_is_sent_under_its_name(sent: Helpers, robot: Simulation) -> None:
    view = LiveView(display(), robot)
    image = np.full((4, 6, 3), 9, np.uint8)
    view(1, {"observation.images.front": np.zeros((2, 2, 3), np.uint8)})  # only the first of several robots is shown
    view(1, columns(robot, 5))
    view(0, {"observation.images.front": image})
    view(0, columns(robot))
    view.close()
    assert sent.started == [("foxglove", {"session_name": "bhd-record", "ip": None, "port": None})]
    (frame,) = sent.frames
    assert frame["mode"] == "foxglove"
    assert frame["compress_images"] is False
    assert frame["action"] == pytest.approx(
        {"x.vel": 0.2, "theta.vel": -1.0, "applied.x.vel": 0.15, "applied.theta.vel": -0.5}
    )
    seen = frame["observation"]
    assert (seen.pop("scan") == np.arange(2, 10)).all()
    assert (seen.pop("environment_state") == [7, 8]).all()
    assert seen.pop("observation.images.front") is image
    assert seen == pytest.approx(
        {
            **{"x.vel": 0, "theta.vel": 1, "x.pos": 10, "y.pos": 11, "theta.pos": 12},
            **dict(zip(module.POSE, range(7), strict=True)),
            **{keys.TIME: 0, keys.LATENESS: 25e-6, keys.MODE: 3},
        }
    )
    assert all(type(value) is float for value in seen.values())
    assert sent.ended == ["foxglove"]
    assert (view.shown, view.left_out, view.problem) == (1, 0, "")


def test_what_is_sent_is_a_copy_and_an_image_is_shown_once(sent: Helpers, robot: Simulation) -> None:
    sent.gate.clear()
    view = LiveView(display(), robot)
    frame = columns(robot)
    view(0, {"observation.images.front": np.zeros((2, 2, 3), np.uint8)})
    view(0, frame)
    for value in frame.values():
        if isinstance(value, np.ndarray):
            value[:] = -1
    view(0, columns(robot, 1))
    sent.gate.set()
    view.close()
    first, second = (one["observation"] for one in sent.frames)
    assert (first["scan"] == np.arange(2, 10)).all()
    assert (first["environment_state"] == [7, 8]).all()
    assert "observation.images.front" in first
    assert "observation.images.front" not in second


def test_a_slow_view_does_not_delay_the_run_and_shows_the_newest_frames(sent: Helpers, robot: Simulation) -> None:
    sent.gate.clear()
    view = LiveView(display(), robot)
    view(0, columns(robot, 0))
    assert sent.reached.wait(30)
    for number in range(1, 10):
        view(0, columns(robot, number))
    sent.gate.set()
    view.close()
    assert [round(frame["observation"][keys.TIME], 3) for frame in sent.frames] == [0, 0.8, 0.9]
    assert (view.shown, view.left_out) == (3, 7)


def test_a_view_that_fails_is_reported_at_the_end_and_does_not_end_the_run(sent: Helpers, robot: Simulation) -> None:
    console = Console(file=io.StringIO(), width=120)
    sent.error = OSError("viewer gone")
    with live_view(display(), robot, console) as view:
        assert view is not None
        view(0, columns(robot))
        view._thread.join(30)
        view(0, columns(robot))
    assert "OSError: viewer gone" in console.file.getvalue()
    assert sent.ended == ["foxglove"]


def test_a_viewer_that_cannot_be_reached_is_an_error_before_the_run(robot: Simulation) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ConfigError, match=r"rerun could not be started: .*refused"):
        LiveView(display(display_mode="rerun", display_ip="127.0.0.1", display_port=port), robot)


def record_while_the_viewer_goes(root: Path) -> int:
    """Record with a viewer that goes as soon as it has been connected to; in a process of its own."""
    server = socket.create_server(("127.0.0.1", 0))
    start = module.RerunExtras.__init__

    def start_and_go(*arguments: Any) -> None:
        start(*arguments)
        server.close()

    module.RerunExtras.__init__ = start_and_go
    module._END_S = 0.5
    where = ["--display_data=true", "--display_ip=127.0.0.1", f"--display_port={server.getsockname()[1]}"]
    return main([*options(root, dataset__num_episodes=1, dataset__episode_time_s=1), *where])


def test_a_viewer_that_disappears_does_not_delay_the_end_of_the_run(tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert Fork(record_while_the_viewer_goes, tmp_path / "d", output=log).wait() == 0, log.read_text()
    assert "Live view: ended after" in log.read_text()
    assert len(data_columns(tmp_path / "d")["index"]) == 10


@pytest.mark.parametrize(("ip", "port", "compress"), [(None, None, False), ("10.0.0.1", 9876, True)])
def test_images_over_a_network_are_compressed(sent, robot, ip, port, compress):
    view = LiveView(display(display_ip=ip, display_port=port), robot)
    view(0, columns(robot))
    view.close()
    assert sent.started[0][1]["ip"] == ip
    assert sent.started[0][1]["port"] == port
    assert sent.frames[0]["compress_images"] is compress


def test_the_modes_are_lerobots() -> None:
    assert tuple(PACKAGES) == helpers.VISUALIZATION_MODES


@pytest.mark.parametrize("wrong", [{"display_ip": "10.0.0.1"}, {"display_port": 9876}])
def test_half_an_address_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="give both"):
        check_display(display(display_mode="rerun", **wrong))


@pytest.mark.parametrize(("mode", "package"), [("rerun", "rerun-sdk"), ("foxglove", "foxglove-sdk")])
def test_a_package_that_is_missing_is_named_before_anything_starts(mode, package, monkeypatch, tmp_path):
    find: Callable[..., Any] = module.importlib.util.find_spec
    missing = PACKAGES[mode][1]
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None if name == missing else find(name))
    with pytest.raises(ConfigError, match=f"'{package}', which is not installed"):
        parse(RecordConfig, options(tmp_path / "d", display_data="true", display_mode=mode))
    parse(RecordConfig, options(tmp_path / "d", display_mode=mode))  # no package is needed without display_data


def test_points_lie_ahead_upwards_and_to_the_left_leftwards() -> None:
    scan = np.array([1.0, 2.0, 3.5, 4.0])  # ahead, left, behind (no return), right
    assert points(scan, 3.5 + 1e-9) == pytest.approx(np.array([[0, -1], [-2, 0], [0, 3.5]]), abs=1e-12)
    assert points(scan, 3.5) == pytest.approx(np.array([[0, -1], [-2, 0]]), abs=1e-12)


def test_a_recording_shows_the_frames_that_it_records_and_is_the_same_without(sent: Helpers, tmp_path: Path) -> None:
    short = {"dataset__num_episodes": 2, "dataset__episode_time_s": 2, "n_envs": 2}
    _, printed = run_record(tmp_path / "d", display_data="true", display_mode="foxglove", **short)
    recorded = data_columns(tmp_path / "d")
    run_record(tmp_path / "unseen", **short)
    assert data_columns(tmp_path / "unseen") == recorded
    first = [i for i, episode in enumerate(recorded["episode_index"]) if episode == 0]
    shown = {round(frame["observation"][keys.TIME], 6): frame for frame in sent.frames}
    assert shown
    assert shown.keys() <= {round(recorded[keys.TIME][i], 6) for i in first}
    for i in first:
        frame = shown.get(round(recorded[keys.TIME][i], 6))
        if frame is not None:
            assert list(frame["action"].values())[:2] == pytest.approx(recorded[keys.ACTION][i])
            assert frame["action"]["applied.x.vel"] == pytest.approx(recorded[keys.APPLIED_ACTION][i][0])
            assert frame["observation"]["x.vel"] == pytest.approx(recorded[keys.OBSERVATION_STATE][i][0])
            assert frame["observation"][keys.MODE] == recorded[keys.MODE][i]
    missing = len(first) - len(sent.frames)
    assert ("left out" in printed) == (missing > 0)
    if missing:
        assert f"{len(sent.frames)} frames shown, {missing} left out" in printed


def record_and_list_viewers(arguments: list[str]) -> int:
    status = main(arguments)
    print(sorted({"rerun", "foxglove"} & set(sys.modules)))
    return status


def test_rerun_is_not_imported_unless_it_is_wanted(tmp_path: Path) -> None:
    arguments = options(tmp_path / "d", dataset__num_episodes=1, dataset__episode_time_s=1)
    assert Fork(record_and_list_viewers, arguments, output=tmp_path / "log").wait() == 0
    assert (tmp_path / "log").read_text().splitlines()[-1] == "[]"


def test_rerun_itself_takes_it(robot: Simulation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    path = tmp_path / "view.rrd"
    monkeypatch.setattr(rerun, "spawn", lambda **_: rerun.save(path))  # a file in place of a viewer
    view = LiveView(display(display_mode="rerun"), robot)
    view(0, {"observation.images.front": np.zeros((4, 6, 3), np.uint8)})
    view(0, columns(robot))
    view.close()
    assert (view.shown, view.problem) == (1, "")
    entities = {path.removeprefix("/") for path in entity_paths(rerun, path)}
    assert {"action.x.vel", "action.applied.x.vel", "observation.scan", "observation.pose.x"} <= entities
    assert {f"observation.{keys.LATENESS}", f"observation.{keys.MODE}", "observation.images.front"} <= entities
    assert {"scan_points", "mode"} <= entities


def entity_paths(rerun: Any, path: Path) -> set[str]:
    schema = rerun.experimental.RrdReader(path).store().schema()
    return {column.entity_path.replace("\\", "") for column in schema.component_columns()}
