"""Draw what a client of Foxglove's WebSocket protocol receives of a served base and a served arm.

It is no image of the Foxglove app: the messages are decoded by the schemas that come with them and drawn by Matplotlib.
The base is driven in a curve and the arm gets a goal, both by what the client publishes.

    bhd-ros2 serve --robot.type=turtlebot3 --network.domain=41 --foxglove_port=8765
    bhd-ros2 serve --robot.type=ur5 --network.domain=42 --foxglove_port=8766
    python scripts/draw_foxglove.py 8765 8766 docs/images/foxglove.png
"""

import argparse
import asyncio
import json
import struct
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import aiohttp
import numpy as np
from matplotlib import pyplot as plt
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from bhd_lerobot.ros2.messages.serialize import encode

DRIVE_S, MOVE_S = 12.0, 2.0
SPEED, TURN = 0.15, 0.35  # of the base [m/s, rad/s]
GOAL = {"position": {"x": 0.35, "y": -0.35, "z": 0.3}, "orientation": {"x": 1.0}}
JOINT_SPEED = 0.5  # of the arm [rad/s]
COLORS = {"path": "tab:blue", "plan": "tab:orange", "goal": "tab:red", "scan": "0.35", "frame": "tab:green"}


class Client:
    """A client that is subscribed to all topics.

    Attributes:
        schemas: the definition of each topic's type, by topic.
        messages: the newest 2000 decoded messages, by topic.
        notices: what the server reported.
    """

    def __init__(self, port: int) -> None:
        self._url = f"ws://127.0.0.1:{port}"
        self.schemas: dict[str, Schema] = {}
        self.messages: dict[str, deque[Any]] = {}
        self.notices: list[str] = []
        self._topics: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
        self._published: dict[tuple[str, str], int] = {}

    async def __aenter__(self) -> Self:
        """Connect."""
        self._session = aiohttp.ClientSession()
        try:
            self._socket = await self._session.ws_connect(self._url, protocols=["foxglove.sdk.v1"], max_msg_size=0)
        except aiohttp.ClientConnectionError as error:
            await self._session.close()
            raise SystemExit(f"{self._url}: {error}. Serve a robot there first: --foxglove_port.") from error
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Disconnect."""
        await self._socket.close()
        await self._session.close()

    async def receive(self, timeout_s: float = 0.01) -> None:
        """Take what comes next, if it comes in time."""
        try:
            received = await self._socket.receive(timeout_s)
        except TimeoutError:
            return
        if received.type == aiohttp.WSMsgType.BINARY:
            topic, decode = self._topics[struct.unpack_from("<I", received.data, 1)[0]]
            self.messages[topic].append(decode(received.data[13:]))
        elif received.type == aiohttp.WSMsgType.TEXT:
            told = json.loads(received.data)
            if told["op"] == "advertise":
                await self._subscribe(told["channels"])
            elif told["op"] == "status":
                self.notices.append(told["message"])
        else:
            raise SystemExit(f"{self._url}: the server has closed the connection.")

    async def until(self, condition: Callable[[], Any]) -> None:
        """Take what comes until a condition holds."""
        while not condition():
            await self.receive()

    async def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        for channel in channels:
            name, encoding = channel["schemaName"], channel["schemaEncoding"]
            schema = Schema(id=channel["id"], name=name, encoding=encoding, data=channel["schema"].encode())
            decode = DecoderFactory().decoder_for(channel["encoding"], schema)
            if decode is None:
                raise SystemExit(f"{channel['topic']}: {channel['encoding']} with {encoding} cannot be decoded.")
            self.schemas[channel["topic"]] = schema
            self.messages[channel["topic"]] = deque(maxlen=2000)
            self._topics[channel["id"]] = channel["topic"], decode
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        await self._socket.send_json({"op": "subscribe", "subscriptions": wanted})

    async def publish(self, topic: str, msgtype: str, data: bytes, encoding: str = "cdr") -> None:
        """Publish a serialised message."""
        number = self._published.get((topic, msgtype))
        if number is None:
            number = self._published[topic, msgtype] = len(self._published) + 1
            channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": msgtype}
            await self._socket.send_json({"op": "advertise", "channels": [channel]})
        await self._socket.send_bytes(struct.pack("<BI", 1, number) + data)


class Frames:
    """The tree of frames, as /tf and /tf_static have it."""

    def __init__(self, client: Client) -> None:
        self.parents: dict[str, tuple[str, NDArray[np.float64]]] = {}
        for topic in ("/tf_static", "/tf"):
            for message in client.messages[topic]:
                self.update(message)

    def update(self, message: Any) -> None:
        """Take a message."""
        for one in message.transforms:
            self.parents[one.child_frame_id] = (
                one.header.frame_id,
                matrix(one.transform.translation, one.transform.rotation),
            )

    def place(self, frame: str) -> NDArray[np.float64]:
        """Return a frame in the root of its tree, shape (4, 4)."""
        if frame not in self.parents:
            return np.eye(4)
        parent, transform = self.parents[frame]
        placed: NDArray[np.float64] = self.place(parent) @ transform
        return placed


def matrix(position: Any, turn: Any) -> NDArray[np.float64]:
    """Return the homogeneous transform of a position and a quaternion of a message."""
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    made = np.eye(4)
    made[:3, 0] = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    made[:3, 1] = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    made[:3, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    made[:3, 3] = position.x, position.y, position.z
    return made


def points(poses: Any) -> NDArray[np.float64]:
    """Return the positions of stamped poses, shape (n, 3)."""
    return np.array([[one.pose.position.x, one.pose.position.y, one.pose.position.z] for one in poses]).reshape(-1, 3)


async def drive(port: int) -> Client:
    """Drive a base in a curve, as the panel Teleop does, and return what was received."""
    async with Client(port) as client:
        start = sent = time.monotonic()
        while (now := time.monotonic()) < start + DRIVE_S:
            await client.receive()
            if now > sent + 0.1:
                sent = now
                turn = TURN if now - start < DRIVE_S / 2 else -TURN
                twist = {"linear": {"x": SPEED}, "angular": {"z": turn}}
                await client.publish(
                    "/cmd_vel", "geometry_msgs/msg/Twist", encode("geometry_msgs/msg/Twist", twist, 1)[0]
                )
        return client


async def move(port: int) -> Client:
    """Send an arm a goal, as the panel Publish does, and return what was received until it is on its way."""
    async with Client(port) as client:
        await client.until(lambda: client.messages.get("/tf"))
        goal = {"task_id": f"draw {time.time_ns()}", "target_pose": GOAL, "max_velocity": JOINT_SPEED}
        kind = "bhd_interfaces/msg/BrainCommand"
        await client.publish("/brain/command", kind, encode(kind, goal, 1)[0])
        await client.until(
            lambda: client.messages["/cerebellum/plan"] and client.messages["/cerebellum/plan"][-1].poses
        )
        end = time.monotonic() + MOVE_S
        await client.until(lambda: time.monotonic() > end)
        return client


def draw_base(client: Client, axes: Any) -> None:
    """Draw scan, path and frames from above."""
    frames, scan = Frames(client), client.messages["/scan"][-1]
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    seen = np.isfinite(scan.ranges)
    ranges, angles = np.asarray(scan.ranges)[seen], angles[seen]
    beams = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(angles)), np.ones(len(angles))])
    x, y, *_ = frames.place(scan.header.frame_id) @ beams
    axes.scatter(x, y, s=4, color=COLORS["scan"], label="/scan")
    path = points(client.messages["/cerebellum/path"][-1].poses)
    axes.plot(path[:, 0], path[:, 1], color=COLORS["path"], label="/cerebellum/path")
    for name in ("odom", "base_footprint"):
        origin, ahead, left = (frames.place(name) @ np.array([*end, 0, 1]) for end in ((0, 0), (0.2, 0), (0, 0.2)))
        for end, color in ((ahead, "tab:red"), (left, "tab:green")):
            axes.plot([origin[0], end[0]], [origin[1], end[1]], color=color)
        axes.annotate(name, origin[:2], xytext=(6, -10), textcoords="offset points", fontsize=8)
    axes.set(title="turtlebot3, frame odom", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(loc="lower right", fontsize=8)


def draw_arm(client: Client, axes: Any) -> None:
    """Draw links, planned path and goal."""
    frames = Frames(client)
    base = np.linalg.inv(frames.place("base"))  # plan and goal are in this frame
    past, gone = Frames(client), []
    for message in client.messages["/tf"]:
        past.update(message)
        gone.append((base @ past.place("tool"))[:3, 3])
    for child, (parent, _) in frames.parents.items():
        ends = np.stack([(base @ frames.place(name))[:3, 3] for name in (parent, child)])
        axes.plot(*ends.T, color="0.35", linewidth=3, solid_capstyle="round")
        axes.scatter(*ends[1], color=COLORS["frame"], s=10)
        if child in ("base", "forearm_link", "tool"):
            axes.text(*ends[1], f"  {child}", fontsize=8)
    plan = points(client.messages["/cerebellum/plan"][-1].poses)
    axes.plot(*plan.T, "--", color=COLORS["plan"], label="/cerebellum/plan")
    axes.plot(*np.array(gone).T, color=COLORS["path"], label="tool by /tf")
    goal = client.messages["/cerebellum/goal"][-1]
    place = matrix(goal.pose.position, goal.pose.orientation)
    axes.scatter(*place[:3, 3], color=COLORS["goal"], label="/cerebellum/goal")
    for column in range(3):
        axes.plot(
            *np.stack([place[:3, 3], place[:3, 3] + 0.1 * place[:3, column]]).T, color=COLORS["goal"], linewidth=1
        )
    axes.set(title="ur5, frame base", xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    axes.view_init(elev=22, azim=-20)
    axes.legend(loc="upper left", fontsize=8)


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", type=int, help="--foxglove_port of a turtlebot3")
    parser.add_argument("arm", type=int, help="--foxglove_port of a ur5")
    parser.add_argument("file", type=Path, help="the PNG")
    options = parser.parse_args()
    base, arm = asyncio.run(drive(options.base)), asyncio.run(move(options.arm))
    figure = plt.figure(figsize=(11, 5), layout="constrained")
    draw_base(base, figure.add_subplot(1, 2, 1))
    draw_arm(arm, figure.add_subplot(1, 2, 2, projection="3d"))
    figure.savefig(options.file, dpi=110)
    print(
        f"{options.file}: {sum(map(len, base.messages.values()))} and {sum(map(len, arm.messages.values()))} messages"
    )


if __name__ == "__main__":
    main()
