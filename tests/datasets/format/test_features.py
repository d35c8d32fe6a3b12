"""What a dataset's columns are said to hold, by `bhd-data info` and the card on the Hub."""

from typing import Any

from bhd_lerobot.datasets.format import features as keys
from tests.cases import each_case


def test_what_the_simulator_tells_is_called_privileged_and_nothing_else_is() -> None:
    names = [f"object_{number}.x" for number in range(8)]
    vector = {"dtype": "float32", "shape": (len(names),), "names": names}
    told = keys.meaning_of(keys.ENVIRONMENT_STATE, vector)
    assert told == "privileged, from the simulator's true state: object_0.x, object_1.x, object_2.x, … object_7.x"
    for key in ("observation.state", "action", *keys.SCALARS):
        assert "privileged" not in keys.meaning_of(key, vector), key


@each_case(
    ("names", "shape", "read"),
    [
        (["a", "b", "c"], [3], ("a", "b", "c")),
        ({"motors": ["a", "b", "c"]}, [3], ("a", "b", "c")),
        ({"axes": ["a", "b"], "gripper": "c"}, [3], ("a", "b", "c")),
        ({"b": 1, "a": 0, "c": 2}, [3], ("a", "b", "c")),
        (["actions"], [7], ()),
        ({"motors": ["actions"]}, [7], ()),
        (None, [3], ()),
        ([], [3], ()),
        (["a", "b"], [3], ()),
        ([0, 1], [2], ("0", "1")),
    ],
)
def test_names_are_read_in_every_form_that_lerobot_has(names: Any, shape: list[int], read: tuple[str, ...]) -> None:
    feature = {"dtype": "float32", "shape": shape, "names": names}
    assert keys.names_of(feature) == read
    assert keys.numbered_names_of(feature) == (read or tuple(str(k) for k in range(shape[0])))
    assert isinstance(keys.meaning_of("action", feature), str)
