"""Runs on a cluster of two machines: the same bytes as on one, whatever dies."""

import contextlib
import importlib
import io
import os
import pickle
import shutil
import signal
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.cli.record import main
from bhd_lerobot.cluster import loop, pool
from bhd_lerobot.cluster.cluster import describe_crowding
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.job import Job, fingerprint
from bhd_lerobot.cluster.loop import open_pool
from bhd_lerobot.cluster.pool import Task
from bhd_lerobot.datasets.format.video import count_frames
from bhd_lerobot.errors import ActionError, ClusterError
from bhd_lerobot.evaluation import evaluate as evaluate_module
from bhd_lerobot.recording import record as record_module
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.rollout.tolerance import TimingTolerance
from bhd_lerobot.tasks.reach import ReachConfig
from tests.cluster import fakes
from tests.datasets.support import snapshot
from tests.evaluation.test_brains import checkpoint  # noqa: F401  (a fixture)
from tests.evaluation.test_evaluate import FAILING, run_eval
from tests.forks import Fork
from tests.recording.support import options, run_record
from tests.robots.host.support import is_alive
from tests.waiting import until

STORE = 100 * 2**20
ARM = {
    "robot__type": "ur5",
    "brain__type": "reach",
    "task__type": "reach",
    "robot__beams": None,
    "robot__camera": "true",
    "robot__camera_width": 64,
    "robot__camera_height": 48,
    "dataset__repo_id": "test/reach",
}


def test_the_fingerprint_of_an_arm_does_not_depend_on_how_it_is_commanded():
    task = ReachConfig()
    tool, soft = (UR5Config(action_space="tool", control=one) for one in ("servo", "impedance"))
    assert len({fingerprint(robot, task, 25) for robot in (UR5Config(), tool, soft)}) == 1


@pytest.fixture(scope="module")
def ray_folder():
    """Return a folder for all that Ray leaves behind; its default one may not exist, or hold what others left."""
    folder = tempfile.mkdtemp(prefix="bhd-ray-", dir="/tmp")  # a socket's path must be short
    with pytest.MonkeyPatch.context() as patch:
        # `Cluster` writes its address there, whatever folder its machines get, and needs it to exist.
        patch.setenv("RAY_TMPDIR", folder)
        Path(folder, "ray").mkdir()
        yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def cluster(ray_folder):
    """Return two machines with a processor each; the head has none to give."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    path = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path(fakes.__file__).parent), path]))
    machines = cluster_utils.Cluster(
        initialize_head=True,
        head_node_args={
            "num_cpus": 0,
            "num_gpus": 0,
            "object_store_memory": STORE,
            "include_dashboard": False,
            "_system_config": {"health_check_period_ms": 300},  # a machine's end is noticed after five of them
        },
    )
    try:
        machines.spare = [add_machine(machines) for _ in range(2)]
        yield machines
    finally:
        os.environ["PYTHONPATH"] = path
        machines.shutdown()


def add_machine(cluster):
    return cluster.add_node(num_cpus=1, num_gpus=0, object_store_memory=STORE)


def on(cluster, **more) -> dict[str, object]:
    return {"engine": "ray", "ray__address": cluster.address, **more}


def run_alone(root: Path, **overrides: object) -> None:
    """Record on this machine what a cluster's recording is compared with; its picture, which costs a second, is not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record_module.TrajectoryAlbum, "draw", lambda *_: None)
        run_record(root, **overrides)


def after_saves(monkeypatch, actions) -> None:
    """Do something in this process after some episodes were saved."""
    save, saved = record_module.save_episode, []

    def counted(*arguments, **named):
        save(*arguments, **named)
        saved.append(1)
        if len(saved) in actions:
            actions[len(saved)]()

    monkeypatch.setattr(record_module, "save_episode", counted)


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.thorough
def test_a_killed_driver_leaves_good_episodes_and_no_processes(ray_folder, tmp_path):
    pytest.importorskip("ray")
    many = {"dataset__num_episodes": 400, "dataset__episode_time_s": 2}
    arguments = options(tmp_path / "ray", engine="ray", ray__num_workers=1, **many)
    driver = Fork(main, arguments, output=tmp_path / "log")
    family: set[int] = set()
    try:
        until(lambda: len(list((tmp_path / "ray" / "data").rglob("*.parquet"))) >= 2)
        family = descendants(driver.pid)
        assert any(b"RemoteWorker" in Path(f"/proc/{pid}/cmdline").read_bytes() for pid in family)
        driver.kill()
        # Ray's two agents try for a minute to report that the rest has gone.
        until(lambda: not any(working(pid) for pid in family))
    finally:
        for pid in {driver.pid, *family}:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    saved = len(list((tmp_path / "ray" / "data").rglob("*.parquet")))
    result, _ = run_record(tmp_path / "ray", **{**many, "dataset__num_episodes": saved}, resume="true")
    assert result.episodes == saved
    assert result.recorded <= 1
    run_alone(tmp_path / "local", **{**many, "dataset__num_episodes": saved})
    for part in ("data", "meta/episodes"):
        ours, theirs = table(tmp_path / "ray" / part), table(tmp_path / "local" / part)
        assert ours == theirs


