"""Where episodes are run: in this process, or on a cluster of machines."""

import importlib.util
from dataclasses import dataclass
from typing import Any

from bhd_lerobot.errors import ConfigError, install_extra
from bhd_lerobot.options.declared import Count, NotNegative, Options, Positive

ENGINES = ("local", "ray")


@dataclass
class RayConfig(Options, prefix="ray."):
    """The cluster, and the share of it that is used. The names are those of Ray.

    Attributes:
        address: `local` starts a cluster of this machine only, for the duration of the run; `auto` is the cluster that
            this machine is part of; or `host:port` of its head. By default the value of `RAY_ADDRESS`, otherwise
            `local`.
        num_workers: processes that run episodes; by default as many as the cluster has room for.
        cpus_per_worker: processors of each worker, and the threads that step its physics, unless `threads` is set.
        gpus_per_worker: GPUs of each worker; a share such as 0.25 if several workers use one.
        episodes_per_task: episodes that a worker receives at a time, and that are lost with it; by default one, or
            twice `n_envs` if more than one runs in parallel.
        timeout_s: time for the cluster to answer, and to start a first worker [s].
        include_dashboard: start Ray's dashboard with a cluster of this machine; it needs Ray's extra `default`.
    """

    address: str | None = None
    num_workers: Count | None = None
    cpus_per_worker: Count = 1
    gpus_per_worker: NotNegative = 0.0
    episodes_per_task: Count | None = None
    timeout_s: Positive = 60.0
    include_dashboard: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gpus_per_worker > 1 and self.gpus_per_worker % 1:
            raise ConfigError(
                f"ray.gpus_per_worker is {self.gpus_per_worker}; it is a share up to 1, or a whole number."
            )
        if self.address is not None:
            check_address(self.address)


def check_engine(config: Any) -> None:
    """Refuse what a cluster cannot do. Imports nothing."""
    if config.engine == "local":
        if config.ray != RayConfig():
            raise ConfigError("Options of ray are set, but engine is 'local'; add --engine=ray, or leave them out.")
        return
    if not hasattr(config.robot, "clock"):
        raise ConfigError(
            f"robot.type is {config.robot.type!r}, a robot of its own, and engine is 'ray'; a cluster runs simulated "
            "robots. Use --engine=local."
        )
    if config.robot.clock == "realtime":
        raise ConfigError(
            "robot.clock is 'realtime' and engine is 'ray': a robot on the wall clock runs where its real-time process "
            "was set up, not wherever a cluster has room. Use --engine=local, or --robot.clock=lockstep."
        )
    for name in ("display_data", "view"):
        if getattr(config, name, False):
            raise ConfigError(
                f"{name} is true and engine is 'ray': frames stay on the machines of the cluster. Leave one of them "
                "out."
            )
    if getattr(config, "estop_key", None):
        raise ConfigError(
            "estop_key is true and engine is 'ray': simulations on other machines have no key. Ctrl-C ends the run."
        )
    if importlib.util.find_spec("ray") is None:
        raise ConfigError(
            "engine is 'ray', but Ray is not installed. It is needed here and on every machine of the cluster. "
            + install_extra("ray")
        )


def check_address(address: str, name: str = "ray.address") -> None:
    """Refuse what is no address of a cluster; `name`: where it comes from."""
    if address.startswith("ray://"):
        raise ConfigError(
            f"{name} is {address!r}, which is for Ray's client. Start this command on a machine of the cluster "
            "with --ray.address=auto, or send it there: ray job submit --address=http://HEAD:8265 -- bhd-record …"
        )
    if address in ("local", "auto"):
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"{name} is {address!r}. Valid: local, auto, or host:port such as 10.0.0.1:6379.")
