"""The loop of an episode, configurations and replay."""

__all__ = [
    "configuration",
    "drivers",
    "episode",
    "images",
    "marks",
    "options_help",
    "plots",
    "preview",
    "provenance",
    "replay",
    "run_folder",
    "signals",
    "types",
]