def working(pid: int) -> bool:
    """Tell whether a process is there and no agent of Ray's."""
    try:
        return is_alive(pid) and b"Agent" not in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def table(folder: Path) -> dict[str, list]:
    import pyarrow.parquet as pq

    rows = pq.read_table(folder)
    # Which file an episode is in depends on how often the dataset was opened.
    return {name: rows[name].to_pylist() for name in rows.column_names if "/file_index" not in name}


def descendants(pid: int) -> set[int]:
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found, more = set(), {pid}
    while more:
        more = {child for child, parent in parents.items() if parent in more}
        found |= more
    return found


class TestOnePool:
    """Runs one after the other with the same workers, as an evaluation of several brains uses them."""

    @pytest.fixture(scope="class")
    @classmethod
    def pool(cls, cluster):
        with open_pool(RayConfig(address=cluster.address), Console(file=io.StringIO(), width=400)) as pool:
            yield pool
        while len(cluster.spare) < 2:
            cluster.spare.append(add_machine(cluster))

    @pytest.fixture
    def shared(self, pool, monkeypatch):
        for module in (record_module, evaluate_module):
            monkeypatch.setattr(module, "open_pool", lambda *_: contextlib.nullcontext(pool))

    def test_a_recording_is_the_same_although_a_worker_and_a_machine_die(
        self, cluster, pool, shared, tmp_path, monkeypatch
    ):
        """The first of this class: what comes after it runs on the worker that is left."""
        killed: list[int] = []

        def a_worker() -> int:
            # The pool may not have missed yet the one that was killed just now.
            pids = [int(worker.host.rpartition(" ")[2]) for worker in pool._workers if worker.host]
            return next(pid for pid in pids if pid not in killed)

        def kill_a_worker() -> None:
            killed.append(a_worker())
            os.kill(killed[0], signal.SIGKILL)

        def kill_its_machine() -> None:
            raylet = parent_of(a_worker())
            machine = next(one for one in cluster.spare if one.all_processes["raylet"][0].process.pid == raylet)
            cluster.spare.remove(machine)
            cluster.remove_node(machine, allow_graceful=False)

        # When the sixth is saved, 22 are missing, and no more than 16 of them can be on their way or waiting to be
        # saved.
        with monkeypatch.context() as once:
            after_saves(once, {2: kill_a_worker, 6: kill_its_machine})
            many = {"dataset__num_episodes": 28, "n_envs": 2, "dataset__episode_time_s": 1}
            result, _ = run_record(tmp_path / "ray", **on(cluster, ray__episodes_per_task=2), **many)
        printed = pool._console.file.getvalue()
        assert (result.exit_status, result.recorded) == (0, 28)
        assert printed.count("A worker was lost") >= 2
        assert "will be run again" in printed
        run_alone(tmp_path / "local", **many)
        assert snapshot(tmp_path / "ray") == snapshot(tmp_path / "local")

    @pytest.mark.thorough
    def test_a_cluster_goes_on_with_what_one_machine_began_images_too(self, cluster, shared, tmp_path):
        several = {**ARM, "dataset__num_episodes": 4, "dataset__episode_time_s": 1, "n_envs": 2}
        run_alone(tmp_path / "local", **{**several, "dataset__num_episodes": 2})
        shutil.copytree(tmp_path / "local", tmp_path / "ray")
        run_alone(tmp_path / "local", **several, resume="true")
        result, _ = run_record(tmp_path / "ray", **several, resume="true", **on(cluster))
        assert result.recorded == 2
        ours, theirs = snapshot(tmp_path / "ray"), snapshot(tmp_path / "local")
        assert ours.keys() == theirs.keys()
        # An encoder's bytes differ now and then on one machine as well; the statistics are those of the very images.
        videos = {name for name in ours if name.endswith(".mp4")}
        assert len(videos) == 2
        assert {name for name in ours if ours[name] != theirs[name]} <= videos
        assert all(count_frames(tmp_path / "ray" / name) == count_frames(tmp_path / "local" / name) for name in videos)

    def test_an_evaluation_gives_the_same_results_and_its_policy_travels(
        self,
        cluster,
        shared,
        checkpoint,  # noqa: F811
        tmp_path,
        monkeypatch,
    ):
        policy = tmp_path / "policy"
        shutil.copytree(checkpoint, policy)
        brains = {"only": "[old,net]", "brains__net__type": "learned", "brains__net__path": policy}
        same = {**brains, "brains__net__exact": "true", "n_episodes": 4, "n_envs": 2, **FAILING}
        with monkeypatch.context() as once:
            once.setattr(evaluate_module, "write_report", lambda *_: None)  # only the numbers are compared
            run_eval(tmp_path / "local", **same)

        def read_and_hide(brain):
            found = read(brain)
            if found:
                policy.rename(tmp_path / "hidden")  # as if the worker were on another machine
            return found

        read = loop.read_checkpoints
        monkeypatch.setattr(loop, "read_checkpoints", read_and_hide)
        result, _ = run_eval(tmp_path / "ray", **on(cluster), **same)
        assert result.exit_status == 0
        assert (tmp_path / "hidden").is_dir()
        assert (tmp_path / "ray/results.json").read_bytes() == (tmp_path / "local/results.json").read_bytes()
        with (
            np.load(tmp_path / "ray/initial_states.npz") as one,
            np.load(tmp_path / "local/initial_states.npz") as other,
        ):
            assert all(np.array_equal(one[name], other[name]) for name in other.files)
        assert result.timing["brains"]["net"]["act"]["calls"] > 0

    def test_workers_that_others_leave_no_room_for_are_not_waited_for_without_end(self, cluster, pool):
        assert pool._workers  # which occupy what machines there are
        _, _, error = run_pool(cluster, [fakes.ECHO], timeout_s=1.0)
        assert isinstance(error, ClusterError)
        assert "No worker could be started within 1 s" in str(error)

    def test_nothing_is_left_where_a_brain_fails_on_the_cluster(self, cluster, shared, checkpoint, tmp_path):  # noqa: F811
        import safetensors.numpy

        policy = tmp_path / "policy"
        shutil.copytree(checkpoint, policy)
        weights = safetensors.numpy.load_file(policy / "model.safetensors")
        for values in weights.values():
            values[...] = np.nan
        safetensors.numpy.save_file(weights, policy / "model.safetensors")
        brain = {"brain__type": "learned", "brain__path": policy, "dataset__num_episodes": 1}
        with pytest.raises(ActionError) as alone:
            run_alone(tmp_path / "local", **brain)
        with pytest.raises(ActionError) as spread:
            run_record(tmp_path / "ray", **brain, **on(cluster))
        assert str(spread.value) == str(alone.value)
        assert snapshot(tmp_path / "ray") == snapshot(tmp_path / "local")

    def test_ctrl_c_ends_it_in_order_and_one_machine_goes_on(self, cluster, shared, tmp_path, monkeypatch):
        many = {"dataset__num_episodes": 30, "dataset__episode_time_s": 3}
        with monkeypatch.context() as once:
            after_saves(once, {2: lambda: os.kill(os.getpid(), signal.SIGINT)})
            result, printed = run_record(tmp_path / "ray", **on(cluster), **many)
        assert result.exit_status == 128 + signal.SIGINT
        assert 2 <= result.recorded < 30
        assert "Stopped by SIGINT" in printed
        shorter = {**many, "dataset__num_episodes": result.recorded + 1}
        assert run_record(tmp_path / "ray", **shorter, resume="true")[0].exit_status == 0
        run_alone(tmp_path / "local", **{**shorter, "dataset__num_episodes": result.recorded})
        run_alone(tmp_path / "local", **shorter, resume="true")
        assert snapshot(tmp_path / "ray") == snapshot(tmp_path / "local")


