"""Waiting for something that another process, thread or page does."""

import time
from collections.abc import Callable
from typing import Any


def until(condition: Callable[[], Any], what: str = "") -> Any:
    """Wait until a condition holds, and return what it returned.

    There is no deadline: how long anything takes says more about the machine than about the code. What never comes
    true ends in the test's own time-out, to which `what` is added.
    """
    try:
        while not (result := condition()):
            time.sleep(0.002)
    except BaseException as error:
        error.add_note(f"while waiting until {what or 'a condition holds'}")
        raise
    return result
