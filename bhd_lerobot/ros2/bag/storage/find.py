"""Where bags are: folders with or without metadata, single files, folders of bags; and which files are whose."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from bhd_lerobot.errors import ConfigError, DatasetError, as_text
from bhd_lerobot.ros2.bag.storage.read import FILES, Bag, opened, profiles_in

_UNREADABLE = (
    *(OSError, yaml.YAMLError, RecursionError),  # the file, its YAML, or how deep that is
    *(LookupError, TypeError, ValueError, ArithmeticError, AttributeError),  # YAML, but of another shape
)


def find_bags(path: Path) -> list[Bag]:
    """Return the bag at a path, or the bags in a folder of bags.

    Raises:
        DatasetError: there is none, a file of one is missing, or files and folders of bags are mixed.
    """
    if path.is_file():
        if _suffix(path) not in FILES:
            raise DatasetError(f"{path} is no bag: its name ends in neither .mcap nor .db3, by option with .zstd.")
        return [Bag(path, [path])]
    if not path.is_dir():
        raise DatasetError(f"There is no bag at {path}: it does not exist.")
    bag = _folder(path)
    if bag and (path / "metadata.yaml").is_file():
        return [bag]
    folders = sorted((inner for inner in path.iterdir() if inner.is_dir()), key=_natural)
    inside = [found for inner in folders if (found := _folder(inner))]
    if bag and inside:
        raise DatasetError(
            f"{path} has bag files of its own ({', '.join(file.name for file in bag.files)}) and folders of bags "
            f"({', '.join(found.path.name for found in inside)}), so their grouping is not known. Name the bags one by "
            "one, or put the files into a folder of their own."
        )
    if bag:
        return [bag]
    if not inside:
        raise DatasetError(
            f"There is no bag at {path}: it has no metadata.yaml, no .mcap and no .db3 file, and no folder that has."
        )
    return inside


def check_distinct(bags: Sequence[Bag]) -> None:
    """Check that no file is in two bags: its episodes would be in the dataset twice.

    Raises:
        ConfigError: one is, as when a bag's folder and its file are named, or a folder and a link to it.
    """
    seen: dict[tuple[int, int], Path] = {}
    for bag in bags:
        for file in bag.files:
            stat = file.stat()  # of what a link leads to
            before = seen.setdefault((stat.st_dev, stat.st_ino), bag.path)
            if before is not bag.path:
                raise ConfigError(
                    f"{before} and {bag.path} are the same recording: both have the file {file.resolve()}. Its "
                    "episodes would be in the dataset twice; it must not be named twice."
                )


def _folder(path: Path) -> Bag | None:
    files = sorted((file for file in path.iterdir() if _suffix(file) in FILES and file.is_file()), key=_natural)
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        problem = f"{path.name}: it has no metadata.yaml, as after a recording that was killed"
        return _without_metadata(path, files, problem) if files else None
    try:
        about = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        if not isinstance(about["relative_file_paths"], list):
            raise TypeError("relative_file_paths is not a list of names")
        # rosbag2's first versions wrote the folder in front of the name, and a moved bag has another one
        names = [Path(_text(name)).name for name in about["relative_file_paths"]]
        expected = int(about["message_count"])
        mode, kind = (_text(about.get(f"compression_{what}") or "").lower() for what in ("mode", "format"))
        publishers = publishers_of(about.get("topics_with_message_count"))
    except _UNREADABLE as error:
        reason = as_text(error)
        if not files:
            raise DatasetError(f"{metadata} cannot be read ({reason[:200]}), and there is no bag file.") from error
        return _without_metadata(path, files, f"{path.name}: metadata.yaml cannot be read ({reason[:200]})")
    if mode == "message" and kind not in ("", "zstd"):
        raise DatasetError(
            f"The messages of {path} are compressed with {kind!r}; only zstd can be read. Take the compression away: "
            "ros2 bag convert."
        )
    if not names and files:
        return _without_metadata(path, files, f"{path.name}: metadata.yaml lists no file")
    problems: list[str] = []
    listed = _listed(path, names, files, problems)
    return Bag(path, listed, expected, problems, per_message=mode == "message", publishers=publishers)


def _without_metadata(path: Path, files: list[Path], problem: str) -> Bag:
    """Return the bag of a folder's files."""
    plain = [file for file in files if file.suffix != ".zstd" or file.with_suffix("") not in files]
    problems = [problem]
    if len(plain) < len(files):
        problems.append(f"{path.name}: of files that are there with and without .zstd, the plain ones are read")
    if len({_suffix(file) for file in plain}) > 1:
        there = ", ".join(file.name for file in plain)
        raise DatasetError(
            f"{path} has no usable metadata.yaml, and files of two storages: {there}. They may be the same recording "
            "twice; name the one that is to be imported."
        )
    return Bag(path, _filled(path, plain, problems), problems=problems)


