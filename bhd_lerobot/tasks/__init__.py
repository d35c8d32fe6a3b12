"""What is to be achieved, judged on the truth of the simulator."""

__all__ = ["avoid", "geodesic", "navigate", "operator", "pick", "reach", "report", "task", "variation"]
