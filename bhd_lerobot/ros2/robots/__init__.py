"""Robots of a ROS 2 network: below our cerebellum as plants, or as a LeRobot robot by a mapping."""

__all__ = ["arm_plant", "base_plant", "config_robot", "plant", "robot"]
