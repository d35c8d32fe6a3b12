"""What a brain said it saw, beside what was true: errors, mistakes and calibration, and their summary."""

import math
from typing import Any

import pytest

from bhd_lerobot.bodies.tabletop import TableObject, TableScene
from bhd_lerobot.evaluation.perception import summarise_perception
from bhd_lerobot.evaluation.text import perception_sentence
from bhd_lerobot.policies.perception.assessment import NUMBERS, assess

RED_CUP, BLUE_BOX = (0.4, 0.1), (0.5, -0.2)  # where they stand


def table() -> TableScene:
    """Return a table with a blue box and a red cup, which is meant."""
    box = TableObject("box", "blue", 0.035, 0.035, 0.1, *BLUE_BOX)
    cup = TableObject("cup", "red", 0.035, 0.035, 0.1, *RED_CUP)
    return TableScene("pick", (box, cup), (0.0,) * 7, target_object=1)


def seen(name: str, at: tuple[float, float], off_m: float = 0.0) -> dict[str, Any]:
    return {"name": name, "position": [at[0] + off_m, at[1], 0.05], "error_50_m": 0.002, "error_90_m": 0.0055}


def look(chosen: int | None, *objects: dict[str, Any]) -> dict[str, float]:
    return assess({"seen": list(objects), "chosen": chosen}, table())


def test_a_brain_that_does_not_see_for_itself_is_not_assessed() -> None:
    assert assess({"steps": []}, table()) == {}
    assert summarise_perception([{}, {}]) is None


@pytest.mark.parametrize(("off_m", "in_50", "in_90"), [(0.001, 1, 1), (0.003, 0, 1), (0.02, 0, 0)])
def test_the_error_of_what_was_chosen_is_compared_with_what_was_stated(off_m: float, in_50: int, in_90: int) -> None:
    found = look(1, seen("blue box", BLUE_BOX), seen("red cup", RED_CUP, off_m))
    assert found.keys() == set(NUMBERS)
    assert found["error_m"] == pytest.approx(off_m)
    assert (found["in_50"], found["in_90"], found["wrong"], found["chosen"]) == (in_50, in_90, 0, 1)
    assert (found["objects"], found["seen"], found["named"], found["phantoms"]) == (2, 2, 2, 0)


def test_another_object_and_one_that_is_not_there_are_mistakes() -> None:
    other = look(0, seen("red cup", BLUE_BOX))  # it takes the box for the cup
    assert (other["wrong"], other["seen"], other["named"], other["phantoms"]) == (1, 1, 0, 0)
    nothing = look(0, seen("red cup", (0.4, 0.2)), seen("red cup", RED_CUP))
    assert (nothing["wrong"], nothing["seen"], nothing["phantoms"]) == (1, 1, 1)
    assert nothing["error_m"] == pytest.approx(0.1)


def test_of_two_that_are_said_to_be_one_object_the_surest_counts() -> None:
    found = look(None, seen("red cup", RED_CUP), seen("red box", RED_CUP, 0.01))
    assert (found["seen"], found["named"], found["chosen"]) == (1, 1, 0)
    assert math.isnan(found["wrong"])
    assert math.isnan(found["error_m"])


def test_the_summary_counts_episodes_objects_and_quantiles() -> None:
    right = [look(0, seen("red cup", RED_CUP, 0.001 * mm)) for mm in range(1, 9)]
    wrong, none = look(0, seen("red cup", BLUE_BOX)), look(None)
    found = summarise_perception([*right, wrong, none, {}])
    assert found is not None
    assert found.episodes == 10
    assert found.chosen.value == pytest.approx(9 / 10)
    assert found.wrong.value == pytest.approx(1 / 9)
    assert found.in_90.value == pytest.approx(6 / 9)  # 1 to 5 mm, and the wrong one, which is where it was said to be
    assert found.error_m[0] == pytest.approx(0.004)
    assert found.seen.value == pytest.approx(9 / 20)
    assert found.named.value == pytest.approx(8 / 9)
    assert "the wrong one in 11.1 %" in perception_sentence(found)
