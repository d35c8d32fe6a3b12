"""Arms as MJCF documents that no one could mistake for a Denavit-Hartenberg chain."""

import numpy as np


def serial(joints: int, seed: int = 0, *, degree: bool = False, ref: bool = False, extra: str = "") -> str:
    """Return an arm with oblique axes, joints beside their bodies' origins, and a tool with a rotation of its own.

    Args:
        joints: how many.
        degree: the document's angles are degrees.
        ref: joints have a reference that is not 0.
        extra: elements of the document that follow the world.
    """
    rng = np.random.default_rng(seed)
    unit = 180 / np.pi if degree else 1.0

    def three(scale: float) -> str:
        return " ".join(f"{value:.5f}" for value in rng.uniform(-scale, scale, 3))

    def place(ahead: float) -> str:
        return f'pos="{rng.uniform(-0.05, 0.05):.5f} 0.02 {ahead}" euler="{three(0.6 * unit)}"'

    bodies, inertia = "", '<inertial pos="0.01 0.02 0.03" mass="1.2" fullinertia="0.02 0.03 0.025 0.001 0.002 0.003"/>'
    for number in range(joints):
        axis = np.eye(3)[(2, 1, 1, 0, 1, 2, 0)[number]] + rng.uniform(-0.4, 0.4, 3)
        reference = f'ref="{rng.uniform(-0.5, 0.5) * unit:.5f}"' if ref else ""
        half = (2.0 + rng.uniform(0.0, 0.9)) * unit
        bodies += (
            f'<body name="link_{number}" {place(0.18 if number else 0.1)}>'
            f'<joint name="joint_{number}" pos="{three(0.03)}" axis="{" ".join(map(str, axis))}" '
            f'range="{-half:.5f} {half:.5f}" armature="0.01" {reference}/>{inertia}'
            f'<geom name="shell_{number}" type="capsule" fromto="0 0 0 0 0 0.12" size="0.03"/>'
        )
    finger = (
        '<body name="finger" pos="0 0.02 0.1"><joint name="finger" type="slide" axis="0 1 0" range="0 0.04"/>'
        '<inertial pos="0 0 0.02" mass="0.05" diaginertia="1e-4 1e-4 1e-4"/>'
        '<geom type="box" size="0.005 0.005 0.03"/></body>'
    )
    site = f'<site name="tool" pos="{three(0.05)}" euler="{three(0.8 * unit)}"/>'
    hand = f'<body name="hand" {place(0.12)}>{finger}{site}</body>'
    return (
        f'<mujoco><compiler angle="{"degree" if degree else "radian"}" autolimits="true"/>'
        '<worldbody><light pos="0 0 3"/><geom type="plane" size="2 2 0.1"/>'
        f'<body name="mount" {place(0.0)}>{bodies}{hand}{"</body>" * joints}</body></worldbody>{extra}</mujoco>'
    )
