"""The mean effort of a control tick, beside the equation of motion."""

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.sim.world import World

RATES = ((500, 5), (500, 20), (1000, 2), (100, 1), (200, 2))  # physics steps a second, and in a tick
OTHERS = ("qfrc_bias", "qfrc_passive", "qfrc_constraint")


def command(world: World, rng: np.random.Generator) -> None:
    """Command something that saturates some servos and others not."""
    if world.body.arm is not None:
        joints = len(world.body.arm.chain.joints)
        world.ctrl[:, :joints] = world.qpos[:, :joints] + rng.normal(0.0, 0.005, (world.n, joints))
    else:
        world.ctrl[:] = rng.uniform(-40.0, 40.0, world.ctrl.shape)


def acted(world: World, model: mujoco.MjModel, velocity: np.ndarray) -> np.ndarray:
    """Return what the motors put on the joints in the step before, by the equation of motion, shape (nv,)."""
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = velocity[: model.nq]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_crb(model, data)
    mujoco.mj_fullM(model, data, inertia)
    change = (world.qvel[0] - velocity[model.nq :]) / model.opt.timestep
    bias, *others = (world.derived(name)[0] for name in OTHERS)
    return inertia @ change + bias - sum(others)


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize("body", [ur5(), turtlebot3_burger()], ids=lambda body: body.name)
@pytest.mark.parametrize(("physics_hz", "steps"), RATES)
def test_the_mean_effort_is_what_changed_the_momentum(body, physics_hz: int, steps: int) -> None:
    world, rng = World(body, physics_hz=physics_hz), np.random.default_rng(0)
    model, efforts, given = world.copy_model(0), world.efforts, []
    for name in (*OTHERS, "actuator_force"):
        world.derived(name)  # from now on
    before, saturated = np.concatenate((world.qpos[0], world.qvel[0])), 0

    def note() -> None:
        nonlocal before, saturated
        force = np.abs(world.derived("actuator_force")[0])
        saturated += int((force >= model.actuator_forcerange[:, 1]).sum())
        given.append(acted(world, model, before))
        before = np.concatenate((world.qpos[0], world.qvel[0]))

    joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    servos = model.jnt_dofadr[joints]
    for _ in range(40):
        command(world, rng)
        given.clear()
        world.step(steps, each=note)
        np.testing.assert_allclose(efforts[0, servos], np.mean(given, axis=0)[servos], atol=1e-6)
    assert 0 < saturated < 40 * steps * model.nu


def test_a_single_step_at_the_usual_rate_reports_what_mujoco_does() -> None:
    world, rng = World(ur5(), 2), np.random.default_rng(0)
    for _ in range(20):
        command(world, rng)
        world.step()
        np.testing.assert_array_equal(world.efforts, world.derived("qfrc_actuator"))


def test_each_simulation_has_its_own_mean() -> None:
    """Whatever others do: a simulation that is not stepped keeps its mean, and one that is reset forgets it."""
    together, alone = World(ur5(), 3), World(ur5())
    for world in (together, alone):
        assert world.efforts.shape == (world.n, world.model.nv)
        world.ctrl[:, :6] += 0.003
        world.step(5)
    np.testing.assert_array_equal(together.efforts, np.repeat(alone.efforts, 3, axis=0))
    kept = alone.efforts.copy()
    together.step(5, [1])
    alone.step(5)
    np.testing.assert_array_equal(together.efforts[[0, 2]], np.repeat(kept, 2, axis=0))
    np.testing.assert_array_equal(together.efforts[1:2], alone.efforts)
    together.reset([2])
    np.testing.assert_array_equal(together.efforts[:2], np.concatenate((kept, alone.efforts)))
    alone.reset()
    np.testing.assert_array_equal(together.efforts[2], alone.efforts[0])
