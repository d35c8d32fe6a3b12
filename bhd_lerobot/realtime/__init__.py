"""The tick on the wall clock: privileges, shared memory and the links between processes."""

__all__ = [
    "block",
    "bridge",
    "frame_reader",
    "grid",
    "loop",
    "mailbox",
    "planning_link",
    "privileges",
    "requests",
    "sections",
    "shared_memory",
]
