"""What is understood of an arm: its chain, limits, servos, tool, gripper and workspace, and a picture of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots.config import RobotConfig
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from bhd_lerobot.apps.doctor.identify import excite, for_identification, identify, servo_option, servo_table
from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.bodies.registry import BODIES, parts_of_type
from bhd_lerobot.control.geometry.capsules import left_out
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.errors import ConfigError, RenderingError
from bhd_lerobot.stock import make_robot_from_config

_SIZE = 640, 480  # [px] of the picture


@dataclass
class RobotDescription:
    """Options of `bhd-doctor --robot.type=…`.

    Attributes:
        robot: the arm.
        picture: where a picture of it is written.
        identify: move its joints a little about home, and print the servos that it has; nothing else.
    """

    robot: RobotConfig
    picture: Path = Path("robot.png")
    identify: bool = False

    def __post_init__(self) -> None:
        self.picture = self.picture.expanduser()


def describe_robot(config: RobotDescription, console: Console) -> None:
    """Print what is understood of an arm, and write a picture of it.

    Raises:
        ConfigError: the robot is no arm of this package, its file has to be explained, or the picture's place or format
            is not valid.
    """
    made: Any = config.robot
    if not hasattr(made, "body") or (body := made.body()).arm is None:
        arms = ", ".join(sorted(name for name in BODIES if Arm in parts_of_type(name)))
        raise ConfigError(f"robot.type is {made.type!r}; bhd-doctor describes arms: {arms}.")
    if config.identify:
        _identify(made, console)
        return
    arm = body.need(Arm)
    console.print(_joints(arm))
    for name, text in _facts(body, arm).items():
        console.print(f"{name + ':':<16}{text}", highlight=False, soft_wrap=True)
    try:
        _draw(body, config.picture)
    except RenderingError as error:
        console.print(f"{'picture:':<16}none: {error}", highlight=False, soft_wrap=True)
    else:
        console.print(f"{'picture:':<16}{config.picture}", highlight=False, soft_wrap=True)


def _identify(config: Any, console: Console) -> None:
    """Connect an arm, move it, and print the servos that it has."""
    robot: Any = make_robot_from_config(for_identification(config))
    robot.connect()
    try:
        with console.status("Moving each joint by 0.1 rad about home …"):
            found = {track.joint: identify(robot.body, track) for track in list(excite(robot.host))}
    finally:
        robot.disconnect()
    console.print(servo_table(robot.body, found))
    console.print(servo_option(robot.body, found), highlight=False, soft_wrap=True)


def _joints(arm: Arm) -> Table:
    limits = arm.limits
    table = Table(title="joints, in rad, m, s, N and N m", title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in ("", "range", "home", "speed", "acc.", "effort", "stiffness", "damping"):
        table.add_column(heading, overflow="fold", no_wrap=True)
    for number, name in enumerate(limits.names):
        table.add_row(
            name.removesuffix(".pos"),
            f"{limits.lower[number]:.2f} … {limits.upper[number]:.2f}",
            *(f"{values[number]:.3g}" for values in (arm.home, limits.velocity, limits.acceleration, limits.effort)),
            f"{arm.servo_stiffness[number]:.4g}",
            f"{arm.servo_damping[number] + 0.0:.3g}",
        )
    return table


def _facts(body: Body, arm: Arm) -> dict[str, str]:
    """Return what else is known, by its name."""
    chain, grip, space = arm.chain, arm.gripper, arm.workspace
    masses = [inertia.mass for inertia in ArmDynamics(body).model.inertias[1:]]
    x, y, z = chain.tool.position
    low, high = (np.round(corner, 3).tolist() for corner in space.tool)
    left, right = (np.round(corner, 3).tolist() for corner in space.table)
    gripper = "none"
    if grip is not None:
        ends = zip(grip.joints, grip.closed, grip.opened, strict=True)
        moves = ", ".join(f"{name} from {closed:.4g} (closed) to {opened:.4g} (open)" for name, closed, opened in ends)
        gripper = f"opens by {grip.max_opening:.3f} m; {moves}"
    without = [f"{one} – {other}" for one, other in left_out(chain)]
    return {
        "tool": f"({x:.4f}, {y:.4f}, {z:.4f}) m in the frame of {chain.joints[-1]}",
        "gripper": gripper,
        "moving mass": f"{sum(masses):.3f} kg; carries {arm.payload:.3g} kg",
        "reach": f"{chain.reach:.3f} m stretched out; on the table, pointing down, {space.reach:.3f} m",
        "workspace": f"tool within {low} … {high} m; objects within {left} … {right} m",
        "collisions": f"{len(chain.capsules)} capsules, {len(chain.disjoint)} pairs, {chain.min_distance} m apart",
        "pairs left out": f"{len(without)}: {', '.join(without)}" if without else "none but those of neighbours",
        **_base(body),
        "rates": f"physics at {body.least_physics_hz} Hz or more, control at {body.least_control_hz} Hz or more",
    }


def _base(body: Body) -> dict[str, str]:
    """Return what is known of the base that an arm is on."""
    if (drive := body.drive) is None or (lidar := body.lidar) is None:
        return {}
    forward, turn = drive.limits.velocity
    wheels = f"wheels of {drive.wheel_radius:g} m, {drive.wheel_separation:g} m apart"
    return {
        "base": f"up to {forward:g} m/s and {turn:g} rad/s, radius {drive.radius:g} m; {wheels}",
        "lidar": f"{lidar.beams} beams, {lidar.range_min:g} to {lidar.range_max:g} m, {lidar.rate_hz} Hz",
    }


def _draw(body: Body, picture: Path) -> None:
    """Write a picture of the robot at home."""
    from PIL import Image

    from bhd_lerobot.sim.camera import Camera
    from bhd_lerobot.sim.world import World

    world = World(body)
    # The camera is made for arms that reach as far as a UR5.
    view = "overview" if body.drive is None else "follow"
    world.model_field("cam_fovy")[:, world.model.camera(view).id] *= min(1.0, body.need(Arm).chain.reach)
    camera = Camera(world, *_SIZE)
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(camera.render(0, view)).save(picture)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"picture is {str(picture)!r}, which cannot be written: {error}. Name a .png file."
        ) from error
    finally:
        camera.close()
