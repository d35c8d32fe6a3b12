"""What the peers share: a node that runs until SIGINT, and prints JSON lines."""

import argparse
import ctypes
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def log(event: str, **fields: Any) -> None:
    """Print one line: the event, the times of both clocks [s], and the fields."""
    line = {"event": event, "monotonic": time.monotonic(), "wall": time.time()} | fields
    print(json.dumps(line), flush=True)


def options(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option of all peers."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, help="end by itself after this time [s]")
    return parser


def end_with_parent() -> None:
    """End when the process named by BHD_PARENT does, however it does."""
    if parent := os.environ.get("BHD_PARENT"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != int(parent):
            sys.exit("the tests have ended")


def run(make: Callable[[Callable[[str], Node]], Callable[[], None]], seconds: float | None = None) -> None:
    """Spin the nodes that `make` makes by name until SIGINT, SIGTERM or a time [s]; then call what it returned."""
    end_with_parent()
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    # Not rclpy's own handler: it closes the network before a node can publish its last message.
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor()

    def node(name: str) -> Node:
        executor.add_node(made := Node(name))
        return made

    close = make(node)
    log("ready", pid=os.getpid())
    end = None if seconds is None else time.monotonic() + seconds
    while not stopped and (end is None or time.monotonic() < end):
        executor.spin_once(timeout_sec=0.1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # while Python ends, it would be Python's own end by SIGINT
    close()
    rclpy.shutdown()
