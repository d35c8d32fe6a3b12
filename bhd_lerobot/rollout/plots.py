"""Images of a run: trajectories from above, divergence over time."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.fetch_scene import FetchScene
from bhd_lerobot.bodies.tabletop import COLOURS, TableScene

SHOWN = 40  # episodes of a run that are drawn: a panel takes 0.1 s, and more are no longer looked at one by one

_FREE, _WALL = "#f4f1ea", "#8a8478"
GOOD, BAD = "#0072B2", "#D55E00"  # of the palette of Okabe and Ito, for colour-blind people
_COLOURS = {True: GOOD, False: BAD, None: "#3b4a5a"}


@dataclass(frozen=True)
class Trajectory:
    """One episode from above: `xy` in the world frame [m], (frames, 2); `success` is None if nothing was attempted."""

    title: str
    scene: Arena | TableScene
    xy: NDArray[np.float64]
    success: bool | None
    instruction: str = ""


class TrajectoryAlbum:
    """Collects the episodes of a run that are worth an image, in memory that does not grow with the run."""

    def __init__(self) -> None:
        self.added = 0
        self._drawn: dict[bool, list[tuple[int, Trajectory]]] = {True: [], False: []}

    def add(self, trajectory: Trajectory) -> None:
        """Add the next episode; of failures, and of successes, the first `SHOWN` are drawn."""
        drawn = self._drawn[trajectory.success is not False]
        if len(drawn) < SHOWN:
            drawn.append((self.added, trajectory))
        self.added += 1

    @property
    def shown(self) -> list[Trajectory]:
        """At most `SHOWN` episodes in the order of the run: failures before all, then the first successes."""
        failures, successes = self._drawn[False], self._drawn[True]
        chosen = [*failures, *successes[: SHOWN - len(failures)]]
        return [trajectory for _, trajectory in sorted(chosen, key=lambda one: one[0])]

    def draw(self, path: Path, heading: str) -> None:
        """Draw what is shown; the heading says so if that is not all."""
        shown = self.shown
        if len(shown) < self.added:
            heading += f"; {len(shown)} of them{', failures before others' * has_outcomes(shown)}"
        draw_trajectories(shown, path, heading)


def draw_trajectories(trajectories: Sequence[Trajectory], path: Path, heading: str) -> None:
    """Draw every trajectory in a panel of its own."""
    columns, rows = _grid(len(trajectories))
    size = 2.1 if len(trajectories) > 4 else 4.0
    # Figure without pyplot: no global state, no display.
    figure = Figure(figsize=(size * columns + 0.2, size * 1.06 * rows + 0.7), layout="constrained")
    figure.suptitle(heading, fontsize=11)
    for axes, trajectory in zip_longest(figure.subplots(rows, columns, squeeze=False).flat, trajectories):
        if trajectory is None:
            axes.set_axis_off()
        else:
            draw_panel(axes, trajectory)
    figure.supxlabel(f"circle: start, square: end{', cross: failure' * has_outcomes(trajectories)}", fontsize=7.5)
    figure.savefig(path, dpi=110)


def has_outcomes(trajectories: Sequence[Trajectory]) -> bool:
    """Return whether any of them was an attempt."""
    return any(trajectory.success is not None for trajectory in trajectories)


def _grid(count: int) -> tuple[int, int]:
    """Return columns and rows for some panels: a little wider than high, with few empty places."""
    wide = math.sqrt(max(count, 1) * 1.4)
    candidates = range(max(1, int(wide) - 1), int(wide) + 3)
    columns = min(candidates, key=lambda c: (-(-count // c) * c - count + abs(c - wide), c))
    return min(columns, max(count, 1)), max(1, -(-count // columns))


def draw_panel(axes: Axes, trajectory: Trajectory) -> None:
    """Draw an episode: a line, dashed after a failure, from a circle to a square, or to the cross of a failure."""
    draw_scene(axes, trajectory.scene)
    _widen(axes, trajectory.xy)
    color, is_failure = _COLOURS[trajectory.success], trajectory.success is False
    style: Any = (0, (3, 1)) if is_failure else "-"
    axes.plot(trajectory.xy[:, 0], trajectory.xy[:, 1], color=color, linestyle=style, linewidth=1.1)
    axes.plot(*trajectory.xy[0], marker="o", color=color, markersize=4)
    marker, size, width = ("x", 7, 2.0) if is_failure else ("s", 5, 1.2)
    axes.plot(*trajectory.xy[-1], color=color, markerfacecolor="none", markeredgewidth=width, marker=marker, ms=size)
    title = trajectory.title
    # The font has no Chinese characters.
    if isinstance(trajectory.scene, TableScene) and trajectory.instruction.isascii():
        title = f"{title}\n{textwrap.shorten(trajectory.instruction, 44, placeholder=' …')}".rstrip()
    axes.set_title(title, fontsize=7.5, color=color, parse_math=False)  # an instruction may be about dollars
    _draw_scale(axes)


def _draw_scale(axes: Axes) -> None:
    """Draw a bar of 1 m under the panel, of 0.1 m under one of less than 3 m."""
    left, right = axes.get_xlim()
    length = 1.0 if right - left > 3 else 0.1
    across = axes.get_xaxis_transform()  # x in metres, y in parts of the panel
    axes.plot([left, left + length], [-0.03, -0.03], color="black", linewidth=1.5, transform=across, clip_on=False)
    axes.text(left + length, -0.03, f"  {length:g} m", fontsize=6.5, va="center", transform=across)


def draw_scene(axes: Axes, scene: Arena | TableScene) -> None:
    """Draw what is around the robot from above, to scale."""
    if isinstance(scene, Arena):
        draw_arena(axes, scene)
    elif isinstance(scene, FetchScene):
        draw_arena(axes, scene.arena)
        _draw_objects(axes, scene)
    else:
        draw_table(axes, scene)


def draw_table(axes: Axes, scene: TableScene) -> None:
    """Draw the objects before an arm from above, to scale, the base of the arm at the left."""
    axes.set_facecolor(_FREE)
    axes.add_patch(Circle((0.0, 0.0), 0.075, color=_WALL, linewidth=0))
    _draw_objects(axes, scene)
    _frame_axes(axes, (-0.15, 0.85, -0.5, 0.5))
    target = scene.target_pose or (0.0, 0.0)  # of an arm that is larger than a UR5, it may be farther away
    _widen(axes, np.array([target[:2], *((item.x, item.y) for item in scene.objects)]))


def _draw_objects(axes: Axes, scene: TableScene) -> None:
    """Draw the objects of a scene, with a ring around the target, and the wanted pose."""
    for number, item in enumerate(scene.objects):
        edge: dict[str, Any] = {"facecolor": COLOURS[item.colour], "edgecolor": "black"}
        edge["linewidth"] = 0.3
        if number == scene.target_object:  # a ring beside it, which an object of any colour leaves visible
            ring = math.hypot(item.size_x, item.size_y) + 0.02
            axes.add_patch(Circle((item.x, item.y), ring, fill=False, edgecolor="black", linestyle="--", linewidth=1.0))
        if item.kind == "cup":
            axes.add_patch(Circle((item.x, item.y), item.size_x, **edge))
        else:
            corner = (item.x - item.size_x, item.y - item.size_y)
            angle = math.degrees(item.yaw)
            axes.add_patch(
                Rectangle(corner, 2 * item.size_x, 2 * item.size_y, angle=angle, rotation_point="center", **edge)
            )
    if scene.target_pose is not None:
        axes.plot(*scene.target_pose[:2], marker="+", color="black", markersize=8, markeredgewidth=1.5)


def _frame_axes(axes: Axes, limits: tuple[float, float, float, float]) -> None:
    axes.set_xlim(*limits[:2])
    axes.set_ylim(*limits[2:])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)


def _widen(axes: Axes, xy: NDArray[np.float64]) -> None:
    """Widen what is shown to places [m], shape (k, 2), with a little room around them."""
    (left, bottom), (right, top) = xy.min(axis=0) - 0.05, xy.max(axis=0) + 0.05
    (x_min, x_max), (y_min, y_max) = axes.get_xlim(), axes.get_ylim()
    axes.set_xlim(min(x_min, left), max(x_max, right))
    axes.set_ylim(min(y_min, bottom), max(y_max, top))


def draw_arena(axes: Axes, arena: Arena) -> None:
    """Draw the obstacles of an arena from above, to scale."""
    x_min, x_max, y_min, y_max = arena.extent
    axes.set_facecolor(_FREE)
    room = axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, visible=False))
    for shape in arena.shapes:
        patch: Circle | Rectangle
        if shape.kind == "cylinder":
            patch = Circle((shape.x, shape.y), shape.size_x, color=_WALL, linewidth=0)
        else:
            corner = (shape.x - shape.size_x, shape.y - shape.size_y)
            angle = math.degrees(shape.yaw)
            size = (2 * shape.size_x, 2 * shape.size_y)
            patch = Rectangle(corner, *size, angle=angle, rotation_point="center", color=_WALL, linewidth=0)
        axes.add_patch(patch)
        if x_min < shape.x < x_max and y_min < shape.y < y_max:  # what stands in a wall does not stick out behind it
            patch.set_clip_path(room)
    if arena.goal is not None:
        x, y, yaw = arena.goal
        axes.plot(x, y, marker="+", color="black", markersize=8, markeredgewidth=1.5)
        tip = (x + 0.35 * math.cos(yaw), y + 0.35 * math.sin(yaw))  # the requested heading
        axes.annotate("", xy=tip, xytext=(x, y), arrowprops={"arrowstyle": "->", "color": "black", "linewidth": 1.2})
    _frame_axes(axes, (x_min - 0.12, x_max + 0.12, y_min - 0.12, y_max + 0.12))


def draw_divergence(
    *,
    scene: Arena | TableScene,
    recorded: NDArray,
    replayed: NDArray,
    time: NDArray,
    curves: dict[str, Any],
    heading: str,
    path: Path,
) -> None:
    """Draw a replay beside its recording: positions [m], (frames, 2), and differences by label with unit, over s."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    figure.suptitle(heading, fontsize=11)
    columns = figure.add_gridspec(1, 2, width_ratios=(1, 1.3))
    above, differences = figure.add_subfigure(columns[0]), figure.add_subfigure(columns[1])
    left, rows = above.subplots(), differences.subplots(len(curves), 1, squeeze=False)[:, 0]
    draw_scene(left, scene)
    _widen(left, np.concatenate([recorded, replayed]))
    left.plot(recorded[:, 0], recorded[:, 1], color="#2c3e50", linewidth=3, alpha=0.35, label="recorded")
    left.plot(replayed[:, 0], replayed[:, 1], color=BAD, linewidth=1.1, label="replayed")
    left.plot(*recorded[0], marker="o", color="#2c3e50", markersize=5)
    left.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=2, frameon=False, fontsize=9)
    differences.supylabel("largest difference between replay and recording", fontsize=9)
    for row, (label, values) in enumerate(curves.items()):
        axes = rows[row]
        axes.plot(time, values, color=BAD, linewidth=1.3)
        axes.set_title(label, fontsize=9, loc="left")
        axes.grid(alpha=0.3)
        axes.tick_params(labelbottom=row == len(curves) - 1)
        if not np.any(values):
            axes.set_yticks([0.0])
            where = {"transform": axes.transAxes, "ha": "center", "color": GOOD}
            axes.text(0.5, 0.7, "identical, to the last bit", **where)
    axes.set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
