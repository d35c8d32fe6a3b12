"""The loop of an episode, and replay."""

__all__ = [
    "drivers",
    "episode",
    "images",
    "marks",
    "plots",
    "preview",
    "progress",
    "provenance",
    "recorder",
    "replay",
    "run_folder",
    "signals",
    "tolerance",
    "types",
]
