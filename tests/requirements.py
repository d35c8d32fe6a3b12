"""What a machine may lack, so that some behaviour is not tested there."""

import os
from pathlib import Path
from typing import NoReturn

import pytest

REQUIRE = "BHD_REQUIRE_ALL"
REASONS = "BHD_NOT_TESTED"


def not_tested(reason: str) -> NoReturn:
    """Skip a test because of what this machine lacks, which `make test` repeats at its end; fail it with REQUIRE=1."""
    if os.environ.get(REQUIRE) == "1":
        pytest.fail(reason)
    if REASONS in os.environ:
        with Path(os.environ[REASONS]).open("a") as file:
            file.write(reason.replace("\n", " ") + "\n")
    pytest.skip(f"not tested: {reason}")