@pytest.fixture(scope="module")
def driver(cluster):
    """Keep this process a driver of the cluster, which takes a second to become one."""
    with open_pool(RayConfig(address=cluster.address), Console(file=io.StringIO())):
        yield


def run_pool(cluster, specs, *, fingerprint=fakes.FINGERPRINT, stop=lambda: False, **settings):
    """Run episodes with the fake server, one in a task; return their numbers as they come, and what was printed."""
    console = Console(file=io.StringIO(), width=400)
    job = Job(None, None, None, TimingTolerance(), 10, 1, 1)
    got: list[int] = []
    with open_pool(RayConfig(**{"address": cluster.address, **settings}), console) as pool:
        pool._server = Path(fakes.__file__).stem
        try:
            for result in pool.run(job, fingerprint, [Task(i, [(i, what)]) for i, what in enumerate(specs)], stop):
                got += [pickle.loads(one) for one in result["episodes"]]
        except Exception as error:
            return got, console.file.getvalue(), error
    return got, console.file.getvalue(), None


@pytest.mark.usefixtures("driver")
def test_what_a_worker_raises_ends_the_run_after_what_comes_before(cluster):
    specs = [fakes.SLOW, *[fakes.ECHO] * 4, fakes.RAISE, *[fakes.ECHO] * 50]
    got, _, error = run_pool(cluster, specs)
    assert got == [0, 1, 2, 3, 4]
    assert type(error) is RuntimeError
    assert "UnpicklableError: no way" in str(error)
    assert any("episode 5" in note for note in error.__notes__)
    assert any("fakes.py" in note for note in error.__notes__)


