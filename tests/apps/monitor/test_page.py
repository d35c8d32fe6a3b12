"""The page of `bhd-monitor --3d`: it draws what the robot publishes, as it publishes it, and for this machine alone."""

import http.client
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from bhd_lerobot.apps.monitor.page import served
from bhd_lerobot.bodies.scenes import scene_to_json
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.realtime.block import LiveBlock, LiveLayout, Phase, Word
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_simulation
from bhd_lerobot.robots.host.state import published_dtype
from tests.apps.browser import opened, wait_until
from tests.recording.support import options

BASE: dict[str, object] = {}
ARM: dict[str, object] = {
    **{"robot.type": "ur5", "robot.scene": "pick", "robot.beams": None, "brain.type": "pick", "task.type": "pick"}
}
NUMBERS = iter(range(1000))


class Robot:
    """A robot that publishes where its simulation is."""

    def __init__(self, overrides: dict[str, object], *, has_world: bool = True) -> None:
        config: Any = parse(RecordConfig, options(Path("unused"), **overrides)).robot
        self.simulation = make_simulation(config)
        self.has_world = has_world
        dtype = published_dtype(self.simulation)
        if not has_world:
            width = {"physics": (np.float64, (1, 0))}
            dtype = np.dtype([(name, *width.get(name, (dtype[name],))) for name in dtype.names or ()])
        body, names = self.simulation.body, list(self.simulation.observation_names)
        about = {"robot": config.type, "observations": names, "drives": body.drive is not None}
        name = f"test-page-{os.getpid()}-{next(NUMBERS)}"
        self.block = LiveLayout(dtype, 8).create(name, about)
        self.block.words[Word.PHASE] = Phase.RUNNING
        self.state = np.zeros((), dtype)
        self.scene: Any = config.start_scene()

    def place(self) -> None:
        self.simulation.reset(np.zeros(1, np.intp), [self.scene], [0])
        self.block.publish_scene(scene_to_json(self.scene if self.has_world else None))

    def publish(self, **fields: Any) -> None:
        self.state["state"]["mode"], self.state["sensed_ns"] = Mode.TRACKING, time.monotonic_ns()
        self.state["observation"] = self.simulation.sense()[0]
        if self.has_world:
            self.state["physics"] = np.concatenate(self.simulation.physics, axis=1)
        for name, value in fields.items():
            (self.state["state"] if name == "odometry" else self.state)[name] = value
        self.block.ring.publish(self.state)

    def move(self) -> None:
        """Be elsewhere: an arm by a joint, a base by some metres."""
        self.simulation.world.qpos[0, 0] += 0.4
        self.publish(**({} if self.has_world else {"odometry": self.state["state"]["odometry"] + [3.0, 0.0, 0.0]}))

    def close(self) -> None:
        self.block.close()
        self.simulation.close()


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> Iterator[Robot]:
    with closing(Robot(getattr(request, "param", BASE))) as made:
        made.place()
        made.publish()
        yield made


class Stream:
    """What the page is sent."""

    def __init__(self, address: str) -> None:
        self._connection = http.client.HTTPConnection(urlsplit(address).netloc)
        self._connection.request("GET", "/api/live")
        self.answer = self._connection.getresponse()

    def next(self) -> dict[str, Any]:
        line = self.answer.readline()
        assert line.startswith(b"data: "), line
        assert self.answer.readline() == b"\n"
        return dict(json.loads(line.removeprefix(b"data: ")))

    def until(self, condition: Any) -> dict[str, Any]:
        while not condition(message := self.next()):
            pass
        return message

    def close(self) -> None:
        self._connection.close()


@pytest.fixture
def watched() -> Iterator[Any]:
    opened_blocks: list[LiveBlock] = []

    def watch(robot: Robot) -> LiveBlock:
        opened_blocks.append(LiveBlock.watch(robot.block.name))
        return opened_blocks[-1]

    yield watch
    for block in opened_blocks:
        block.close()


@pytest.mark.law
@pytest.mark.parametrize("robot", [BASE, ARM], ids=["turtlebot3", "ur5"], indirect=True)
def test_the_page_is_sent_where_the_robot_is_and_what_is_around_it(robot: Robot, watched: Any) -> None:
    with served(watched(robot), 0) as address, closing(Stream(address)) as stream:
        assert stream.answer.getheader("Content-Type") == "text/event-stream"
        first = stream.next()
        assert (first["mode"], first["phase"], first["estop"]) == ("tracking", "running", False)
        about = first["about"]
        assert about["scene"].items() >= json.loads(scene_to_json(robot.scene)).items()
        assert set(about["views"]) == ({"arm"} if "ur5" in about["title"] else {"base", "scan"})
        assert "about" not in stream.next()
        qpos = robot.simulation.world.qpos
        if "ur5" in about["title"]:
            qpos[0, 0] += 0.3
            robot.publish()
            moved = stream.until(lambda message: message["arrays"] != first["arrays"])
            capsules = np.reshape(moved["arrays"]["view.capsules"], (-1, 2, 3))
            assert np.linalg.norm(moved["arrays"]["view.tool"]) == pytest.approx(
                np.linalg.norm(first["arrays"]["view.tool"]), abs=1e-3
            )
            assert np.isfinite(capsules).all()
            objects = np.reshape(np.array(moved["arrays"]["view.objects"], float), (-1, 7))
            assert np.isfinite(objects[:, 0]).sum() == len(robot.scene.objects)
        else:
            qpos[0, :2] = 0.5, -0.25
            robot.publish()
            moved = stream.until(lambda message: message["arrays"] != first["arrays"])
            assert moved["arrays"]["view.base"][:2] == [0.5, -0.25]
            assert len(moved["arrays"]["observation.state"]) == len(robot.simulation.observation_names)
        robot.place()
        robot.publish()
        assert stream.until(lambda message: "about" in message)["about"] == about


