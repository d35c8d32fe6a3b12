"""A base on two driven wheels, made of a few numbers: for robots of which there is no model."""

from bhd_lerobot.bodies.body import Body, CameraSpec, Drive, LidarSpec, Limits
from bhd_lerobot.errors import ConfigError

_TYRE = 0.009  # [m] half the width of a wheel
_CASTER = 0.010  # [m] radius of the casters, on which the ends slide
_CASTER_CLEARANCE = 0.0005  # [m] under each of them when the robot stands on its wheels alone
_WHEEL_KG = 0.03
_LIDAR_OVER = 0.02  # [m] of the lidar over the hull
# The TurtleBot3 Burger's [N m s/rad], for 1 kg on wheels of 0.033 m: the inertia that a wheel has to move, over the
# longest physics step that it is stable at.
_SERVO_GAIN, _SERVO_TORQUE = 0.06, 1.4

_MJCF = """
<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <default>
    <default class="tyre">
      <geom type="ellipsoid" size="{r} {r} {tyre}" euler="1.5707963267948966 0 0" contype="0" conaffinity="3"
            friction="0.9 0.005 0.0001" group="3" mass="0"/>
    </default>
    <default class="caster">
      <geom type="sphere" size="{caster}" contype="0" conaffinity="1" condim="1" priority="1" group="3" mass="0.005"/>
    </default>
    <default class="rim">
      <geom type="cylinder" size="{r} {tyre}" euler="1.5707963267948966 0 0" contype="0" conaffinity="0" group="1"
            mass="0" rgba="0.1 0.1 0.1 1"/>
    </default>
  </default>
  <worldbody>
    <body name="base">
      <freejoint name="base"/>
      <geom name="hull" type="box" size="{half_x} {half_y} {half_z}" pos="{x} 0 {z}" contype="0" conaffinity="2"
            mass="{mass}" rgba="{colour} 1"/>
      <geom type="box" size="0.012 {half_y} {half_z}" pos="{nose} 0 {z}" contype="0" conaffinity="0" group="1" mass="0"
            rgba="0.95 0.85 0.2 1"/>
      <geom name="caster_rear" class="caster" pos="-{caster_x} 0 {caster_z}"/>
      <geom name="caster_front" class="caster" pos="{caster_x} 0 {caster_z}"/>
      <site name="imu" pos="{x} 0 {z}"/>
      <site name="lidar" pos="{x} 0 {lidar_z}"/>
      <geom type="cylinder" size="0.03 0.015" pos="{x} 0 {lidar_z}" contype="0" conaffinity="0" group="1" mass="0"
            rgba="0.05 0.05 0.06 1"/>
      <camera name="front" pos="{front} 0 {camera_z}" xyaxes="0 -1 0 0.1736 0 0.9848" fovy="48.8"/>
      <body name="wheel_left" pos="0 {half_track} {r}">
        <inertial pos="0 0 0" mass="{wheel}" diaginertia="{i_x} {i_y} {i_x}"/>
        <joint name="wheel_left" type="hinge" axis="0 1 0" armature="1e-4"/>
        <geom name="tyre_left" class="tyre"/>
        <geom class="rim"/>
      </body>
      <body name="wheel_right" pos="0 -{half_track} {r}">
        <inertial pos="0 0 0" mass="{wheel}" diaginertia="{i_x} {i_y} {i_x}"/>
        <joint name="wheel_right" type="hinge" axis="0 1 0" armature="1e-4"/>
        <geom name="tyre_right" class="tyre"/>
        <geom class="rim"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="wheel_left" joint="wheel_left" kv="{gain}" forcerange="-{torque} {torque}"/>
    <velocity name="wheel_right" joint="wheel_right" kv="{gain}" forcerange="-{torque} {torque}"/>
  </actuator>
  <sensor>
    <gyro name="imu_gyro" site="imu"/>
    <accelerometer name="imu_accelerometer" site="imu"/>
    <jointpos name="encoder_left" joint="wheel_left"/>
    <jointpos name="encoder_right" joint="wheel_right"/>
    <jointvel name="speed_left" joint="wheel_left"/>
    <jointvel name="speed_right" joint="wheel_right"/>
  </sensor>
</mujoco>
"""


