"""`bhd-ros2 play`: what was recorded comes again, in its order and not too early, and is recorded again."""

import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from bhd_lerobot.cli.ros2 import main
from bhd_lerobot.ros2.bag.player.offer import recorded_qos
from bhd_lerobot.ros2.bag.player.play import Player, PlayOptions
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.bag.storage.read import Topic
from bhd_lerobot.ros2.bag.storage.write import BagWriter, profile
from bhd_lerobot.ros2.live.network import LATCHED, NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.serialize import decode, encode_one
from tests.forks import Fork
from tests.ros2.peer_env import Peer
from tests.waiting import until

TEXT, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
START, STEP = 1_700_000_000 * 10**9, 20_000_000
COUNT = 30
TOPICS = {
    "/words": profile(10),
    "/robot1/fast": profile(5, reliable=False),
    "/robot1/latched": profile(1, transient_local=True),
}

type Messages = dict[str, list[tuple[int, bytes]]]


def text(number: int) -> bytes:
    return encode_one(TEXT, {"data": str(number)})


def write(path: Path, storage: str = "mcap") -> Path:
    """Write a bag of three topics, of which one is latched and has a message at the beginning alone."""
    with BagWriter(path, storage, {}) as bag:
        connections = {topic: bag.connect(topic, TEXT, [kept]) for topic, kept in TOPICS.items()}
        bag.append(connections["/robot1/latched"], START, text(-1))
        for number in range(COUNT):
            for topic in ("/words", "/robot1/fast"):
                bag.append(connections[topic], START + number * STEP, text(number))
    return path


def read(path: Path) -> Messages:
    found: Messages = {}
    with Reader(path) as reader:
        for connection, received, data in reader.messages():
            found.setdefault(connection.topic, []).append((received, bytes(data)))
    return found


def texts(messages: Messages) -> dict[str, list[str]]:
    return {topic: [decode(TEXT, data).data for _, data in several] for topic, several in messages.items()}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_is_played_is_recorded_again_with_its_quality_of_service(storage, domain, tmp_path):
    first, second = write(tmp_path / "first", storage), tmp_path / "second"
    with (
        Fork(main, ["record", "--all", f"--output={second}", f"--domain={domain}"]) as recorder,
        Fork(main, ["play", str(first), f"--domain={domain}", "--wait=60"], output=tmp_path / "printed") as player,
    ):
        assert player.wait() == 0
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait() == 0
    assert texts(read(second)) == texts(read(first))  # the bytes are filled up to a multiple of four on the network
    times = [received for received, _ in read(second)["/words"]]
    assert times[-1] - times[0] > 0.9 * (COUNT - 1) * STEP  # later it may be, on a busy machine
    before, after = (find_bags(bag)[0].topics for bag in (first, second))
    for topic in TOPICS:
        kinds = [
            [(one["reliability"], one["durability"]) for one in found[topic].profiles] for found in (before, after)
        ]
        assert kinds[0] == kinds[1]
    printed = (tmp_path / "printed").read_text()
    assert re.search(rf"^/robot1/latched  {TEXT} +1 messages, reliable, transient local$", printed, re.MULTILINE)
    assert f"{first}: {2 * COUNT + 1} messages published" in printed


