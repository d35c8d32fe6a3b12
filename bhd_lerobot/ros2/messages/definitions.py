"""Services, actions and further messages: those that clients here use, and those that a user adds."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import ConfigError, as_text
from bhd_lerobot.ros2.messages.types import type_store, unknown_type

DEFINITIONS = {
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/SetBool": """
bool data
---
bool success
string message
""",
    "std_srvs/srv/Trigger": """
---
bool success
string message
""",
    "action_msgs/srv/CancelGoal": """
action_msgs/GoalInfo goal_info
---
int8 ERROR_NONE=0
int8 ERROR_REJECTED=1
int8 ERROR_UNKNOWN_GOAL_ID=2
int8 ERROR_GOAL_TERMINATED=3
int8 return_code
action_msgs/GoalInfo[] goals_canceling
""",
    "type_description_interfaces/srv/GetTypeDescription": """
string type_name
string type_hash
bool include_type_sources
---
bool successful
string failure_reason
type_description_interfaces/TypeDescription type_description
type_description_interfaces/TypeSource[] type_sources
type_description_interfaces/KeyValue[] extra_information
""",
    "ur_dashboard_msgs/msg/SafetyMode": "uint8 mode",
    "control_msgs/msg/JointTolerance": """
string name
float64 position
float64 velocity
float64 acceleration
""",
    "control_msgs/msg/JointComponentTolerance": """
uint16 X_AXIS=1
uint16 Y_AXIS=2
uint16 Z_AXIS=3
uint16 TRANSLATION=4
uint16 ROTATION=5
string joint_name
uint16 component
float64 position
float64 velocity
float64 acceleration
""",
    "control_msgs/msg/JointTrajectoryControllerState": """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
trajectory_msgs/JointTrajectoryPoint error
trajectory_msgs/JointTrajectoryPoint output
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_reference
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_feedback
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_output
""",
    "control_msgs/action/FollowJointTrajectory": """
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 SUCCESSFUL=0
int32 INVALID_GOAL=-1
int32 INVALID_JOINTS=-2
int32 OLD_HEADER_TIMESTAMP=-3
int32 PATH_TOLERANCE_VIOLATED=-4
int32 GOAL_TOLERANCE_VIOLATED=-5
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
    "nav2_msgs/action/NavigateToPose": """
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 NONE=0
uint16 UNKNOWN=9000
uint16 FAILED_TO_LOAD_BEHAVIOR_TREE=9001
uint16 TF_ERROR=9002
uint16 TIMEOUT=9003
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
""",
}
"""Name -> definition in ROS's own language, as in Jazzy and Kilted."""

HUMBLE = {
    "control_msgs/msg/JointTrajectoryControllerState": """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
trajectory_msgs/JointTrajectoryPoint error
trajectory_msgs/JointTrajectoryPoint output
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_reference
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_feedback
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_output
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
""",
    "nav2_msgs/action/NavigateToPose": """
geometry_msgs/PoseStamped pose
string behavior_tree
---
std_msgs/Empty result
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
""",
}
"""What Humble defines in another way."""

_PARTS = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
# What the client and the server of an action exchange.
_ACTION = {
    "SendGoal_Request": "unique_identifier_msgs/UUID goal_id\n{0}_Goal goal",
    "SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
    "GetResult_Request": "unique_identifier_msgs/UUID goal_id",
    "GetResult_Response": "int8 status\n{0}_Result result",
    "FeedbackMessage": "unique_identifier_msgs/UUID goal_id\n{0}_Feedback feedback",
}
_NO_FIELDS = "uint8 structure_needs_at_least_one_member"  # which ROS sends for a message without fields


def register_types(types: Mapping[str, str]) -> None:
    """Make further types known: messages, services and actions.

    Args:
        types: definitions in ROS's own language, those of `.msg`, `.srv` and `.action` files, by name, such as
            ``std_srvs/srv/SetBool``.

    Raises:
        ConfigError: a definition cannot be read, or is another one than that known already.
    """
    store = type_store()
    for name, text in types.items():
        try:
            store.register(_parsed(name, text))
        except Exception as error:  # whatever rosbags' parser raises
            raise ConfigError(f"The definition of {name} cannot be read: {as_text(error)}.") from error


