"""What a dataset's columns are said to hold, by `bhd-data info` and the card on the Hub."""

from bhd_lerobot.datasets.format import features as keys


def test_what_the_simulator_tells_is_called_privileged_and_nothing_else_is() -> None:
    names = [f"object_{number}.x" for number in range(8)]
    vector = {"dtype": "float32", "shape": (len(names),), "names": names}
    told = keys.meaning_of(keys.ENVIRONMENT_STATE, vector)
    assert told == "privileged, from the simulator's true state: object_0.x, object_1.x, object_2.x, … object_7.x"
    for key in ("observation.state", "action", *keys.SCALARS):
        assert "privileged" not in keys.meaning_of(key, vector), key
