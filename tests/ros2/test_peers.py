"""How a peer ends."""

import signal

from tests.ros2.peer_env import Peer


def test_a_peer_that_does_not_listen_to_sigint_is_killed(domain: int) -> None:
    with Peer("topic.py", "list", domain=domain) as peer:
        peer.wait_event("list")
        peer.signal(signal.SIGSTOP)
        assert peer.stop() == 0  # SIGCONT comes first
    with Peer("topic.py", "list", domain=domain) as peer:
        assert peer.stop(seconds=0) in (-signal.SIGKILL, -signal.SIGINT, 0)
