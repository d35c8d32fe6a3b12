"""Run a Hub in a process of its own, until its input ends: `python -m hub_server` in the folder `tests`."""

import sys

from .server import HubServer

with HubServer() as running:
    print(running.url, flush=True)
    sys.stdin.read()
