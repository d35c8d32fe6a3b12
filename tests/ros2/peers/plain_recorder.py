"""A plain subscriber as one writes it to record: raw messages by `rclpy`, into a bag by `rosbags`.

    plain_recorder.py --output FOLDER --packages FOLDER [--set turtlebot3|ur5|command] [--topic NAME:HZ]…

`rosbags` is that of another environment, whose packages lie in the folder.
"""

import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import node as peer

parser = peer.options(__doc__)
parser.add_argument("--output", type=Path, required=True)
parser.add_argument("--packages", required=True)
args, rest = parser.parse_known_args()
sys.path.append(args.packages)
sys.argv[1:] = ["subscribe", *rest]

from plain_pair import RATES, TYPES  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402


class Recorder:
    def __init__(self, node: Node) -> None:
        self.writer = Writer(args.output, version=8, storage_plugin=StoragePlugin.MCAP)
        self.writer.open()
        self.counts = dict.fromkeys(RATES, 0)
        store = get_typestore(Stores.ROS2_HUMBLE)
        for name in RATES:
            package, _, _ = TYPES[name].__module__.partition(".")
            kind = f"{package}/msg/{TYPES[name].__name__}"
            connection = self.writer.add_connection(f"/{name}", kind, typestore=store)
            qos = qos_profile_sensor_data if name == "scan" else 1000
            receive = functools.partial(self.receive, name, connection)
            node.create_subscription(TYPES[name], f"/{name}", receive, qos, raw=True)

    def receive(self, name: str, connection: object, data: bytes) -> None:
        self.writer.write(connection, time.time_ns(), data)
        self.counts[name] += 1

    def close(self) -> None:
        self.writer.close()
        peer.log("summary", half="record", counts=self.counts)


def main(new_node: Callable[[str], Node]) -> Callable[[], None]:
    return Recorder(new_node("plain_recorder")).close


if __name__ == "__main__":
    peer.run(main, args.seconds)