def test_a_real_base_is_drawn_where_its_wheels_say(watched: Any) -> None:
    with closing(Robot(BASE, has_world=False)) as robot:
        robot.place()
        robot.publish(odometry=[1.0, 2.0, 0.5])
        with served(watched(robot), 0) as address, closing(Stream(address)) as stream:
            first = stream.next()
            assert first["about"]["views"]["base"]["from"] == "odometry"
            assert first["about"]["scene"] is None
            assert first["arrays"]["view.base"] == [1.0, 2.0, 0.5]


def test_what_is_not_finite_is_null_and_before_the_first_state_there_is_a_phase(watched: Any) -> None:
    with closing(Robot(BASE)) as robot, served(watched(robot), 0) as address, closing(Stream(address)) as stream:
        assert stream.next() == {"phase": "running", "estop": False}
        robot.place()
        robot.publish(observation=np.nan)
        assert None in stream.until(lambda message: "arrays" in message)["arrays"]["observation.state"]


@pytest.mark.law
def test_it_is_served_to_this_machine_and_to_nobody_elses_pages(robot: Robot, watched: Any) -> None:
    with served(watched(robot), 0) as address:
        assert urlsplit(address).hostname == "127.0.0.1"
        for path in ("/", "/api/live", "/static/js/live.js"):
            connection = http.client.HTTPConnection(urlsplit(address).netloc)
            connection.request("GET", path, headers={"Host": "stranger.example"})
            assert connection.getresponse().status == 403
            connection.close()
        connection = http.client.HTTPConnection(urlsplit(address).netloc)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert "default-src 'self'" in (answer.getheader("Content-Security-Policy") or "")
        assert b"live.js" in answer.read()
        connection.close()


def test_who_does_not_read_holds_up_nobody(robot: Robot, watched: Any) -> None:
    with served(watched(robot), 0) as address:
        silent = socket.create_connection((urlsplit(address).hostname, urlsplit(address).port))
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        silent.sendall(b"GET /api/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with closing(Stream(address)) as stream:
            for _ in range(30):
                stream.next()
    silent.close()
    assert robot.block.words[Word.PHASE] == Phase.RUNNING


def test_a_page_that_is_closed_is_no_error(robot: Robot, watched: Any, caplog: pytest.LogCaptureFixture) -> None:
    with served(watched(robot), 0) as address:
        with closing(Stream(address)) as stream:
            stream.next()
        stream.answer.close()
        with closing(Stream(address)) as other:
            for _ in range(30):
                other.next()
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_a_scene_that_is_too_long_is_left_out(robot: Robot, watched: Any) -> None:
    robot.block.publish_scene(json.dumps(["x" * 40_000]))
    count, text = watched(robot).scene
    assert (count, text) == (2, "null")


def test_a_port_in_use_is_named(robot: Robot, watched: Any) -> None:
    with served(watched(robot), 0) as address:
        port = urlsplit(address).port or 0
        with (
            pytest.raises(ConfigError, match=f"--port {port}: nothing can be served there"),
            served(watched(robot), port),
        ):
            pass


def pixels(page: Any) -> bytes:
    return bytes(page.locator(".view[data-view=scene] canvas").screenshot())


@pytest.mark.parametrize(("overrides", "has_world"), [(BASE, True), (BASE, False), (ARM, True)])
def test_the_browser_draws_the_scene_and_it_moves(browser, overrides, has_world, watched):
    with closing(Robot(overrides, has_world=has_world)) as robot:
        robot.place()
        robot.publish()
        see_it_move(browser, robot, watched)


def see_it_move(browser: Any, robot: Robot, watched: Any) -> None:
    with served(watched(robot), 0) as address, opened(browser, address) as page:
        kinds = page.eval_on_selector_all(".view", "views => views.map((one) => one.dataset.view)")
        assert kinds in (["scan", "top", "scene"], ["arm-above", "arm-side", "scene"])
        wait_until(page, "document.querySelector('[data-view=scene] canvas').dataset.frame === '0'")
        assert "tracking" in page.text_content("#state")
        while not page.evaluate("document.getElementById('banner').hidden"):  # one that is old has a line of its own
            robot.publish()
            page.wait_for_timeout(20)
        before = pixels(page)
        robot.move()
        while pixels(page) == before:
            robot.publish()
        wait_until(page, "!document.getElementById('banner').hidden")  # nothing more comes
        assert "s old" in page.text_content("#banner")
