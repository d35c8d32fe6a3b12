"""`bhd-ros2 record`: what real nodes send, read by `rosbags` and `mcap`, also after a kill."""

import contextlib
import re
import resource
import shutil
import signal
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bhd_lerobot.cli.ros2 import main
from bhd_lerobot.errors import DatasetExistsError, DatasetWriteError
from bhd_lerobot.ros2.bag.recorder import record
from bhd_lerobot.ros2.bag.recorder.record import Recorder, RecordOptions
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.live.network import LATCHED, SENSOR_DATA, NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.serialize import decode, encode_one
from tests.forks import Fork
from tests.ros2.peer_env import Peer, free_domain
from tests.waiting import until

TEXT, NUMBER = "std_msgs/msg/String", "std_msgs/msg/Int64"
COUNT = 100
RELIABLE = ("/words", "/robot1/arm/words", "/robot1/stamped", "/nested")
ENDINGS = {"mcap": "mcap", "sqlite3": "db3"}

type Read = dict[str, list[tuple[int, Any]]]


def counts(bag: Path) -> dict[str, int]:
    """Return how many messages of each topic can be read now."""
    with contextlib.suppress(Exception):  # it is being written
        return {name: topic.count for name, topic in find_bags(bag)[0].topics.items()}
    return {}


def by_rosbags(path: Path) -> Read:
    """Return times and messages by topic, of which the bag itself defines those that `rosbags` does not know."""
    store, found = get_typestore(Stores.ROS2_HUMBLE), defaultdict(list)
    with Reader(path) as reader:
        for connection in reader.connections:
            if connection.msgtype not in store.fielddefs:
                store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, received, data in reader.messages():
            found[connection.topic].append((received, store.deserialize_cdr(data, connection.msgtype)))
    return found


