"""What every command line shares: reading it, its help, its errors, plug-ins, and what can be chosen by name."""

__all__ = [
    "command",
    "declared",
    "dotted",
    "help",
    "parse",
    "plugins",
    "registry",
    "shipped",
    "terminal",
    "unique_keys",
    "units",
]
