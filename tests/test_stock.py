"""What is used of LeRobot's internals, wherever this version of LeRobot has it."""

import pytest

from bhd_lerobot import stock
from tests.cases import each_case


@each_case("name", sorted(stock._WHERE))
def test_every_name_is_there(name: str) -> None:
    assert getattr(stock, name) is not None


def test_other_names_are_not() -> None:
    with pytest.raises(AttributeError, match="no attribute 'make_robots'"):
        _ = stock.make_robots