def by_mcap(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    found = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found[channel.topic].append((message.log_time, message.data))
    return found


def number_of(one: Any) -> int:
    """Return the number in a message."""
    if hasattr(one, "data"):
        return int(one.data)
    return int(one.twist.linear.x if hasattr(one, "twist") else one.basic_types_value.int32_value)


def last_of(bag: Path, topic: str) -> int:
    """Return the number in the last message that can be read now, or -1."""
    with contextlib.suppress(Exception):  # it is being written
        return number_of(by_rosbags(bag)[topic][-1][1])
    return -1


def check(read: Read) -> None:
    """Compare with what `bag_source.py` sent, from when it was heard on."""
    for topic in RELIABLE:
        assert [number for _, one in read[topic] if (number := number_of(one)) >= 0] == list(range(COUNT))
    assert [one.data for _, one in read["/latched"]] == ["latched"]
    assert {"latched", str(COUNT - 1)} <= {one.data for _, one in read["/mixed"]}
    fast = [number for _, one in read["/fast"] if (number := number_of(one)) >= 0]  # best effort
    assert fast
    assert fast == sorted(set(fast))
    for messages in read.values():
        times = [received for received, _ in messages]
        assert times == sorted(times)


class Recorded(NamedTuple):
    """What a recorder of the real nodes left behind."""

    bag: Path
    printed: str
    status: int


NAMED = ("words", "robot1/arm/words", "robot1/stamped", "/nested", "/mixed", "/fast", "/absent")
RECORDERS = {  # its arguments, and what ends it
    "mcap": (("--all", "--storage=mcap", "--exclude=/rosout|/parameter.*"), signal.SIGINT),
    "sqlite3": (("--all", "--storage=sqlite3", "--exclude=/rosout|/parameter.*"), signal.SIGINT),
    "killed mcap": (("--all", "--storage=mcap"), signal.SIGKILL),
    "killed sqlite3": (("--all", "--storage=sqlite3"), signal.SIGKILL),
    "named": ((*NAMED, "--wait=0.1"), signal.SIGTERM),
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Recorded]:
    """Record what `bag_source.py` sends by several recorders at a time, until all of it can be read."""
    folder, forks = tmp_path_factory.mktemp("recorded"), {}
    heard, bags = folder / "heard", [folder / name for name in RECORDERS]
    with contextlib.ExitStack() as running, free_domain() as domain:
        for name, (arguments, _) in RECORDERS.items():
            given = ["record", f"--output={folder / name}", f"--domain={domain}", *arguments]
            forks[name] = running.enter_context(Fork(main, given, output=folder / f"{name} printed"))
        with Peer("bag_source.py", f"--count={COUNT}", f"--heard={heard}", domain=domain) as peer:
            peer.wait_event("ready")
            for bag in bags:
                until(lambda bag=bag: all(counts(bag).get(one) for one in (*RELIABLE, "/mixed", "/fast")), "all come")
            heard.touch()
            peer.wait_event("sent")
            for bag in bags:
                until(lambda bag=bag: all(last_of(bag, topic) == COUNT - 1 for topic in RELIABLE), "all is in the bag")
        for name, (_, number) in RECORDERS.items():
            forks[name].send_signal(number)
            forks[name].wait()
    return {
        name: Recorded(folder / name, (folder / f"{name} printed").read_text(), fork.wait())
        for name, fork in forks.items()
    }


@pytest.mark.parametrize("storage", ENDINGS)
def test_what_real_nodes_send_is_in_the_bag_with_their_quality_of_service(storage, recorded):
    bag, printed, status = recorded[storage]
    assert status == 0
    read = by_rosbags(bag)
    check(read)
    assert "/rosout" not in read
    assert re.search(rf"^/robot1/arm/words +{len(read['/robot1/arm/words'])}  {TEXT}$", printed, re.MULTILINE)
    assert " messages in " in printed.splitlines()[-1]
    with Reader(bag) as reader:
        offered = {
            one.topic: [(qos.reliability.name, qos.durability.name) for qos in one.ext.offered_qos_profiles]
            for one in reader.connections
        }
        assert reader.message_count == sum(map(len, read.values()))
    assert offered["/latched"] == [("RELIABLE", "TRANSIENT_LOCAL")]
    assert offered["/fast"] == [("BEST_EFFORT", "VOLATILE")]
    assert sorted(offered["/mixed"]) == [("BEST_EFFORT", "VOLATILE"), ("RELIABLE", "TRANSIENT_LOCAL")]
    if storage == "mcap":
        raw = by_mcap(bag / f"{bag.name}.mcap")
        assert {topic: len(messages) for topic, messages in raw.items()} == {one: len(read[one]) for one in raw}


@pytest.mark.parametrize("storage", ENDINGS)
def test_what_was_recorded_before_a_kill_can_be_read_with_metadata_and_without(storage, recorded):
    bag, _, _ = recorded[f"killed {storage}"]
    file = bag / f"{bag.name}.{ENDINGS[storage]}"
    check(by_rosbags(bag))
    check(by_rosbags(file))
    sizes = {topic: len(messages) for topic, messages in by_rosbags(file).items()}
    if storage == "mcap":
        assert {topic: len(messages) for topic, messages in by_mcap(file).items()} == sizes
    for has_metadata in (True, False):
        (found,) = find_bags(bag)
        assert {topic: len(found.read([topic])[topic].data) for topic in sizes} == sizes
        assert ("metadata.yaml" in str(found.problems)) is not has_metadata
        (bag / "metadata.yaml").unlink(missing_ok=True)


def test_sigterm_ends_a_recording_of_named_topics_as_ctrl_c_does(recorded: dict[str, Recorded]) -> None:
    bag, printed, status = recorded["named"]
    assert status == 0
    assert set(by_rosbags(bag)) == {*RELIABLE, "/mixed", "/fast"}
    assert "Nobody publishes /absent, after 0.1 s; it is waited for." in printed


def message(msgtype: str, number: int) -> bytes:
    return encode_one(msgtype, {"data": f"{number:012d}" if msgtype == TEXT else number})


def source(domain: int, topics: list[tuple[str, str, Qos]], count: int, heard: Path) -> None:
    """Publish numbers on one topic after the other, until killed; on each -1 until the file `heard` has its place."""
    with Node("source", NetworkConfig(domain)) as node:
        kept = []
        for place, (topic, msgtype, qos) in enumerate(topics):
            kept.append(publisher := node.publisher(topic, msgtype, qos))
            while heard.stat().st_size <= place:
                publisher.send(message(msgtype, -1))
                time.sleep(0.02)
            for number in range(count):
                publisher.send(message(msgtype, number))
                time.sleep(0.005)
        while True:
            time.sleep(1)


class Recording:
    """A recorder in this process beside a `source`, until all of its numbers are in the bag.

    Attributes:
        numbers: of the messages in the bag of each topic, as far as it was written; without those below 0.
    """

    def __init__(
        self,
        domain: int,
        options: RecordOptions,
        *topics: tuple[str, str, Qos],
        count: int = 20,
        heard: Path | None = None,
    ) -> None:
        self.options, self.topics, self.count = options, topics, count
        self.heard = heard or options.output.with_suffix(".heard")
        self.heard.touch()
        self._fork = Fork(source, domain, list(topics), count, self.heard)
        self.node = Node("recorder", NetworkConfig(domain))
        self.recorder = Recorder(self.node, options, lambda line: None)

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self.node.close()
        self._fork.kill()

    def ended(self) -> bool:
        """Let the source go on where it is heard; return whether all is in the bag."""
        begun = [key for key, count in self.recorder.report.counts.items() if count]
        self.heard.write_text("x" * len(begun))
        names = [topic for topic, *_ in self.topics]
        return len(begun) == len(names) and len(self.numbers(names[-1])) >= self.count * names.count(names[-1])

    def numbers(self, topic: str) -> list[int]:
        """Return the numbers of a topic that can be read now; without those below 0."""
        with contextlib.suppress(Exception):  # it is being written
            data = find_bags(self.options.output)[0].read([topic])[topic].data
            found = [int(decode(TEXT if len(one) != 12 else NUMBER, one).data) for one in data]
            return [number for number in found if number >= 0]
        return []


def test_topics_and_types_and_offers_that_come_later_are_recorded(domain: int, tmp_path: Path) -> None:
    topics = [("/a", TEXT, Qos()), ("/b", TEXT, SENSOR_DATA), ("/c", NUMBER, LATCHED), ("/a", NUMBER, Qos())]
    with Recording(domain, RecordOptions(tmp_path / "bag"), *topics) as recording:
        report = recording.recorder.run(recording.ended)
        wanted = list(range(20))
        assert recording.numbers("/b") == recording.numbers("/c") == wanted
        assert recording.numbers("/a") == [*wanted, *wanted]
    assert report.counts.keys() == {(topic, msgtype) for topic, msgtype, _ in topics}
    read = by_rosbags(tmp_path / "bag")
    assert {topic: len(messages) for topic, messages in read.items()} == {
        topic: sum(count for (name, _), count in report.counts.items() if name == topic) for topic in ("/a", "/b", "/c")
    }


def source_of_two(domain: int, more: Path) -> None:
    """Publish 1 best effort, and 2 latched once a file is there, until killed."""
    with Node("source", NetworkConfig(domain)) as node:
        first, second = node.publisher("/a", TEXT, SENSOR_DATA), None
        while True:
            first.send(message(TEXT, 1))
            if more.exists():
                second = second or node.publisher("/a", TEXT, LATCHED)
                second.send(message(TEXT, 2))
            time.sleep(0.01)


@pytest.mark.parametrize("storage", ENDINGS)
def test_what_a_later_publisher_offers_is_in_the_bag(storage, domain, tmp_path):
    bag, more = tmp_path / "bag", tmp_path / "more"

    def offers() -> set[tuple[int, int]]:
        (topic,) = find_bags(bag)[0].topics.values()
        return {(one["reliability"], one["durability"]) for one in topic.profiles}

    def ended() -> bool:
        found: list[int] = []
        with contextlib.suppress(Exception):  # it is being written
            found = [number_of(one) for _, one in by_rosbags(bag)["/a"]]
            if 1 in found:
                more.touch()
            return len(offers()) > 1 or found.count(2) > 1000
        return False

    with Fork(source_of_two, domain, more), Node("recorder", NetworkConfig(domain)) as node:
        report = Recorder(node, RecordOptions(bag, storage=storage), lambda line: None).run(ended)
    assert offers() == {(2, 2), (1, 1)}
    assert len(by_rosbags(bag)["/a"]) == report.messages


@pytest.mark.parametrize("named", [".", "link"])
def test_an_empty_folder_that_is_there_becomes_the_bag(named, domain, tmp_path, monkeypatch):
    (tmp_path / "bag").mkdir()
    (tmp_path / "link").symlink_to("bag")
    monkeypatch.chdir(tmp_path / "bag" if named == "." else tmp_path)
    with Recording(domain, RecordOptions(Path(named)), ("/a", TEXT, Qos()), heard=tmp_path / "heard") as recording:
        recording.recorder.run(lambda: recording.recorder.report.messages > 0)
    assert by_rosbags(tmp_path / "bag")["/a"]


def test_times_go_on_when_a_clock_jumps(domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, jumps = time.time_ns, (0, 3600 * 10**9, -7200 * 10**9)
    with Recording(domain, RecordOptions(tmp_path / "bag"), ("/a", TEXT, Qos())) as recording:
        report = recording.recorder.report
        monkeypatch.setattr(time, "time_ns", lambda: real() + jumps[report.messages % 3])
        recording.recorder.run(recording.ended)
    times = [received for received, _ in by_rosbags(tmp_path / "bag")["/a"]]
    assert times == sorted(times)
    assert times[-1] - times[0] < 3000 * 10**9
    assert abs(times[0] - real()) < 3000 * 10**9


@pytest.mark.parametrize("storage", ENDINGS)
def test_a_disk_that_is_nearly_full_ends_the_recording(storage, domain, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    options = RecordOptions(tmp_path / "bag", storage=storage)
    with Recording(domain, options, ("/a", TEXT, Qos())) as recording:
        monkeypatch.setattr(
            shutil, "disk_usage", lambda path: usage._replace(free=record.LEAST_FREE - recording.ended())
        )
        with pytest.raises(DatasetWriteError, match="less than 64 MiB left, so the recording was ended"):
            recording.recorder.run(lambda: False)
        assert recording.numbers("/a") == list(range(20))
        report = recording.recorder.report
    assert len(by_rosbags(tmp_path / "bag")["/a"]) == find_bags(tmp_path / "bag")[0].expected == report.messages


def limited(size: int, arguments: list[str]) -> int:
    """Record where files have a largest size [bytes]."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    return main(arguments)


@pytest.mark.parametrize("storage", ENDINGS)
def test_where_nothing_can_be_written_any_more_what_was_written_can_be_read(storage, domain, tmp_path):
    bag, printed = tmp_path / "bag", tmp_path / "printed"
    arguments = ["record", "/a", f"--output={bag}", f"--domain={domain}", f"--storage={storage}"]
    fork = Fork(limited, 16 << 20, arguments, output=printed)
    with Node("source", NetworkConfig(domain)) as node:
        publisher, sent = node.publisher("/a", TEXT), 0
        while fork.poll() is None:
            if publisher.receivers:
                publisher.send(encode_one(TEXT, {"data": f"{sent:06d}" + "x" * 50_000}))
                sent += 1
            time.sleep(0.005)
    assert fork.wait() == 2
    said = printed.read_text()
    assert "Could not record in " in said
    assert "What was recorded before can be read." in said
    numbers = [int(one.data[:6]) for _, one in by_rosbags(bag)["/a"]]
    assert len(numbers) > 50
    whole = set(range(min(numbers), min(numbers) + len(numbers)))
    # Where it gets no processor time, the first may come late, and DDS loses some, or more waits than it keeps: that is
    # said.
    assert len(set(numbers)) == len(numbers)
    assert set(numbers) == whole or "lost" in said


OWN = "own_msgs/msg/Own"


def source_of_own(domain: int) -> None:
    """Publish a type that nobody else knows, from a node that does not state it, until killed."""
    from bhd_lerobot.ros2.messages.definitions import register_types

    register_types({OWN: "int32 number"})
    with Node("source", NetworkConfig(domain)) as node:
        own, words = node.publisher("/own", OWN), node.publisher("/words", TEXT)
        while True:
            own.send(encode_one(OWN, {"number": 5}))
            words.send(message(TEXT, 0))
            time.sleep(0.01)


def test_a_type_that_nobody_defines_is_named_and_left_out_unless_it_is_defined_here(domain, tmp_path):
    mapping, printed = tmp_path / "map.yaml", tmp_path / "printed"
    mapping.write_text(f"types:\n  {OWN}: int32 number\n")
    with Fork(source_of_own, domain):
        for name, options, wanted in (
            ("without", ("--all",), {"/words"}),
            ("with", ("--all", f"--map={mapping}"), {"/own", "/words"}),
            ("alone", ("/own", "--seconds=3"), None),
        ):
            bag = tmp_path / name
            fork = Fork(main, ["record", f"--output={bag}", f"--domain={domain}", *options], output=printed)
            if wanted is not None:
                until(lambda bag=bag, wanted=wanted: {one for one, count in counts(bag).items() if count} >= wanted)
                if name == "without":
                    until(lambda: "/own is left out" in printed.read_text(), "it is named")
                fork.send_signal(signal.SIGINT)
                assert fork.wait() == 0
                assert by_rosbags(bag).keys() == wanted
            else:
                assert fork.wait() == 2
                assert not bag.exists()
                assert "No topic was recorded, and no bag was made. /own: Unknown ROS 2 type" in printed.read_text()
            if name != "with":
                assert f"/own is left out: Unknown ROS 2 type '{OWN}'." in printed.read_text()


@pytest.mark.law
@pytest.mark.parametrize(
    ("topics", "exclude", "recorded_ones"),
    [
        ((), None, {"/tf", "/tf_static", "/robot1/tf"}),
        ((), "/tf", {"/tf_static", "/robot1/tf"}),
        ((), ".*tf", {"/tf_static"}),
        (("/robot1/tf", "/a/_action/status"), None, {"/robot1/tf", "/a/_action/status"}),
        (("/tf", "/tf_static"), "/tf.+", {"/tf"}),
    ],
)
def test_named_topics_or_all_but_those_of_actions_are_recorded_without_the_excluded(topics, exclude, recorded_ones):
    options = RecordOptions(Path("bag"), topics, exclude)
    names = ("/tf", "/tf_static", "/robot1/tf", "/a/_action/status")
    assert {name for name in names if options.wants(name)} == recorded_ones


def test_what_cannot_be_recorded_is_an_error(domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()
    for arguments, said in (
        (["--output=bag"], "Name topics, or give --all"),
        (["/a", "--all", "--output=bag"], "Name topics, or give --all"),
        (["--all", "--output=bag.mcap"], "a bag is a folder, in which the file lies. Leave out .mcap."),
        (["--all", "--output=bag", "--exclude=("], "--exclude is '(', which is no regular expression"),
        (["--all", "--output=bag", "--seconds=0"], "--seconds is 0.0; it must be positive"),
        (["--all", f"--output={tmp_path / 'there'}"], "exists already. Remove it, or choose another --output."),
        (["--all", f"--output={tmp_path / 'new'}", "--seconds=0.3"], "Nobody published one."),
    ):
        assert main(["record", f"--domain={domain}", *arguments]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    with pytest.raises(DatasetExistsError):
        Recorder(None, RecordOptions(tmp_path / "there"), print)  # type: ignore[arg-type]
