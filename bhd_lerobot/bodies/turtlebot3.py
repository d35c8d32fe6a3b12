"""TurtleBot3 Burger, with the source of every number.

Sources:

[manual]   ROBOTIS e-Manual, TurtleBot3, "Features: specifications": 0.22 m/s, 2.84 rad/s, 138 x 178 x 192 mm, 1 kg.
[urdf]     ROBOTIS `turtlebot3_description`, `turtlebot3_burger.urdf`: link masses and inertias, positions of wheels,
           caster, IMU and scanner, hull box, wheel radius 0.033 m, wheel separation 0.160 m. The URDF puts the chassis'
           centre of mass on the wheel axis, 10 mm above the floor, where the robot would rest on nothing; here it is an
           estimate, the middle of the hull at battery height. The scanner's inertia in the URDF (1e-3 kg m^2) is a
           placeholder, ten times that of a solid cylinder of its size; here it is the cylinder's.
[servo]    ROBOTIS e-Manual, XL430-W250: stall torque 1.4 N m at 11.1 V, the voltage of the robot's battery; 4096 pulses
           per revolution.
[lds]      ROBOTIS e-Manual, LDS-01: 0.12 to 3.5 m, 1 degree, 300 rpm. Noise: the manual's accuracy below 0.5 m is
           +-15 mm; 0.01 m is the standard deviation that ROBOTIS' own simulation uses.
[nav]      ROBOTIS `turtlebot3_navigation`, `dwa_local_planner_params_burger.yaml`: 2.5 m/s^2, 3.2 rad/s^2.

[camera]   Raspberry Pi, Camera Module 2: 62.2 x 48.8 degrees. The Burger is sold without one; where it sits and its
           tilt are ours.

Estimates of ours: servo gain, reflected rotor inertia (armature), tyre friction, and the deceleration of a stop, which
is what the tyres can carry (a yaw deceleration of 20 rad/s^2 needs 0.5 N at each tyre, and 3 N are there).
"""

from importlib import resources

from bhd_lerobot.bodies.body import Body, CameraSpec, Drive, LidarSpec, Limits

WHEEL_RADIUS = 0.033  # [m], [urdf]
WHEEL_SEPARATION = 0.160  # [m], [urdf]
MAX_LINEAR = 0.22  # [m/s], [manual]
MAX_ANGULAR = 2.84  # [rad/s], [manual]
LIDAR_BEAMS = 360  # [lds]
RANGE_MIN, RANGE_MAX = 0.12, 3.5  # [m], [lds]
SCANNER_AHEAD = -0.032  # [m] of the wheel axis, [urdf]
# [N m s/rad], an estimate: the base follows its wheels' command with a time constant of 11 ms, which is
# (mass * radius^2 / 2 + inertia of a wheel and its rotor) / gain. A stiffer servo is faster than a physics step of 5
# ms: the tyres' forces are then computed for a torque that the step does not deliver, and the robot rears up when it
# brakes.
SERVO_GAIN = 0.06


def turtlebot3_burger(
    *,
    lidar_noise_std: float = 0.01,
    command_timeout_s: float = 0.5,
    camera_width: int = 320,
    camera_height: int = 240,
) -> Body:
    """Return the Burger.

    Args:
        lidar_noise_std: standard deviation of the range noise [m]; 0 turns it off.
        command_timeout_s: age at which a command is no longer trusted [s].
        camera_width: width of the front camera's image [px].
        camera_height: height of the front camera's image [px].

    Raises:
        ConfigError: a value is out of range.
    """
    return Body(
        name="turtlebot3_burger",
        mjcf=resources.files(__package__).joinpath("turtlebot3_burger.xml").read_text(encoding="utf-8"),
        root="base",
        least_physics_hz=91,  # the servos' time constant is 11 ms, see SERVO_GAIN; in longer steps the base rocks
        drive=Drive(
            limits=Limits(
                names=("x.vel", "theta.vel"),
                velocity=(MAX_LINEAR, MAX_ANGULAR),
                acceleration=(2.5, 3.2),
                stop_deceleration=(2.5, 20.0),
                command_timeout_s=command_timeout_s,
            ),
            joints=("wheel_left", "wheel_right"),
            actuators=("wheel_left", "wheel_right"),
            wheel_radius=WHEEL_RADIUS,
            wheel_separation=WHEEL_SEPARATION,
            # Turning on the spot at the published limit needs this much; driving straight at 0.22 m/s needs less. The
            # published limits cannot be had both at once: where a twist needs more, the cerebellum keeps the turn and
            # takes forward speed away.
            max_wheel_speed=MAX_ANGULAR * WHEEL_SEPARATION / 2 / WHEEL_RADIUS,
            max_torque=1.4,
            servo_gain=SERVO_GAIN,
            encoder_ticks=4096,
            radius=0.124,  # the rear corners of the hull; the outer rims of the tyres are at 0.095 m
            height=0.192,
            outline=((-0.102, 0.038, 0.070), (-0.033, 0.033, 0.089)),  # hull and wheels, as in turtlebot3_burger.xml
        ),
        lidar=LidarSpec(
            site="lidar",
            beams=LIDAR_BEAMS,
            range_min=RANGE_MIN,
            range_max=RANGE_MAX,
            rate_hz=5,
            noise_std=lidar_noise_std,
            ahead=SCANNER_AHEAD,
        ),
        cameras={"front": CameraSpec("front", camera_width, camera_height)},
    )