def differential_base(
    name: str,
    *,
    wheel_radius: float,
    wheel_separation: float,
    size: tuple[float, float, float],
    mass: float,
    max_velocity: tuple[float, float],
    colour: tuple[float, float, float] = (0.2, 0.45, 0.85),
    lidar_noise_std: float = 0.01,
    command_timeout_s: float = 0.5,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return a box on two wheels in its middle and a caster at either end, with a lidar on top and a camera in front.

    Args:
        name: of the body.
        wheel_radius: rolling radius [m].
        wheel_separation: distance between the contact points [m]; the wheels are outside of the box.
        size: of the box: length, width, height [m].
        mass: of all but the wheels [kg].
        max_velocity: forward [m/s], and turning [rad/s].
        colour: of the box: red, green, blue, from 0 to 1.
        lidar_noise_std: standard deviation of the range noise [m]; 0 turns it off.
        command_timeout_s: age at which a command is no longer trusted [s].
        camera_width: width of the front camera's image [px].
        camera_height: height of the front camera's image [px].

    Raises:
        ConfigError: a number is not positive, or the wheels are inside of the box.
    """
    length, width, height = size
    for what, value in (
        *(("wheel_radius", wheel_radius), ("wheel_separation", wheel_separation), ("mass", mass)),
        *(("size", value) for value in size),
    ):
        if not 0 < value < float("inf"):
            raise ConfigError(f"{what} of the base {name!r} is {value}; it must be positive and finite.")
    if wheel_separation / 2 - _TYRE < width / 2:
        raise ConfigError(
            f"wheel_separation of the base {name!r} is {wheel_separation}; with wheels of {2 * _TYRE} m beside a box "
            f"of {width} m it must be at least {width + 2 * _TYRE:.3f}."
        )
    half_track, ground = wheel_separation / 2, 2 * _CASTER
    top = ground + height
    inertia = _WHEEL_KG * wheel_radius**2
    scale = mass * (wheel_radius / 0.033) ** 2
    mjcf = _MJCF.format(
        name=name, r=wheel_radius, tyre=_TYRE, half_x=length / 2, half_y=width / 2, half_z=height / 2, x=0.0,
        z=ground + height / 2, mass=mass, colour=" ".join(map(str, colour)), nose=length / 2 - 0.012, caster=_CASTER,
        caster_x=length / 2 - _CASTER, caster_z=_CASTER + _CASTER_CLEARANCE, lidar_z=top + _LIDAR_OVER,
        front=length / 2 + 0.002, camera_z=ground + 0.7 * height, half_track=half_track, wheel=_WHEEL_KG,
        i_x=inertia / 4, i_y=inertia / 2, gain=_SERVO_GAIN * scale, torque=_SERVO_TORQUE * scale,
    )  # fmt: skip
    rim = max(max_velocity[0], max_velocity[1] * half_track)
    return Body(
        name=name,
        mjcf=mjcf,
        root="base",
        least_physics_hz=91,  # the servos' time constant is 11 ms, see _SERVO_GAIN; in longer steps the base rocks
        drive=Drive(
            limits=Limits(
                names=("x.vel", "theta.vel"),
                velocity=max_velocity,
                acceleration=(2.5, 3.2),
                stop_deceleration=(2.5, 20.0),
                command_timeout_s=command_timeout_s,
            ),
            joints=("wheel_left", "wheel_right"),
            actuators=("wheel_left", "wheel_right"),
            wheel_radius=wheel_radius,
            wheel_separation=wheel_separation,
            max_wheel_speed=rim / wheel_radius,
            max_torque=_SERVO_TORQUE * scale,
            servo_gain=_SERVO_GAIN * scale,
            encoder_ticks=4096,
            radius=float((max(length / 2, wheel_radius) ** 2 + (half_track + _TYRE) ** 2) ** 0.5),
            height=top + 2 * _LIDAR_OVER,
            outline=(
                (-length / 2, length / 2, width / 2),
                (-wheel_radius, wheel_radius, half_track + _TYRE),
            ),
        ),
        lidar=LidarSpec(site="lidar", beams=360, range_min=0.12, range_max=3.5, rate_hz=5, noise_std=lidar_noise_std),
        cameras={"front": CameraSpec("front", camera_width, camera_height)},
    )
