"""Topics by option: images and the clock."""

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.node import Node, Publisher
from bhd_lerobot.ros2.messages import views
from bhd_lerobot.ros2.messages.images import COMPRESSED, encode_image
from bhd_lerobot.ros2.messages.parts import Frames, stamp_tree
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.serve.server import Output, State, Topics

CLOCK_HZ = 100
_CLOCK = "rosgraph_msgs/msg/Clock"


class CameraTopics(Topics):
    """The images of a robot's cameras, one an action: ``/camera/image_raw/compressed``, or with the camera's name."""

    def __init__(self, host: LiveHost, node: Node) -> None:
        self._host, self._pending = host, 0
        model = host.world.model
        self._fovy = {name: math.radians(model.cam_fovy[model.camera(name).id]) for name in host.camera_shapes}
        alone = len(host.camera_shapes) == 1
        prefix = {name: "/camera" if alone else f"/{name}" for name in host.camera_shapes}
        self._images = {
            name: node.publisher(f"{one}/image_raw/compressed", COMPRESSED, SENSOR_DATA) for name, one in prefix.items()
        }
        self._infos = {
            name: node.publisher(f"{one}/camera_info", views.CAMERA_INFO, SENSOR_DATA) for name, one in prefix.items()
        }
        host.start_rendering()
        self.outputs = [Output(host.rates.fps, self._publish)]

    def _publish(self, state: State) -> None:
        if self._pending:  # the renderer is behind
            return
        self._host.latest()
        frames = state.frames
        for name, (height, width, _) in self._host.camera_shapes.items():
            frame = f"{name}_optical_frame"
            [info] = views.camera_info(frames, frame, (height, width), self._fovy[name])
            self._infos[name].send(info)
            self._pending += 1
            self._host.render_later(0, name, partial(self._deliver, self._images[name], frames, frame))

    def _deliver(self, publisher: Publisher, frames: Frames, frame: str, image: NDArray[np.uint8]) -> None:
        publisher.send(encode_image(frames, frame, image, compressed=True))
        self._pending -= 1


class ClockTopic(Topics):
    """``/clock``, for nodes with `use_sim_time`; it is the wall clock."""

    def __init__(self, node: Node) -> None:
        self._clock = node.publisher("/clock", _CLOCK, SENSOR_DATA)
        self.outputs = [Output(CLOCK_HZ, self._publish)]

    def _publish(self, state: State) -> None:
        fields: dict[str, Any] = {"clock": stamp_tree(state.stamps)}
        self._clock.send(encode(_CLOCK, fields, 1)[0])