def test_a_real_node_receives_what_a_killed_recording_holds(domain: int, tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    (bag / "metadata.yaml").unlink()
    file = bag / "bag.mcap"
    file.write_bytes(file.read_bytes()[:-300])  # without its end
    with Peer("topic.py", "echo", "/words", TEXT, domain=domain) as peer:
        peer.wait_event("ready")
        fork = Fork(main, ["play", str(bag), f"--domain={domain}", "--topics", "words", "--loop", "--wait=60"])
        until(lambda: len(peer.events("message")) >= 2 * COUNT, "all messages come")
        fork.send_signal(signal.SIGINT)
        assert fork.wait() == 0
        numbers = [int(line["message"]["data"]) for line in peer.events("message")]
    assert numbers == [number % COUNT for number in range(numbers[0], numbers[0] + len(numbers))]


@pytest.fixture
def listener(domain: int) -> Iterator[Any]:
    with Node("listener", NetworkConfig(domain)) as node:
        yield {
            "/words": node.subscription("/words", TEXT, Qos(1000)),
            "/robot1/latched": node.subscription("/robot1/latched", TEXT, LATCHED),
            "/robot1/fast": node.subscription("/robot1/fast", TEXT, Qos(1000, reliable=False)),
        }


def numbers(listener: Any, topic: str) -> list[int]:
    return [int(decode(TEXT, one.data).data) for one in listener[topic].take()]


def play(*arguments: str, output: Path) -> Fork:
    return Fork(main, ["play", *arguments, "--wait=60"], output=output)


def test_a_late_start_begins_with_what_was_latched_before(listener: Any, domain: int, tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    fork = play(
        str(bag), f"--domain={domain}", f"--start={(COUNT / 2 - 0.5) * STEP / 1e9}", output=tmp_path / "printed"
    )
    assert fork.wait() == 0
    found: list[int] = []
    until(lambda: found.extend(numbers(listener, "/words")) or len(found) >= COUNT // 2, "all messages")
    assert found == list(range(COUNT // 2, COUNT))
    assert numbers(listener, "/robot1/latched") == [-1]


def test_times_are_those_of_the_bag_whichever_topics_are_published(listener: Any, domain: int, tmp_path: Path) -> None:
    bag, printed = tmp_path / "bag", tmp_path / "printed"
    with BagWriter(bag, "mcap", {}) as writer:
        first, late = (writer.connect(topic, TEXT, [TOPICS[topic]]) for topic in ("/robot1/latched", "/words"))
        writer.append(first, START, text(-1))
        for number in range(COUNT):
            writer.append(late, START + (COUNT + number) * STEP, text(number))
    arguments = [str(bag), f"--domain={domain}", f"--start={(1.5 * COUNT - 0.5) * STEP / 1e9}", "--topics"]
    assert play(*arguments, "/words", output=printed).wait() == 0
    found: list[Any] = []
    until(lambda: found.extend(numbers(listener, "/words")) or len(found) >= COUNT // 2, "all messages")
    assert found == list(range(COUNT // 2, COUNT))
    # A latched topic that has nothing after the start; and in a loop, nothing before the bag's end.
    assert play(*arguments, "/robot1/latched", output=printed).wait() == 0
    assert numbers(listener, "/robot1/latched") == [-1]
    with play(str(bag), f"--domain={domain}", "--loop", "--topics", "/robot1/latched", output=printed):
        found = []
        until(lambda: found.extend(listener["/robot1/latched"].take()) or len(found) >= 3, "the third round")
    assert found[2].sent_ns - found[1].sent_ns > 0.9 * 2 * COUNT * STEP


def test_a_request_to_end_is_heard_on_the_way_to_the_start(domain: int, tmp_path: Path) -> None:
    (bag,), lines, asked = find_bags(write(tmp_path / "bag")), list[str](), 0

    def stop() -> bool:
        nonlocal asked
        asked += "No node subscribes" in "".join(lines)
        return asked > 1

    with Node("player", NetworkConfig(domain)) as node:
        player = Player(node, bag, PlayOptions(start=60.0, wait=0.1), lines.append)
        assert player.run(stop).messages == 0


def test_a_loop_begins_anew_until_it_is_ended(listener: Any, domain: int, tmp_path: Path) -> None:
    bag, printed = write(tmp_path / "bag"), tmp_path / "printed"
    fork = play(str(bag), f"--domain={domain}", "--loop", "--rate=10", output=printed)
    found: list[int] = []
    until(lambda: found.extend(numbers(listener, "/words")) or found.count(5) >= 3, "the third round")
    fork.send_signal(signal.SIGINT)
    assert fork.wait() == 0
    assert found[: 2 * COUNT] == [*range(COUNT), *range(COUNT)]
    assert " messages published" in printed.read_text()


def test_a_player_that_was_stopped_goes_on_at_its_pace(listener: Any, domain: int, tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    fork = play(str(bag), f"--domain={domain}", output=tmp_path / "printed")
    found: list[Any] = []
    until(lambda: found.extend(listener["/words"].take()) or len(found) > 5, "some messages")
    fork.send_signal(signal.SIGSTOP)
    time.sleep(1.0)  # after a shorter one it catches up
    fork.send_signal(signal.SIGCONT)
    until(lambda: found.extend(listener["/words"].take()) or len(found) == COUNT, "all messages")
    assert fork.wait() == 0
    sent = [one.sent_ns for one in found]
    stopped = max(range(1, COUNT), key=lambda place: sent[place] - sent[place - 1])
    assert sent[-1] - sent[stopped] > 0.9 * (COUNT - 1 - stopped) * STEP


def test_what_follows_when_the_clock_was_set_back_does_not_come_at_once(
    listener: Any, domain: int, tmp_path: Path
) -> None:
    bag, half = tmp_path / "bag", COUNT // 2
    with BagWriter(bag, "mcap", {}) as writer:
        words = writer.connect("/words", TEXT, [TOPICS["/words"]])
        for number in range(COUNT):
            writer.append(words, START + number * STEP - (number >= half) * 3600 * 10**9, text(number))
    assert play(str(bag), f"--domain={domain}", output=tmp_path / "printed").wait() == 0
    found: list[Any] = []
    until(lambda: found.extend(listener["/words"].take()) or len(found) == COUNT, "all messages")
    assert found[-1].sent_ns - found[half].sent_ns > 0.9 * (COUNT - 1 - half) * STEP


def test_commands_and_other_publishers_are_named_before(domain: int, tmp_path: Path) -> None:
    bag, printed = tmp_path / "bag", tmp_path / "printed"
    with BagWriter(bag, "mcap", {}) as writer:
        writer.append(writer.connect("/cmd_vel", TWIST, []), START, encode_one(TWIST, {}))
        writer.append(writer.connect("/odd", "std_msgs/msg/Bool", []), START, encode_one("std_msgs/msg/Bool", {}))
    with Node("robot", NetworkConfig(domain)) as node:
        kept = node.subscription("/cmd_vel", TWIST), node.publisher("/odd", TEXT), node.subscription("/odd", TEXT)
        fork = Fork(main, ["play", str(bag), f"--domain={domain}", "--wait=3"], output=printed)
        assert fork.wait() == 0
        assert kept[0].take()
    said = printed.read_text()
    assert re.search(rf"/cmd_vel +{TWIST} +1 messages, reliable, commands a robot\n", said)
    assert "warning: /cmd_vel commands a robot, and /robot subscribes to it." in said
    assert "warning: /robot publishes /odd, too" in said
    assert f"warning: The subscription of /odd in /robot is of type {TEXT}" in said


def test_types_are_those_that_the_bag_defines_also_of_services(domain: int, tmp_path: Path) -> None:
    names, file = ("event_msgs/srv/Do_Event", "event_msgs/msg/Odd", "event_msgs/msg/No ü//Name"), tmp_path / "printed"
    texts = f"event_msgs/Part part\n{'=' * 80}\nMSG: event_msgs/Part\nint32 number\n", "what is this?\n", "int32 x\n"
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, text in zip(names, texts, strict=True):
            topic = "/" + name.split("/", 2)[2]
            connection = writer.add_connection(topic, name, msgdef=text, rihs01="RIHS01_0")
            writer.write(connection, START, b"\0\1\0\0\5\0\0\0")
    assert Fork(main, ["play", str(tmp_path / "bag"), f"--domain={domain}", "--wait=0.1"], output=file).wait() == 0
    assert "/Odd is left out: The definition of event_msgs/msg/Odd cannot be read" in file.read_text()
    assert "/No ü//Name is left out: no topic of ROS 2 has such a name." in file.read_text()
    assert "1 message published" in file.read_text()


@pytest.mark.law
@pytest.mark.parametrize(
    ("profiles", "count", "wanted"),
    [
        ([], 5, Qos()),
        ([profile(10)], 5, Qos(200)),
        ([profile(0)], 5, Qos(0)),
        ([profile(5, reliable=False)] * 2, 5, Qos(200, reliable=False)),
        ([profile(5, reliable=False), profile(500)], 5, Qos(500)),
        ([profile(1, transient_local=True)] * 3, 1, Qos(3, transient_local=True)),
        ([profile(1, transient_local=True)], 10_000, Qos(100, transient_local=True)),
    ],
)
def test_one_publisher_serves_all_whom_the_recorded_ones_served(profiles: Any, count: int, wanted: Qos) -> None:
    as_written = tuple(
        {"history": one.history.value, "depth": one.depth, "reliability": one.reliability.value,
         "durability": one.durability.value}
        for one in profiles
    )  # fmt: skip
    as_named = tuple(
        {**one, "reliability": kept.reliability.name.lower(), "durability": kept.durability.name.lower(),
         "history": kept.history.name.lower()}
        for one, kept in zip(as_written, profiles, strict=True)
    )  # fmt: skip
    for found in (as_written, as_named):
        assert recorded_qos(Topic("/a", TEXT, count, profiles=found)) == wanted


def test_what_cannot_be_played_is_an_error(domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, empty, several = write(tmp_path / "bag"), tmp_path / "empty", tmp_path / "several"
    with BagWriter(empty, "mcap", {}):
        pass
    for name in ("a", "b"):
        write(several / name)
    for arguments, said in (
        ([str(tmp_path / "none")], "does not exist"),
        ([str(several)], "has 2 bags; name one"),
        ([str(empty)], "has no message that can be published"),
        ([str(bag), "--topics", "/word"], "Did you mean '/words'?"),
        ([str(bag), "--rate=0"], "--rate is 0.0; it must be positive"),
        ([str(bag), "--start=-1"], "--start is -1.0"),
        ([str(bag), "--start=60", "--wait=0.1"], "--start is 60; the messages of "),
        ([str(bag), "--distro=jazy"], "Did you mean 'jazzy'?"),
    ):
        assert main(["play", f"--domain={domain}", *arguments]) == 2
        assert said in capsys.readouterr().err
