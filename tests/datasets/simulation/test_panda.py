"""Panda model: published parameters, wrist sensor and impedance controller."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.simulation.controller import HandController
from beliefscope.datasets.simulation.door import IMPEDANCE, door_model
from beliefscope.datasets.simulation.door_physics import HINGE_CENTRE, DoorPhysics
from beliefscope.datasets.simulation.panda import ARM_JOINTS, GRIP_OFFSET
from beliefscope.datasets.simulation.sensors import HandSensors

FREE = np.array([0.45, 0.1, 0.6])  # far from all objects


@pytest.fixture
def scene() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = door_model(DoorPhysics(HINGE_CENTRE, 0.62))
    return model, mujoco.MjData(model)


def hold(model: mujoco.MjModel, data: mujoco.MjData, at: NDArray[np.float64], seconds: float = 1.0) -> HandController:
    controller = HandController(model, data, IMPEDANCE)
    controller.place(at, 0.0)
    mujoco.mj_forward(model, data)
    for _ in range(round(seconds / 0.1)):
        controller.command(at, 0.0)
        mujoco.mj_step(model, data, 25)
    return controller


def test_forward_kinematics_match_published_values(scene: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, data = scene
    data.qpos[:7] = (-1.609, -0.615, 1.696, -1.627, 1.782, 3.228, -0.498)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("hand").xpos, (0.582, 0.162, 0.633), atol=1e-3)
    along = data.body("hand").xmat.reshape(3, 3)[:, 2]
    assert along @ (1, 0, 0) > 0.99, "the hand points along +x"


def test_joint_limits_efforts_and_mass(scene: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, _ = scene
    assert [model.joint(name).range[1] for name in ARM_JOINTS] == pytest.approx(
        [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    )
    assert model.jnt_actfrcrange[:7, 1].tolist() == [87, 87, 87, 87, 12, 12, 12]
    assert model.body_subtreemass[model.body("link1").id] == pytest.approx(16.06 + 0.83, abs=0.01)


@pytest.mark.parametrize("yaw", [0.0, 0.35, 0.7])
@pytest.mark.parametrize("position", [(0.725, 0.14, 0.62), (0.39, -0.365, 0.55), (0.5, -0.45, 0.69)])
def test_place_reaches_the_arc_of_the_bar(
    scene: tuple[mujoco.MjModel, mujoco.MjData], position: tuple[float, float, float], yaw: float
) -> None:
    model, data = scene
    controller = HandController(model, data, IMPEDANCE)
    assert controller.place(np.array(position), yaw) < 1e-4
    np.testing.assert_allclose(controller.position, position, atol=1e-4)
    hand = data.body("hand").xmat.reshape(3, 3)
    np.testing.assert_allclose(hand[:, 2], (np.cos(yaw), np.sin(yaw), 0), atol=1e-4)
    np.testing.assert_allclose(hand[:, 1], (0, 0, -1), atol=1e-4)
    assert np.linalg.norm(controller.position - data.body("hand").xpos) == pytest.approx(GRIP_OFFSET)


def test_wrench_is_zero_at_rest(scene: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, data = scene
    hold(model, data, FREE)
    np.testing.assert_allclose(HandSensors(model, data).wrench(), 0, atol=0.02)
    assert not HandSensors(model, data).touching()


@pytest.mark.parametrize("force", [(20.0, 0.0, 0.0), (0.0, -15.0, 0.0), (0.0, 0.0, 10.0)])
def test_wrench_of_an_external_force(
    scene: tuple[mujoco.MjModel, mujoco.MjData], force: tuple[float, float, float]
) -> None:
    model, data = scene
    controller = hold(model, data, FREE, 0.2)
    hand, wrist = model.body("hand").id, model.site("wrist").id
    data.xfrc_applied[hand, :3] = force  # applied at the hand's centre of mass
    for _ in range(30):
        controller.command(FREE, 0.0)
        mujoco.mj_step(model, data, 25)
    wrench = HandSensors(model, data).wrench()
    np.testing.assert_allclose(wrench[:3], force, atol=0.2)
    lever = data.xipos[hand] - data.site_xpos[wrist]
    np.testing.assert_allclose(wrench[3:], np.cross(lever, force), atol=0.02)


def test_hand_has_the_requested_stiffness(scene: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, data = scene
    controller = hold(model, data, FREE)
    start = controller.position
    data.xfrc_applied[model.body("hand").id, 0] = 20.0
    for _ in range(50):
        controller.command(FREE, 0.0)
        mujoco.mj_step(model, data, 25)
    # The tolerance covers the tilt of the hand.
    assert controller.position[0] - start[0] == pytest.approx(20.0 / IMPEDANCE.stiffness[0], rel=0.25)


def test_lead_of_the_set_point_is_limited(scene: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    model, data = scene
    controller = hold(model, data, FREE, 0.1)
    set_point = controller.command(FREE + 1.0, 0.0)
    assert np.linalg.norm(set_point - controller.position) == pytest.approx(IMPEDANCE.lead)
