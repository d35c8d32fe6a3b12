"""Which files are a bag's, and in which order, by metadata of every version."""

import shutil

import pytest
import yaml

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.find import find_bags, publishers_of
from bhd_lerobot.ros2.bag.storage.read import profiles_in
from tests.cases import each_case
from tests.ros2.bag.support import check, drive, write


@pytest.fixture(scope="module")
def messages():
    return drive(seconds=3)


@pytest.fixture(scope="module")
def parts(tmp_path_factory, messages):
    """Three bags, each with a third of a drive; the names of the files are those of one recording that was split."""
    folder, third = tmp_path_factory.mktemp("parts"), len(messages) // 3 + 1
    return [write(folder / f"drive_{index}", messages[index * third : (index + 1) * third]) for index in range(3)]


@pytest.fixture
def split(tmp_path, parts, messages):
    """Return a function that makes the bag, with changed metadata."""

    def make(paths=("drive_0.mcap", "drive_1.mcap", "drive_2.mcap"), **more):
        bag = tmp_path / "bag"
        bag.mkdir()
        for part in parts:
            shutil.copy(part / f"{part.name}.mcap", bag)
        about = {"version": 5, "relative_file_paths": list(paths), "message_count": len(messages), **more}
        (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": about}))
        return bag

    return make


def test_a_recording_that_was_split_is_one_bag(split, parts, messages):
    bag = split(["bag/drive_0.mcap", "drive_1.mcap", "drive_2.mcap"])  # as rosbag2's first versions named files
    check(bag, messages)
    (bag / "metadata.yaml").unlink()
    check(bag, messages, "no metadata.yaml")
    assert [found.path.name for found in find_bags(parts[0].parent)] == ["drive_0", "drive_1", "drive_2"]


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (["drive_2.mcap", "drive_0.mcap", "drive_1.mcap"], "another order than that of their times"),
        (["drive_0.mcap", "bag/drive_0.mcap", "drive_1.mcap", "drive_2.mcap"], "lists a file twice"),
    ],
)
def test_files_are_read_once_and_by_time_however_they_are_listed(split, messages, names, problem):
    check(split(names), messages, problem)


def test_a_missing_file_is_named_with_what_can_be_done(split):
    bag = split()
    (bag / "drive_1.mcap").unlink()
    with pytest.raises(DatasetError, match=r"lacks 1 of the 3 files .*: drive_1\.mcap; .* drive_0\.mcap, .*one by one"):
        find_bags(bag)
    assert [one.path.name for file in ("drive_0.mcap", "drive_2.mcap") for one in find_bags(bag / file)]


def test_a_file_that_is_not_listed_is_reported(split, messages):
    bag = split(["drive_0.mcap", "drive_1.mcap"], message_count=0)
    (found,) = find_bags(bag)
    assert [file.name for file in found.files] == ["drive_0.mcap", "drive_1.mcap"]
    assert "drive_2.mcap is not in metadata.yaml, and is not read" in found.problems[0]


def test_an_empty_file_of_a_recording_is_left_out_and_reported(split, messages):
    bag = split(["drive_0.mcap", "drive_1.mcap", "drive_2.mcap", "drive_3.mcap"])
    (bag / "drive_3.mcap").touch()
    check(bag, messages, "drive_3.mcap is empty")
    (bag / "metadata.yaml").unlink()
    check(bag, messages, "no metadata.yaml", "drive_3.mcap is empty")


def test_metadata_that_list_nothing_or_no_list_are_reported(split, messages):
    bag = split([])
    check(bag, messages, "metadata.yaml lists no file")
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("relative_file_paths: []", "relative_file_paths: drive_0.mcap"))
    check(bag, messages, "not a list of names")


