"""The tick on the wall clock: privileges, shared memory and the links between processes."""

__all__ = [
    "block",
    "bridge",
    "estop",
    "frame_reader",
    "grid",
    "keys",
    "limits",
    "loop",
    "mailbox",
    "planning_link",
    "privileges",
    "requests",
    "shared_memory",
    "timing",
]