def _listed(path: Path, names: list[str], files: list[Path], problems: list[str]) -> list[Path]:
    """Return the files that the metadata list, in the order in which they were recorded."""
    there = {file.name: file for file in files}
    # A file may have been decompressed, or compressed, by hand.
    also = {name: name.removesuffix(".zstd") if name.endswith(".zstd") else f"{name}.zstd" for name in names}
    found = {name: there.get(name) or there.get(also[name]) for name in names}
    wrong = [name for name in names if _suffix(Path(name)) not in FILES]
    if wrong:
        raise DatasetError(f"{path / wrong[0]} is neither MCAP nor SQLite, and cannot be read.")
    missing = [name for name, file in found.items() if file is None]
    if missing:
        raise DatasetError(
            f"{path} lacks {len(missing)} of the {len(names)} files that metadata.yaml lists: {', '.join(missing)}; "
            f"bag files there: {', '.join(there) or 'none'}. Bring them back, or name the files that are there one by "
            "one: each becomes a bag of its own."
        )
    listed = list(dict.fromkeys(file for file in found.values() if file is not None))
    if len(listed) < len(names):
        problems.append(f"{path.name}: metadata.yaml lists a file twice; it is read once")
    if more := [name for name, file in there.items() if file not in listed and also.get(name) not in names]:
        problems.append(
            f"{path.name}: {', '.join(more)} is not in metadata.yaml, and is not read; name the file itself to import "
            "it, too"
        )
    return _in_order(path, _filled(path, listed, problems), problems)


def _filled(path: Path, files: list[Path], problems: list[str]) -> list[Path]:
    """Return files without those that have not a single byte, as after a power cut; all if none has."""
    filled = [file for file in files if file.stat().st_size]
    if not filled or len(filled) == len(files):
        return files
    empty = ", ".join(file.name for file in files if file not in filled)
    problems.append(f"{path.name}: {empty} is empty, and left out")
    return filled


def _in_order(path: Path, listed: list[Path], problems: list[str]) -> list[Path]:
    """Return files in the order of the recording.

    rosbag2 numbers them as it makes them. Metadata that list them otherwise are believed unless the messages' times
    speak for the numbers.
    """
    numbered = sorted(listed, key=_natural)
    if numbered == listed:
        return listed
    times = []
    for name in numbered:
        try:
            with opened(name) as file:
                times.append(next((received for _, received, _ in file.messages()), None))
        except DatasetError:
            return listed
    known = [time for time in times if time is not None]
    if len(known) < len(times) or known != sorted(known):
        return listed
    problems.append(
        f"{path.name}: metadata.yaml lists its files in another order than that of their times; they are read by time"
    )
    return numbered


def publishers_of(topics: Any) -> dict[str, int]:
    """Return topic -> how many publishers offered it when the recorder subscribed, where that is known.

    Args:
        topics: ``topics_with_message_count`` of a metadata.yaml.
    """
    found: dict[str, int] = {}
    for topic in topics if isinstance(topics, list) else ():
        about = topic.get("topic_metadata") if isinstance(topic, dict) else None
        if isinstance(about, dict) and isinstance(name := about.get("name"), str):
            found[name] = max(found.get(name, 0), len(profiles_in(about.get("offered_qos_profiles"))))
    return {name: count for name, count in found.items() if count}


def _text(value: Any) -> str:
    """Return a text. In YAML, lists of lists by reference are short, and as text have any length."""
    if not isinstance(value, str):
        raise TypeError(f"a {type(value).__name__} is where a text was expected")
    return value


def _suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == ".zstd" else path.suffix


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