def test_files_that_were_compressed_or_decompressed_by_hand(split, messages):
    from backports import zstd

    bag = split(["drive_0.mcap.zstd", "drive_1.mcap", "drive_2.mcap"])
    (bag / "drive_1.mcap.zstd").write_bytes(zstd.compress((bag / "drive_1.mcap").read_bytes()))
    (bag / "drive_1.mcap").unlink()
    check(bag, messages)
    (bag / "metadata.yaml").unlink()
    shutil.copy(bag / "drive_0.mcap", bag / "drive_3.mcap")
    (bag / "drive_3.mcap").unlink()
    (bag / "drive_0.mcap.zstd").write_bytes(zstd.compress((bag / "drive_0.mcap").read_bytes()))
    check(bag, messages, "no metadata.yaml", "with and without .zstd")


def test_two_storages_in_a_folder_without_metadata_are_refused(tmp_path, messages, parts):
    bag = write(tmp_path / "bag", messages, "sqlite3")
    shutil.copy(parts[0] / "drive_0.mcap", bag)
    assert "drive_0.mcap is not in metadata.yaml" in find_bags(bag)[0].problems[0]
    (bag / "metadata.yaml").unlink()
    with pytest.raises(DatasetError, match="files of two storages"):
        find_bags(bag)


PROFILE = {
    "history": 1, "depth": 10, "reliability": 1, "durability": 2, "deadline": {"sec": 9223372036, "nsec": 854775807},
    "lifespan": {"sec": 9223372036, "nsec": 854775807}, "liveliness": 1,
    "liveliness_lease_duration": {"sec": 9223372036, "nsec": 854775807}, "avoid_ros_namespace_conventions": False,
}  # fmt: skip
NAMED = {**PROFILE, "history": "keep_last", "reliability": "reliable", "durability": "volatile"}


@pytest.mark.law
@each_case(
    ("profiles", "count"),
    [
        (yaml.safe_dump([PROFILE]), 1),  # versions 4 to 8: a text
        (yaml.safe_dump([PROFILE, PROFILE]), 2),
        ([NAMED, NAMED, NAMED], 3),  # version 9: a list
        (yaml.safe_dump([NAMED]), 1),  # its MCAP channels
        ("", 0),
        ([], 0),
        (None, 0),
        ("- history: [", 0),
        ({"history": 1}, 0),
        (5, 0),
    ],
)
def test_profiles_of_every_version_give_the_number_of_publishers(profiles, count):
    assert len(profiles_in(profiles)) == count
    topics = [{"topic_metadata": {"name": "/cmd_vel", "offered_qos_profiles": profiles}, "message_count": 3}]
    assert publishers_of(topics) == ({"/cmd_vel": count} if count else {})
    for malformed in (None, "x", 3, [None, {}, {"topic_metadata": None}, {"topic_metadata": {}}]):
        assert publishers_of(malformed) == {}


def test_every_version_of_metadata_is_read(split, messages):
    bag = split()
    for version, profiles in (
        (4, yaml.safe_dump([PROFILE])),
        (5, ""),
        (8, yaml.safe_dump([PROFILE] * 2)),
        (9, [NAMED] * 2),
    ):
        metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
        about = metadata["rosbag2_bagfile_information"]
        about["version"] = version
        topic = {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "offered_qos_profiles": profiles}
        about["topics_with_message_count"] = [{"topic_metadata": topic, "message_count": 30}]
        (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
        check(bag, messages)
        assert find_bags(bag)[0].topics["/cmd_vel"].publishers == len(profiles_in(profiles))


def test_files_beside_folders_of_bags_are_refused_and_not_forgotten(tmp_path, parts, split, messages):
    shutil.copytree(parts[0], tmp_path / "drives" / "drive_0")
    shutil.copy(parts[1] / "drive_1.mcap", tmp_path / "drives" / "more.mcap")
    with pytest.raises(DatasetError, match=r"more\.mcap\) and folders of bags \(drive_0\)"):
        find_bags(tmp_path / "drives")
    # What lies in a bag that says what belongs to it is not asked about.
    bag = split()
    shutil.copytree(parts[0], bag / "drive_0")
    check(bag, messages)
