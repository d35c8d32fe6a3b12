"""What the parts of a robot observe, and how their actions become setpoints; of simulated ones also their world."""

__all__ = ["arm", "drive", "latency", "names", "part", "simulated_arm", "simulated_drive"]
