"""Transfer to the Hub and to object stores."""

__all__ = ["errors", "hub", "listing", "local", "place", "pull", "push", "store"]