def register_message(name: str, text: str) -> None:
    """Make a message known as a bag defines it, together with those that it names."""
    from rosbags.typesys import get_types_from_msg

    store = type_store()
    try:
        (_, own), *others = get_types_from_msg(text, name).items()
        if any(one.count("/") != 2 for one, _ in others):
            raise ValueError("it names parts of services or actions")
        store.register({name: own} | {one: fields for one, fields in others if one not in store.fielddefs})
        store.hash_rihs01(name)  # whatever it names is known, too
    except Exception as error:  # whatever rosbags' parser raises
        raise ConfigError(f"The definition of {name} cannot be read: {as_text(error)}.") from error


def find_type(name: str, distro: str = "jazzy") -> None:
    """Make sure that the definition of a type is known.

    Args:
        distro: the definition is that of this distribution, unless another was registered before in this process.
    """
    if _is_known(name):
        return
    definitions = {**DEFINITIONS, **(HUMBLE if distro == "humble" else {})}
    register_types({one: text for one, text in definitions.items() if not _is_known(one)})
    if not _is_known(name):
        register_types(_installed(name))
    if not _is_known(name):
        kind = name.split("/")[1] if name.count("/") == 2 else ""
        raise ConfigError(unknown_type(name, DEFINITIONS if kind in _PARTS else type_store().fielddefs))


def register_unknown(types: Mapping[str, str]) -> None:
    """Make types known that are not yet, as they come together with one of them, which names the others."""
    register_types({name: text for name, text in types.items() if not _is_known(name)})


def _installed(name: str) -> dict[str, str]:
    """Return the definitions of a message and of those that it names, as far as a ROS installation has them."""
    folders = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    found: dict[str, str] = {}
    wanted = [name]
    while wanted:
        one = wanted.pop()
        package, _, rest = one.partition("/")
        files = (folder / "share" / package / f"{rest}.msg" for folder in folders)
        if one in found or _is_known(one) or (file := next(filter(Path.is_file, files), None)) is None:
            continue
        found[one] = file.read_text(encoding="utf-8", errors="replace")
        wanted += _named_in(found[one], package)
    return found


def _named_in(text: str, package: str) -> list[str]:
    """Return the types that the fields of a message may name, which is of a package."""
    found = []
    for line in text.splitlines():
        kind = re.match(r"\s*([A-Za-z][\w/]*)", line)
        if kind is not None:
            named, _, short = kind[1].rpartition("/")
            found.append(f"{named.split('/')[0] or package}/msg/{short}")
    return found


def _is_known(name: str) -> bool:
    store = type_store()
    return any(f"{name}{suffix}" in store.fielddefs for suffix in ("", "_Request", "_Goal"))


def _parsed(name: str, text: str) -> dict[str, Any]:
    from rosbags.typesys import get_types_from_msg

    package, kind, short = name.split("/")
    if kind not in _PARTS:
        return dict(get_types_from_msg(text, name))
    parts = re.split(r"^---\s*$", text, flags=re.MULTILINE)
    if len(parts) != len(_PARTS[kind]):
        raise ValueError(f"it has {len(parts)} parts, separated by ---, instead of {len(_PARTS[kind])}")
    texts = dict(zip(_PARTS[kind], parts, strict=True))
    if kind == "action":
        texts |= {suffix: one.format(name) for suffix, one in _ACTION.items()}
    found = {}
    for suffix, part in texts.items():
        # A message of the same package may be named without it; rosbags looks for it where the text's own name is.
        ((constants, fields),) = get_types_from_msg(part, f"{package}/msg/{short}_{suffix}").values()
        if not fields:
            ((_, fields),) = get_types_from_msg(_NO_FIELDS, "empty").values()
        found[f"{name}_{suffix}"] = constants, fields
    return found
