"""`bhd_pixels`, a small policy from a camera's image, an instruction and the robot's state to actions."""

__all__ = ["configuration_pixels", "modeling_pixels", "processor_pixels"]
