"""Transfer to the Hub and to object stores."""

__all__ = ["hub", "hub_errors", "listing", "local", "pull", "push", "staging", "store", "subset", "url"]
