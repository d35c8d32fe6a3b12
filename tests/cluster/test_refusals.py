"""What a cluster cannot do is refused before there is a dataset, with the remedy."""

import os
import socket
from contextlib import closing
from types import SimpleNamespace

import pytest

from bhd_lerobot.cluster import cluster as cluster_module
from bhd_lerobot.cluster import config
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.loop import ClusterLoop
from bhd_lerobot.errors import ClusterError, ConfigError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_brain, make_robot, make_task
from bhd_lerobot.rollout.types import EpisodeSpec
from tests.recording.support import options, run_record


def test_options_that_a_cluster_cannot_honour_are_refused(tmp_path):
    pytest.importorskip("ray")
    for wrong, message in (
        ({"robot__clock": "realtime"}, "robot.clock is 'realtime'"),
        ({"estop_key": "true"}, "estop_key is true"),
        ({"engine": "dask"}, "Unknown engine 'dask'"),
        ({"engine": "local", "ray__num_workers": 2}, "engine is 'local'"),
        ({"ray__address": "ray://head:10001"}, "Ray's client"),
        ({"ray__address": "head"}, "host:port"),
        ({"ray__address": "head:123456"}, "host:port"),
        ({"ray__gpus_per_worker": 1.5}, "ray.gpus_per_worker is 1.5"),
    ):
        with pytest.raises(ConfigError, match=message):
            run_record(tmp_path / "data", **{"engine": "ray", **wrong})
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("address", ["head", "ray://head:10001"])
def test_an_address_of_the_environment_is_refused_by_its_name(tmp_path, monkeypatch, address):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(ConfigError, match=f"RAY_ADDRESS is '{address}'"):
        run_record(tmp_path / "data", engine="ray")
    assert not (tmp_path / "data").exists()


def test_an_emergency_stop_ends_a_run_on_a_cluster(tmp_path):
    config = parse(RecordConfig, options(tmp_path / "data"))
    pool = SimpleNamespace(workers_for=lambda tasks: 1, run=lambda job, ours, tasks, stop: iter(stop, True))
    with closing(make_robot(config.robot)) as robots:
        parts = robots, make_task(config.task, 1, 10, robots.body), make_brain(config.brain)
        loop = ClusterLoop(*parts, pool=pool, config=config, brain_config=config.brain)
        robots.estop()
        with pytest.raises(ClusterError, match="Emergency stop"):
            next(loop.run([EpisodeSpec(0, 0)]))


def test_without_ray_the_message_names_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setattr(config, "importlib", SimpleNamespace(util=SimpleNamespace(find_spec=lambda _: None)))
    with pytest.raises(ConfigError, match=r"pip install -e '\.\[ray\]'"):
        run_record(tmp_path / "data", engine="ray")


def test_a_cluster_that_does_not_exist_is_reported_soon(tmp_path):
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as closed:
        unused = closed.getsockname()[1]
    for address in (f"127.0.0.1:{unused}", "no-such-host.invalid:6379"):
        with pytest.raises(ClusterError, match="cannot be reached") as error:
            run_record(tmp_path / "data", engine="ray", ray__address=address)
        assert address in str(error.value)
        assert "ray start --head" in str(error.value)
    assert not (tmp_path / "data").exists()


@pytest.mark.law
def test_workers_that_share_the_processors_of_this_machine_are_reported(monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(cluster_module, "free_places", lambda config: 99)  # as many as Ray was started with
    there = len(os.sched_getaffinity(0))
    message = cluster_module.describe_crowding(RayConfig(num_workers=there + 3), there + 3)
    assert message == f"{there + 3} workers of 1 CPU share the {there} processors of this machine."
    assert cluster_module.describe_crowding(RayConfig(num_workers=there), there) == ""
    assert cluster_module.describe_crowding(RayConfig(address="auto"), there + 3) == ""
