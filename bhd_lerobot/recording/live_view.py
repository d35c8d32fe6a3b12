"""`--display_data=true`: what a recording does, live in Rerun or Foxglove, through LeRobot's own helpers.

The helpers are slow (a call a number), so they run on a thread of their own. It shows the newest frames and leaves out
what it has no time for: the run never waits for the view.
"""

import importlib.util
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError

if TYPE_CHECKING:
    from bhd_lerobot.robots.host.robots import Robots

PACKAGES = {"rerun": ("rerun-sdk", "rerun"), "foxglove": ("foxglove-sdk", "foxglove")}
"""What each `display_mode` needs: the package, and the module in it."""

SHOWN = (
    *(keys.TIME, keys.AGE, keys.COMMAND_AGE, keys.LATENESS, keys.OVERRUNS, keys.SKIPPED, keys.INFERENCE_TIME),
    *(keys.LIMITS, keys.WATCHDOG, keys.MODE, keys.REWARD),
)
"""Columns of one number that are shown, under their names in the dataset and in its units."""

SCAN = "scan"
APPLIED = "applied."
POSE = ("pose.x", "pose.y", "pose.z", "pose.qw", "pose.qx", "pose.qy", "pose.qz")
POINTS = "scan_points"
MODE_TEXT = "mode"
_WAITING = 2  # frames that may wait; of more only the newest are of interest
_END_S = 5.0  # that the end of a run waits for the view


class DisplayOptions(Protocol):
    """The options, named as those of `lerobot-record`; `RecordConfig` has them."""

    display_data: bool
    display_mode: str
    display_ip: str | None
    display_port: int | None
    display_compressed_images: bool


def check_display(options: DisplayOptions) -> None:
    """Refuse options that cannot be honoured. Imports nothing."""
    port = options.display_port
    if options.display_mode == "rerun" and (options.display_ip is None) != (port is None):
        raise ConfigError(
            f"display_ip is {options.display_ip!r} and display_port is {port!r}; with display_mode = 'rerun' give "
            "both, to send to a viewer that runs there, or neither, to start a viewer here."
        )
    package, module = PACKAGES[options.display_mode]
    if options.display_data and importlib.util.find_spec(module) is None:
        raise ConfigError(
            f"--display_data=true with display_mode = {options.display_mode!r} needs the package {package!r}, which is "
            f"not installed. Install it (pip install {package}), or leave --display_data out."
        )


