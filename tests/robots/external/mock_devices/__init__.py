"""A mock arm and a mock leader as a plug-in of LeRobot: LeRobot finds the classes in the package of their options."""

from tests.robots.external.mock_devices.devices import MockArm, MockArmConfig, MockLeader, MockLeaderConfig

__all__ = ["MockArm", "MockArmConfig", "MockLeader", "MockLeaderConfig"]
