"""Single messages that cannot be read: they are as if they had been lost, and are counted and told."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.messages.cdr_read import readable
from bhd_lerobot.rosbag.messages.images import COMPRESSED, IMAGE
from bhd_lerobot.rosbag.storage.read import Messages, Topic

MOST = 0.1
"""Share of a topic's messages that may be unreadable. Beyond it is no accident, and what is left is no record."""


_STAMP_END = 12  # bytes of a message before its frame: what it is serialised as, and the stamp


def sound_messages(path: Path, topic: Topic, messages: Messages, problems: list[str]) -> Messages:
    """Return the messages of a topic that can be read.

    Args:
        path: the bag.
        topic: the topic.
        messages: its messages, or their beginnings if it is of pictures.
        problems: what is left out is added to it.

    Raises:
        DatasetError: too many cannot be read.
    """
    reason: DatasetError | str | None
    if topic.msgtype in (IMAGE, COMPRESSED):
        mask, reason = _whole_pictures(topic.msgtype, messages)
    else:
        mask, reason = readable(topic.msgtype, messages.data)
    lost, total = int((~mask).sum()), len(mask)
    if not lost:
        return messages
    what = f"{lost} of the {total} messages of {topic.name} cannot be read"
    if lost > MOST * total:
        raise DatasetError(
            f"{path}: {what}, which is more than {MOST:.0%}: too many to go on without them. The first: {reason}"
        )
    problems.append(f"{path.name}: {what}, and are left out as if they had been lost; the first: {reason}")
    return messages.part(mask)


def _whole_pictures(msgtype: str, messages: Messages) -> tuple[NDArray[np.bool_], str]:
    """Return which pictures are there as a whole, shape (n,), and what is wrong with the first of the others."""
    reasons = [_fault(msgtype, head, size) for head, size in zip(messages.data, messages.sizes.tolist(), strict=True)]
    mask = np.array([not reason for reason in reasons], np.bool_)
    return mask, next((reason for reason in reasons if reason), "")


def _fault(msgtype: str, head: bytes, size: int) -> str:
    """Return why a picture's message, of which only the beginning is there, is not whole; empty if it is."""
    try:
        end = _end_of_picture(msgtype, head)
    except struct.error:  # the frame's name is longer than what is there, or there is no more
        return f"it ends after {size} bytes, before its picture" if size == len(head) else ""
    return f"it ends after {size} bytes, and its picture at byte {end}" if end > size else ""


def _end_of_picture(msgtype: str, head: bytes) -> int:
    """Return where a message ends that has a header, what describes its picture, and the picture's bytes.

    Raises:
        struct.error: the beginning of the message is too short to say so.
    """
    order = "<" if head[1:2] == b"\1" else ">"

    def after(at: int) -> int:  # a sequence of bytes, or a text
        at += -at % 4
        return at + 4 + int(struct.unpack_from(f"{order}I", head, at)[0])

    at = after(_STAMP_END)  # the frame
    if msgtype == IMAGE:
        at = after(at + -at % 4 + 8)  # height, width, encoding
        at += 1  # byte order
        at += -at % 4 + 4  # bytes in a row
    else:
        at = after(at)  # format
    return after(at)
