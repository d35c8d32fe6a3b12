"""`bhd-data`, a module for each command."""

__all__ = [
    "check",
    "command",
    "edit",
    "episode_list",
    "export",
    "import_bag",
    "info",
    "main",
    "mark",
    "pull",
    "push",
    "repair",
    "view",
]
