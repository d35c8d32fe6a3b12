"""`bhd-ros2 record` beside a plain `rclpy` subscriber that writes with `rosbags`: `python -m benchmarks.ros2_record`.

Both record the same topics of a plain publisher: a TurtleBot3's, and joint states of an arm at 500 Hz. Measured are the
processor time, and what of the messages is not in the bag. The ratio is the median of some rounds. It needs the ROS 2
environment of the tests, which it installs on first use. Exits with 3 if a goal is missed, with 2 if nothing can be
measured here.
"""

import signal
import statistics
import struct
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rosbags.rosbag2 import Reader

from benchmarks._report import Report, parse_options
from benchmarks.ros2 import WARM_UP_S, processor_s
from tests.ros2 import peer_env
from tests.ros2.peer_env import Peer

TOPICS = ("--set=turtlebot3", "--topic=joint_states:500")
_STAMP = struct.Struct("<iI")
READY_S = 4.0  # until the topics are found and received


def measure(domain: int, seconds: float, *, is_ours: bool) -> tuple[float, int, int]:
    """Return the share of a processor that recording takes, and how many messages were sent and are in the bag.

    Those of the first seconds do not count, in which publisher and subscription find each other.
    """
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Peer("plain_pair.py", "publish", *TOPICS, "--measure=1000", domain=domain) as publisher:
            publisher.wait_event("ready")
            if is_ours:
                command = [sys.executable, "-m", "bhd_lerobot.cli.ros2", "record", "--all", f"--output={bag}"]
                command += [f"--domain={domain}", "--exclude=/rosout|/parameter_events"]
                process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
                share = _share(process.pid, seconds)
                publisher.stop()
                process.send_signal(signal.SIGINT)
                process.wait()
            else:
                packages = f"--packages={sysconfig.get_path('purelib')}"
                with Peer("plain_recorder.py", f"--output={bag}", packages, *TOPICS, domain=domain) as recorder:
                    share = _share(recorder.wait_event("ready")["pid"], seconds)
                    publisher.stop()
                    recorder.stop()
            summary = publisher.wait_event("summary")
        with Reader(bag) as reader:
            stamps = [_STAMP.unpack_from(data, 4) for _, _, data in reader.messages()]  # each begins with its header
        kept = sum(seconds * 10**9 + nanoseconds >= summary["since"] for seconds, nanoseconds in stamps)
        return share, summary["sent_since"], kept


def _share(pid: int, seconds: float) -> float:
    time.sleep(READY_S + WARM_UP_S)
    start, before = time.monotonic(), processor_s(pid)
    time.sleep(seconds)
    return (processor_s(pid) - before) / (time.monotonic() - start)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit status."""
    options = parse_options(
        __doc__, arguments, rounds=(3, "measure so often"), seconds=(10.0, "how long each time [s]")
    )
    found = peer_env._environment()
    if isinstance(found, peer_env.UnavailableError):
        print(f"No ROS 2 here: {found}", file=sys.stderr)
        return 2
    rounds: list[dict[bool, tuple[float, int, int]]] = []
    for _ in range(options.rounds):
        with peer_env.free_domain() as domain:
            rounds.append({is_ours: measure(domain, options.seconds, is_ours=is_ours) for is_ours in (False, True)})
    report = Report("Recording of a network beside a plain rclpy subscriber that writes with rosbags")
    report.numbers["rounds"] = [{"ours": one[True], "plain": one[False]} for one in rounds]
    ours, plain = (100 * statistics.median(one[is_ours][0] for one in rounds) for is_ours in (True, False))
    ratio = statistics.median(one[True][0] / one[False][0] for one in rounds)
    what = "processor [%], a TurtleBot3's topics and joint states at 500 Hz, recorded"
    report.add(what, f"{ours:.1f}, plain {plain:.1f}: {ratio:.2f} x", "at most 0.5 x", met=ratio <= 0.5)
    for name, is_ours in (("ours", True), ("plain", False)):
        missing = [one[is_ours][1] - one[is_ours][2] for one in rounds]
        total = sum(one[is_ours][1] for one in rounds)
        lost = sum(missing)
        goal, met = ("none", not lost) if is_ours else ("", None)
        report.add(
            f"messages sent after a warm-up that are not in the bag, {name}", f"{lost} of {total}", goal, met=met
        )
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
