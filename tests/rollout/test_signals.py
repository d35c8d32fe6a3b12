"""Ending a run by a signal: the first is a request, the handlers come back, and another thread is left alone."""

import os
import signal
import threading

from bhd_lerobot.rollout.signals import stop_on_signals


def test_the_second_hangup_of_a_closed_session_does_not_kill() -> None:
    with stop_on_signals() as request:
        os.kill(os.getpid(), signal.SIGHUP)
        assert request.name == "SIGHUP"
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        os.kill(os.getpid(), signal.SIGHUP)
    with stop_on_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


def test_a_run_in_another_thread_changes_no_handler() -> None:
    former, seen = signal.getsignal(signal.SIGINT), []

    def run() -> None:
        with stop_on_signals() as request:
            seen.append((bool(request), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [(False, former)]


def test_what_is_ignored_stays_ignored_as_under_nohup() -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals() as request:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not request
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)
