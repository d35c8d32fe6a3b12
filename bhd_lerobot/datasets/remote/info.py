"""What a remote `meta/info.json` says, as far as a transfer believes it. Anybody may have written it."""

from typing import Any

from bhd_lerobot.datasets.format.info import InfoError, checked_info, parse_object
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError


def parse_info(content: bytes | None, place: str) -> dict[str, Any]:
    """Return the content of a `meta/info.json`, checked and with defaults; see `info.checked_info`.

    Args:
        content: the file; None if it is not there any more.
        place: whose it is, for messages.

    Raises:
        DatasetError: it is none, or that of another format; says what is wrong.
    """
    if content is None:
        raise DatasetError(f"{place} is no LeRobot dataset any more: its {layout.INFO} is gone.")
    try:
        return checked_info(parse_object(content), place)
    except InfoError as error:
        raise DatasetError(f"{place} is no LeRobot dataset: in its {layout.INFO}, {error}.") from error
