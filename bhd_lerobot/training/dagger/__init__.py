"""Dataset aggregation: a policy drives, a rule says what it would have done, and the policy learns that, in rounds."""

__all__ = ["config", "train"]
