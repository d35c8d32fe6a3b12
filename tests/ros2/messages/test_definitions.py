"""Definitions of types that are found where a ROS installation has them."""

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.types import type_store


def test_types_are_found_in_a_ros_installation_with_those_that_they_name(tmp_path, monkeypatch):
    files = {
        "installed_msgs/msg/Outer.msg": "int32 LEAST=1  # a constant\nstd_msgs/Header header\nInner[] inner\n"
        'other_installed_msgs/Third third\nstring<=5 name "x"\n',
        "installed_msgs/msg/Inner.msg": "float64[3] values\n",
        "other_installed_msgs/msg/Third.msg": "# a comment\nbool yes\n",
    }
    for name, text in files.items():
        path = tmp_path / "second" / "share" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    with pytest.raises(ConfigError, match="Unknown ROS 2 type 'installed_msgs/msg/Outer'"):
        find_type("installed_msgs/msg/Outer")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'first'}:{tmp_path / 'second'}")
    find_type("installed_msgs/msg/Outer")
    assert {"installed_msgs/msg/Inner", "other_installed_msgs/msg/Third"} <= type_store().fielddefs.keys()
    with pytest.raises(ConfigError, match="Unknown ROS 2 type 'installed_msgs/msg/Absent'"):
        find_type("installed_msgs/msg/Absent")