@pytest.mark.usefixtures("driver")
def test_an_episode_that_kills_every_worker_is_given_up(cluster):
    got, printed, error = run_pool(cluster, [fakes.ECHO, fakes.DIE, fakes.ECHO], num_workers=1)
    assert got == [0]
    assert isinstance(error, ClusterError)
    assert "3 workers were lost while they ran episode 1" in str(error)
    assert printed.count("A worker was lost") >= 2


@pytest.mark.usefixtures("driver")
def test_a_worker_with_other_versions_is_refused_by_name(cluster, monkeypatch):
    version = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "9.9.9" if name == "numpy" else version(name))
    got, _, error = run_pool(cluster, [fakes.ECHO])
    assert got == []
    assert isinstance(error, ClusterError)
    assert f"numpy {version('numpy')} there, 9.9.9 here" in str(error)
    assert "mujoco" not in str(error)


@pytest.mark.usefixtures("driver")
def test_a_machine_that_computes_something_else_is_refused(cluster):
    got, _, error = run_pool(cluster, [fakes.ECHO], fingerprint="other")
    assert got == []
    assert isinstance(error, ClusterError)
    assert "other numbers for the same episode" in str(error)


@pytest.mark.usefixtures("driver")
def test_workers_that_no_machine_has_room_for_are_refused(cluster):
    _, _, error = run_pool(cluster, [fakes.ECHO], cpus_per_worker=64)
    assert isinstance(error, ClusterError)
    assert "No machine of the cluster has 64 CPUs" in str(error)


@pytest.mark.usefixtures("driver")
def test_how_many_workers_run_at_a_time_is_told_if_more_were_asked_for(cluster, monkeypatch):
    got, printed, error = run_pool(cluster, [fakes.ECHO] * 6, num_workers=5)
    assert (got, error) == (list(range(6)), None)
    assert "ray.num_workers is 5, and the cluster has room for 2 of 1 CPU: 2 run at a time." in printed
    assert printed.count("1 CPUs and 0 GPUs") == 2  # the machines that have room, by name
    with open_pool(RayConfig(address=cluster.address), Console(file=io.StringIO())) as pool:
        # No message about workers without a task, nor where no number was asked for.
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})  # whatever this machine has
        for config, tasks in ((RayConfig(num_workers=5), 2), (RayConfig(), 6)):
            pool._config = config
            assert describe_crowding(config, pool.workers_for(tasks)) == ""


@pytest.mark.usefixtures("driver")
def test_a_machine_without_this_package_is_reported(cluster, tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("class RemoteWorker:\n    def host(self): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(pool, "RemoteWorker", importlib.import_module("only_here").RemoteWorker)
    got, _, error = run_pool(cluster, [fakes.ECHO])
    assert got == []
    assert isinstance(error, ClusterError)
    assert "could not be started: ModuleNotFoundError: No module named 'only_here'. Install this package" in str(error)
