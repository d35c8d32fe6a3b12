"""What every scene has behind it: a sky and the pattern of a floor."""

from bhd_lerobot.sim.engine import mujoco

Colour = tuple[float, float, float]


def add_backdrop(spec: mujoco.MjSpec, sky: tuple[Colour, Colour], floor: tuple[Colour, Colour]) -> None:
    """Add the sky, and the material ``"stage_floor"``: a robot's file may have names like ours."""
    spec.add_texture(
        name="stage_sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=list(sky[0]),
        rgb2=list(sky[1]),
        width=64,
        height=384,
    )
    spec.add_texture(
        name="stage_floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=list(floor[0]),
        rgb2=list(floor[1]),
        width=128,
        height=128,
    )
    material = spec.add_material(name="stage_floor", texrepeat=[2, 2], texuniform=True, specular=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "stage_floor"