class LiveView:
    """Shows the frames of one of the robots that run side by side: number 0.

    It is an `Observer` of an `EpisodeLoop`. What goes where, by the names that LeRobot's helpers are given:

    - action: the brain's command, by the names of the actions, and beside it what was applied, ``applied.…``;
    - observation: the robot's floats by their names, but the scan, which is one array ``scan`` [m]; ``pose.…`` of the
      base or the tool at the start of the frame, in the world, from the simulator [m, quaternion wxyz];
      ``environment_state``; the columns ``control.…`` and ``next.reward`` as in the dataset; images;
    - in Rerun also ``scan_points``, the scan as points in the robot's frame with ahead upwards, and ``mode`` as text.

    Attributes:
        shown: frames that were shown.
        left_out: frames that were not, for want of time.
        problem: why nothing is shown any more, or an empty text.
    """

    def __init__(self, options: DisplayOptions, robots: "Robots") -> None:
        check_display(options)
        self.shown = self.left_out = 0
        self.problem = ""
        self._mode = options.display_mode
        # As lerobot-record does: what goes over a network is compressed.
        remote = options.display_ip is not None and options.display_port is not None
        self._compress = remote or options.display_compressed_images
        self._actions, self._track = robots.action_names, robots.track
        names = robots.observation_names
        self._scan = np.array([i for i, name in enumerate(names) if name.startswith("scan_")], np.intp)
        self._floats = [(i, name) for i, name in enumerate(names) if not name.startswith("scan_")]
        self._cameras, body = tuple(robots.camera_shapes), robots.body
        lidar = body.lidar if body else None
        self._range_max = lidar.range_max if lidar is not None else np.inf
        self._images: dict[str, NDArray[np.uint8]] = {}
        self._frames: deque[tuple[dict[str, Any], dict[str, Any]]] = deque(maxlen=_WAITING)
        self._changed, self._ended = threading.Condition(), False
        self._log: Callable[..., None]
        self._shutdown: Callable[[str], None]
        self._extras: RerunExtras | None = None
        self._start(options)
        self._thread = threading.Thread(target=self._work, name="bhd-live-view", daemon=True)
        self._thread.start()

    def _start(self, options: DisplayOptions) -> None:
        try:
            if options.display_mode == "rerun" and options.display_ip is not None:
                # Rerun would continue looking for its viewer in silence.
                socket.create_connection((options.display_ip, options.display_port or 0), _END_S).close()
            from bhd_lerobot.stock import visualization_utils as helpers

            helpers.init_visualization(
                options.display_mode, session_name="bhd-record", ip=options.display_ip, port=options.display_port
            )
            self._log, self._shutdown = helpers.log_visualization_data, helpers.shutdown_visualization
            if options.display_mode == "rerun":
                self._extras = RerunExtras(self._cameras, self._range_max)
        except Exception as error:  # of libraries that are not ours: a port in use, a package that does not fit
            raise ConfigError(
                f"--display_data=true: {options.display_mode} could not be started: {error}. Fix that, choose another "
                "--display_mode or --display_port, or leave --display_data out."
            ) from error

    def __call__(self, sim: int, columns: Mapping[str, Any]) -> None:
        """Take a frame, or an image that the next frame is shown with; returns at once."""
        if sim != 0 or self.problem:
            return
        if keys.ACTION not in columns:
            with self._changed:
                self._images |= columns
            return
        frame = self._observation(columns), self._action(columns)
        with self._changed:
            self.left_out += len(self._frames) == _WAITING
            self._frames.append(frame)
            self._changed.notify()

    def _observation(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        shown: dict[str, Any] = {}
        if keys.OBSERVATION_STATE in columns:
            state = columns[keys.OBSERVATION_STATE]
            shown |= {name: float(state[i]) for i, name in self._floats}
            if len(self._scan):
                shown[SCAN] = state[self._scan]  # a copy: the index is an array
        if keys.PHYSICS_STATE in columns:
            pose = self._track(columns[keys.PHYSICS_STATE][None])[0]
            shown |= dict(zip(POSE, map(float, pose), strict=True))
        if keys.ENVIRONMENT_STATE in columns:
            shown["environment_state"] = np.array(columns[keys.ENVIRONMENT_STATE])
        shown |= {key: float(columns[key]) for key in SHOWN if key in columns}
        with self._changed:
            images, self._images = self._images, {}
        return shown | images

    def _action(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        requested = zip(self._actions, columns[keys.ACTION].tolist(), strict=True)
        applied = zip(self._actions, columns[keys.APPLIED_ACTION].tolist(), strict=True)
        return dict(requested) | {APPLIED + name: value for name, value in applied}

    def _work(self) -> None:
        try:
            while (frame := self._next()) is not None:
                observation, action = frame
                if self._extras is not None:
                    self._extras(observation, action)
                self._log(self._mode, observation=observation, action=action, compress_images=self._compress)
                self.shown += 1
        except Exception as error:  # of libraries that are not ours; a recording does not end because nobody sees it
            self.problem = f"{type(error).__name__}: {error}"

    def _next(self) -> tuple[dict[str, Any], dict[str, Any]] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._ended)
            return self._frames.popleft() if self._frames else None

    def close(self) -> None:
        """Show what waits and end the view. May be called twice."""
        with self._changed:
            if self._ended:
                return
            self._ended = True
            self._changed.notify()
        self._thread.join(_END_S)
        if self._thread.is_alive():
            self.problem = f"it did not take the last frames within {_END_S:g} s"
        try:
            if self._extras is not None:
                self._extras.flush()
            if not self._thread.is_alive():
                self._shutdown(self._mode)
        except Exception as error:
            self.problem = self.problem or f"{type(error).__name__}: {error}"


class RerunExtras:
    """What only Rerun can show: the scan as points, the mode as text, views that put things side by side.

    Args:
        cameras: the cameras.
        range_max: what a beam without a return reads [m].
    """

    def __init__(self, cameras: Sequence[str], range_max: float) -> None:
        import rerun

        self._images = [f"{keys.OBSERVATION_IMAGES}.{camera}" for camera in cameras]
        self._rerun, self._range_max = rerun, range_max
        self._last_mode: int | None = None
        self._arranged = False

    def __call__(self, observation: dict[str, Any], action: dict[str, Any]) -> None:
        """Show a frame's; to be called before LeRobot's helper is, and on the same thread."""
        rerun = self._rerun
        if keys.TIME in observation:
            rerun.set_time("episode_time", duration=observation[keys.TIME])
        if SCAN in observation:
            rerun.log(POINTS, rerun.Points2D(points(observation[SCAN], self._range_max), radii=0.02))
        mode = int(observation[keys.MODE])
        if mode != self._last_mode:
            self._last_mode = mode
            rerun.log(MODE_TEXT, rerun.TextLog(Mode(mode).name))
        if self._arranged:
            return
        self._arranged = True
        # LeRobot's helper sends a layout of its own with its first frame, unless there is one: it would know no points.
        from bhd_lerobot.stock import log_rerun_data

        log_rerun_data.blueprint = self._layout(observation, action)
        rerun.send_blueprint(log_rerun_data.blueprint)

    def flush(self) -> None:
        """Send what waits; after an error nothing more is sent, or the end of the program would wait for ever."""
        recording = self._rerun.get_global_data_recording()
        try:
            if recording is not None:
                recording.flush(timeout_sec=_END_S)
        except Exception:
            self._rerun.unregister_shutdown()
            raise

    def _layout(self, observation: dict[str, Any], action: dict[str, Any]) -> Any:
        import rerun.blueprint as layout

        def series(name: str, *entities: str) -> Any:
            return layout.TimeSeriesView(name=name, contents=list(entities))

        views: list[Any] = [layout.Spatial2DView(origin=image, name=image) for image in self._images]
        if SCAN in observation:
            views.append(layout.Spatial2DView(origin=POINTS, name="scan [m], ahead is up"))
        requested = [name for name in action if not name.startswith(APPLIED)]
        pairs = [
            series(f"{name}: requested, applied", f"action.{name}", f"action.{APPLIED}{name}") for name in requested
        ]
        views += pairs if len(pairs) <= 2 else [layout.Tabs(*pairs, name="requested, applied")]
        views.append(series("pose of base or tool [m]", *(f"observation.{name}" for name in POSE[:3])))
        views.append(series("lateness [s]", f"observation.{keys.LATENESS}"))
        mode = layout.TextLogView(origin=MODE_TEXT, name="mode")
        views.append(layout.Vertical(series("mode", f"observation.{keys.MODE}"), mode, name="mode"))
        return layout.Blueprint(layout.Grid(*views))


def points(scan: NDArray[Any], range_max: float) -> NDArray[np.float64]:
    """Return where a scan's returns lie on an image whose y axis points down, with ahead upwards.

    Args:
        scan: ranges [m], beam 0 straight ahead, counter-clockwise, shape (beams,).
        range_max: what a beam without a return reads [m]; those are left out.

    Returns:
        Minus y and minus x in the robot's frame [m], shape (returns, 2).
    """
    angles = 2 * np.pi * np.arange(len(scan)) / len(scan)
    seen = scan < range_max
    return -(scan[seen, None] * np.column_stack([np.sin(angles[seen]), np.cos(angles[seen])])).astype(np.float64)


@contextmanager
def live_view(options: DisplayOptions, robots: "Robots", console: Console) -> Iterator[LiveView | None]:
    """Show a run live if `display_data` is set; at its end print how many frames were left out."""
    if not options.display_data:
        yield None
        return
    view = LiveView(options, robots)
    try:
        yield view
    finally:
        view.close()
        if view.problem:
            console.print(f"Live view: ended after {view.shown} frames: {escape(view.problem)}")
        elif view.left_out:
            console.print(f"Live view: {view.shown} frames shown, {view.left_out} left out so as not to wait for it.")
