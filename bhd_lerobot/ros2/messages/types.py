"""The ROS 2 message types of a bag: the standard ones, as `rosbags` knows them, and the few of ours.

Bags embed the definitions, so that a reader without this package decodes our messages as well.
"""

import difflib
from collections.abc import Iterable
from functools import cache
from importlib import resources
from typing import Any

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, install_extra

BASE, NAME, ARRAY = 1, 2, 3
"""Kinds of fields, as `rosbags` describes them; what remains is a sequence."""
BYTES = {"octet": "uint8", "char": "uint8", "byte": "uint8"}
"""Types of whole numbers that are called otherwise than by numpy."""

FORMAT = 2
"""Version of the messages below."""

INTERFACES = "bhd_interfaces"
"""Package of the messages in the folder `msg`: what a brain, a cerebellum and a person send one another."""

EPISODE, EPISODE_TOPIC = "bhd_msgs/msg/Episode", "/bhd/episode"
STATE = "bhd_msgs/msg/CerebellumState"
OUTCOME = "bhd_msgs/msg/Outcome"
STATE_TOPIC, OUTCOME_TOPIC = "/bhd/cerebellum", "/bhd/outcome"
NUMBERS = "bhd_msgs/msg/Numbers"
INTEGERS = "bhd_msgs/msg/Integers"
TEXT = "bhd_msgs/msg/Text"

STATE_COLUMNS = (
    keys.TIME, keys.AGE, keys.COMMAND_AGE, keys.LATENESS, keys.OVERRUNS, keys.SKIPPED, keys.INFERENCE_TIME, keys.LATE,
    keys.LIMITS, keys.WATCHDOG, keys.MODE,
)  # fmt: skip
OUTCOME_COLUMNS = (keys.REWARD, keys.SUCCESS, keys.DONE, keys.EVENT)

DEFINITIONS = {
    EPISODE: """
# An episode of a LeRobotDataset. Sent once, before its frames; transient local.
int64 FORMAT=2
builtin_interfaces/Time stamp   # when it started, by the bag's clock
int64 format                    # version of these messages
string repo_id                  # name of the dataset
string robot_type
int64 fps
int64 episode_index
int64 frames
string task                     # the instruction
string features                 # LeRobot's feature dictionaries, JSON
string metadata                 # what is recorded of the episode, without the prefix bhd/, JSON
string metadata_types           # type of each of these values, JSON
string recording                # identity of the recording, JSON
string topics                   # which topic carries which numbers of which feature, JSON
""",
    STATE: """
# What the cerebellum did in a frame. The header's stamp is the frame's end.
int64 UNCONFIGURED=0
int64 INACTIVE=1
int64 HOLD=2
int64 TRACKING=3
int64 STOPPING=4
int64 SAFE_OFF=5
int64 ESTOP=6
int64 FAULT=7
int64 LIMIT_NOT_FINITE=1
int64 LIMIT_VELOCITY=2
int64 LIMIT_ACCELERATION=4
int64 LIMIT_EFFORT=8
int64 LIMIT_POSITION=16
int64 LIMIT_POSTURE=32
int64 LIMIT_CLEARANCE=64
int64 WATCHDOG_COMMAND_TOO_OLD=1
int64 WATCHDOG_ARM_BLOCKED=2
int64 WATCHDOG_BRAIN_SILENT=4
int64 WATCHDOG_RECORDER_SILENT=8
int64 WATCHDOG_PLANT_SILENT=16
int64 WATCHDOG_MISSED_TICKS=32
int64 WATCHDOG_GUARD=64
int64 WATCHDOG_FORCE=128
int64 WATCHDOG_SPEED=256
std_msgs/Header header
builtin_interfaces/Time observed  # stamp of the observation that the frame began with
int64 episode_index
int64 frame_index
float64 time                    # when the observation was measured, since the episode's start [s]
float32 age                     # of the oldest reading in it [s]
float32 command_age             # of the command in force at the end of the frame [s]
float32 lateness                # largest lateness of a control tick in the frame [s]
int64 overruns                  # control ticks of the frame that ended after the next was due
int64 skipped                   # control ticks of the frame that were left out
float32 inference_time          # that the brain took for the decision that drove the frame [s]
bool late                       # the frame violates the timing tolerance
int64 limits                    # what the limits changed, a sum of LIMIT_*
int64 watchdog                  # what the watchdogs noticed, a sum of WATCHDOG_*
int64 mode                      # at the end of the frame
""",
    OUTCOME: """
# What a frame brought. The header's stamp is the frame's end.
int64 NOTHING=0
int64 SUCCESS=1
int64 COLLISION=2
int64 STUCK=3
int64 TIMEOUT=4
int64 INTERVENTION=5
int64 ESTOP=6
int64 WRONG_OBJECT=7
int64 DROPPED=8
int64 UNREACHABLE=9
int64 FAULT=10
int64 FAILURE=11                # without a cause
std_msgs/Header header
int64 episode_index
int64 frame_index
float32 reward
bool success                    # the episode ended in success with this frame
bool done                       # the episode ended with this frame
int64 event
string subtask                  # what the brain was doing, in words; empty if it has no plan
""",
    NUMBERS: """
# Named numbers of a frame that no standard message is made for.
std_msgs/Header header
int64 episode_index
int64 frame_index
string[] names
float64[] values
""",
    INTEGERS: """
# Named whole numbers, or truths, of a frame.
std_msgs/Header header
int64 episode_index
int64 frame_index
string[] names
int64[] values
""",
    TEXT: """
# A text of a frame.
std_msgs/Header header
int64 episode_index
int64 frame_index
string text
""",
}
"""Name -> definition, in ROS's message language."""


def require_rosbags() -> None:
    """Raise unless the extra that bags need is installed."""
    try:
        import mcap.reader  # noqa: F401
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"ROS 2 bags need the packages rosbags and mcap, which cannot be imported ({error}). "
            f"{install_extra('ros2')}"
        ) from error


@cache
def type_store() -> Any:
    """Return `rosbags`' store of the standard types and ours.

    The standard types that are used here are the same in all distributions since Foxy; later ones have more.
    """
    require_rosbags()
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, later = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_KILTED).fielddefs
    # rosbags computes another hash than ROS of what service_msgs has.
    new = [name for name in later if name not in store.fielddefs and not name.startswith("service_msgs/")]
    store.register({name: later[name] for name in new})
    interfaces = resources.files(__package__).joinpath("msg")
    shipped = {
        f"{INTERFACES}/msg/{file.name.removesuffix('.msg')}": file.read_text("utf-8") for file in interfaces.iterdir()
    }
    for name, text in {**DEFINITIONS, **shipped}.items():
        store.register(get_types_from_msg(text, name))
    return store


def unknown_type(name: str, known: Iterable[str]) -> str:
    """Return the message for a type that is not among those that are known, which are too many to list."""
    near = difflib.get_close_matches(name, list(known), n=4, cutoff=0.5)
    hint = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
    return f"Unknown ROS 2 type {name!r}.{hint} The section `types` of a mapping defines further ones, by their text."


def type_text(description: Any) -> str:
    """Return the type of a field, by `rosbags`' description of it, in ROS's message language, without bounds."""
    kind, inner = int(description[0]), description[1]
    if kind in (BASE, NAME):
        return str(inner[0] if kind == BASE else inner)
    element, count = inner
    return f"{type_text(element)}[{count if kind == ARRAY else ''}]"
