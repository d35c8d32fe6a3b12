"""A brain as LeRobot's teleoperator."""

__all__ = ["bhd_brain", "config_bhd_brain"]
