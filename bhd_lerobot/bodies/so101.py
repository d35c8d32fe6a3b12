"""SO-101 follower arm, with the source of every number.

Sources:

[cad]      TheRobotStudio, SO-ARM100 repository, the SO-101's URDF of the "new calibration": where the joints are, their
           ranges, masses of the links. What is along a joint's own axis is left out.
[servo]    Feetech, STS3215 data sheet, 12 V: 30 kg cm (2.94 N m) of stall torque, 45 rpm without a load, 55 g; at 7.4 V
           19.5 kg cm (1.9 N m).
[ident]    The same repository, parameters of the STS3215 behind LeRobot's gains (P = 16, D = 32): 17.8 N m/rad, joint
           damping 0.60 N m s/rad, friction 0.052 N m, reflected rotor inertia 0.028 kg m^2.

Estimates of ours: the links' outlines and with them their inertias; the largest speed, which is half of that without a
load; the friction of the pads; the jaw's opening, as the arc of its finger tip, which is within 3 mm of the distance
between the pads. The servos' backlash of about 1 degree is left out. The simulated servos carry the arm's weight by
themselves; those of a real arm give way to it by up to 0.1 rad.
"""

from importlib import resources

from bhd_lerobot.bodies.arm_file import ArmFile, GripperFile

SO101 = ArmFile(
    name="so101",
    path=str(resources.files(__package__).joinpath("so101.xml")),
    tool="gripper_frame",
    # As far as the pads are above each other there: farther open the jaw goes on to 1.745 rad.
    gripper=GripperFile(name="gripper", closed=-0.1745, open=0.85, opening=0.073),
    velocity=(2.4,),
    payload=0.25,
)

# LeRobot's calibration reads 0 where the jaw is closed, and 100 at the other end of its range [cad].
JAW_READINGS = [[0.0, 0.0], [100 * (0.85 + 0.1745) / (1.745 + 0.1745), 0.073]]
"""Two readings of LeRobot's ``gripper``, and the openings that they mean [m]."""
