"""`bhd-doctor`: what this machine lacks, and the remedy."""

__all__ = ["checks", "doctor", "following", "identify", "latency_test", "robot", "trials"]
