"""Where nodes are looked for, and what stands in the shell's environment."""

from xml.etree import ElementTree

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.ros2.live.network import NetworkConfig, Ros2Config


@pytest.mark.parametrize(("text", "number"), [(None, 0), ("", 0), ("42", 42), ("232", 232)])
def test_the_domain_is_that_of_the_shell_unless_it_is_given(monkeypatch, text, number):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    if text is not None:
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    assert NetworkConfig().domain_number == number
    assert NetworkConfig(7).domain_number == 7


@pytest.mark.parametrize("text", ["-1", "233", "one", "1.5"])
def test_a_shells_domain_that_is_none_is_named_when_it_is_used(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    network = NetworkConfig()
    with pytest.raises(ConfigError, match=f"ROS_DOMAIN_ID is '{text}'; it is a number from 0 to 232"):
        _ = network.domain_number


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"interface": "eth0 <"}, "neither a network interface nor an address"),
        ({"peers": ["a b"]}, "neither a network interface nor an address"),
        ({"latency_s": -0.1}, "latency_s"),
        ({"latency_s": 3.0}, "latency_s"),
        ({"scan_yaw": float("nan")}, "scan_yaw"),
        ({"silence_s": 0.0}, "silence_s"),
    ],
)
def test_what_cannot_be_is_refused(options: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Ros2Config(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("network", "multicast", "peers"),
    [
        (NetworkConfig(), "false", ["127.0.0.1"]),
        (NetworkConfig(interface="wlan0"), "true", []),
        (NetworkConfig(interface="192.168.1.2", peers=["192.168.1.20"]), "true", ["192.168.1.20"]),
        (NetworkConfig(interface="auto"), "true", []),
    ],
)
def test_only_this_machine_is_looked_at_unless_an_interface_is_named(network, multicast, peers):
    tree = ElementTree.fromstring(network.cyclonedds_xml())
    assert tree.findtext(".//AllowMulticast") == multicast
    assert [peer.get("address") for peer in tree.iter("Peer")] == peers
