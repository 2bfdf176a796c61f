"""The door's geometry and physics, and what a simulated trajectory must obey."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.controller import HandController
from beliefscope.datasets.simulation.door import (
    DOOR,
    IMPEDANCE,
    MAX_ANGLE,
    DoorPhysics,
    door_model,
    panel_ghost,
    policy_of,
    simulate_door,
)
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.sensors import HandSensors
from beliefscope.datasets.simulation.simulate import hand_controls, quantise, split_of

STEPS = 60
PHYSICS = DoorPhysics((0.8, -0.3), 0.6)


@pytest.fixture(scope="module")
def pull() -> Episode:
    return simulate_door(7, 0, STEPS)


@pytest.fixture(scope="module")
def push() -> Episode:
    return simulate_door(7, 1, STEPS)


@pytest.fixture(params=["pull", "push"])
def episode(request: pytest.FixtureRequest) -> Episode:
    found: Episode = request.getfixturevalue(request.param)
    assert found.provenance["policy"] == request.param
    return found


def set_door(model: mujoco.MjModel, angle: float) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.joint("door").qpos[:] = angle
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.5])
def test_bar_and_ghost_are_where_the_simulated_door_is(angle: float) -> None:
    model = door_model(PHYSICS)
    data = set_door(model, angle)
    middle = PHYSICS.bar_point(angle, 0.33)
    np.testing.assert_allclose(data.geom("bar").xpos, middle, atol=1e-9)
    ghost = panel_ghost([*PHYSICS.hinge, angle])
    np.testing.assert_allclose(ghost.position, data.geom("panel").xpos, atol=1e-9)
    np.testing.assert_allclose(ghost.wxyz, data.body("door").xquat, atol=1e-9)
    np.testing.assert_allclose(np.array(ghost.size) / 2, model.geom("panel").size, atol=1e-9)
    np.testing.assert_allclose(ghost.anchor[:2], PHYSICS.hinge)


def test_ghosts_come_in_any_batch() -> None:
    states = np.random.default_rng(0).normal(size=(4, 5, 3))
    ghost = panel_ghost(states)
    assert ghost.position.shape == (4, 5, 3)
    assert ghost.wxyz.shape == (4, 5, 4)
    np.testing.assert_allclose(ghost.position[2, 3], panel_ghost(states[2, 3]).position)


def test_a_moving_door_loses_energy_and_stops() -> None:
    model = door_model(PHYSICS)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = set_door(model, 1.2)
    HandController(model, data, IMPEDANCE).place(np.array([0.3, 0.3, 0.6]), 0.0)
    data.joint("door").qvel[:] = -3.0
    speed = [3.0]
    for _ in range(200):
        mujoco.mj_step(model, data)
        speed.append(abs(float(data.joint("door").qvel[0])))
    assert (np.diff(speed) <= 1e-9).all(), "nothing drives it"
    assert speed[-1] < 1e-3


def test_the_spring_opens_the_door_and_friction_stops_it() -> None:
    model = door_model(DoorPhysics((0.8, -0.3), 0.6, spring=1.6))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = set_door(model, 0.2)
    HandController(model, data, IMPEDANCE).place(np.array([0.3, 0.3, 0.6]), 0.0)
    mujoco.mj_step(model, data, 10000)
    # Where the spring no longer beats the friction: 2.0 rad - 1.5 N m / 1.6 N m/rad.
    assert float(data.joint("door").qpos[0]) == pytest.approx(2.0 - 1.5 / 1.6, abs=0.05)


def test_the_wrist_feels_what_the_door_does_to_the_hand() -> None:
    """Newton's third law: pressing the closed door at rest, the wrist's force is the contact's."""
    model = door_model(PHYSICS)
    data = mujoco.MjData(model)
    controller, sensors = HandController(model, data, IMPEDANCE), HandSensors(model, data)
    touching_point = PHYSICS.bar_point(0.0, 0.33) - (0.05, 0, 0)
    controller.place(touching_point, 0.0)
    mujoco.mj_forward(model, data)
    for _ in range(40):
        controller.command(PHYSICS.bar_point(0.0, 0.33), 0.0)
        mujoco.mj_step(model, data, 25)
    mujoco.mj_forward(model, data)
    assert sensors.touching()
    hand_geoms = {g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == model.body("link0").id}
    total = np.zeros(3)
    for i in range(data.ncon):
        contact, wrench = data.contact[i], np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        # mj_contactForce is the force on the second geom, along axes whose first is the normal from first to second.
        total += (1 if contact.geom2 in hand_geoms else -1) * contact.frame.reshape(3, 3).T @ wrench[:3]
    force = sensors.wrench()[:3]
    np.testing.assert_allclose(force, total, atol=0.1)
    assert force[0] < -20, "the door pushes back, towards the robot"


def test_states_are_the_replays(episode: Episode) -> None:
    shown = replay(DOOR, episode)
    assert shown is not None
    model = shown.model
    door, panel = model.body("door").id, model.geom("panel").id
    np.testing.assert_allclose(shown.positions[:, door, :2], episode.states[:, :2], atol=1e-7)
    np.testing.assert_array_equal(episode.states[:, 2], episode.qpos[:, model.joint("door").qposadr[0]])
    centre = shown.positions[:, door] + shown.rotations[:, door] @ model.geom_pos[panel]
    np.testing.assert_allclose(centre, panel_ghost(episode.states).position, atol=1e-6)
    hand = shown.positions[:, model.body("hand").id] + shown.rotations[:, model.body("hand").id, :, 2] * 0.1034
    np.testing.assert_allclose(hand, episode.observations["effector_position"], atol=5e-4)


def test_hinge_is_constant_and_angle_stays_in_range(episode: Episode) -> None:
    assert np.ptp(episode.states[:, :2], axis=0).tolist() == [0, 0]
    assert episode.states[:, 2].min() > -0.02
    assert episode.states[:, 2].max() < MAX_ANGLE + 0.02
    assert np.ptp(episode.states[:, 2]) > 0.05, "the door moves"


def test_contact_is_where_the_force_is(push: Episode) -> None:
    force = np.linalg.norm(push.observations["force"], axis=1)
    # Out of contact only the hand's own inertia is left; in the step after a contact it may still swing.
    free = ~push.contact & ~np.concatenate([[True], push.contact[:-1]])
    assert free.sum() > 10
    assert force[free].max() < 3.0
    assert np.median(force[push.contact]) > 5.0


def test_a_held_bar_is_always_in_contact_and_stays_in_the_hand(pull: Episode) -> None:
    assert pull.contact.all()
    radius = np.linalg.norm(pull.observations["effector_position"][:, :2] - pull.states[:, :2], axis=1)
    assert np.ptp(radius) < 0.02


def test_who_closes_the_door_is_pushed_back(push: Episode) -> None:
    angle = push.states[:, 2]
    outward = -np.stack([np.cos(angle), np.sin(angle)], axis=1)
    back = (push.observations["force"][:, :2] * outward).sum(1)
    closing = np.diff(angle, prepend=angle[0]) < -0.005
    assert closing.sum() >= 2
    assert (back[closing] > 5.0).all()


def test_touch_is_sensed_where_there_is_contact(episode: Episode) -> None:
    np.testing.assert_array_equal(episode.observations["contact"][:, 0], episode.contact)


def test_controls_are_the_hands_last_place_its_move_and_touch(episode: Episode) -> None:
    position, touch = episode.observations["effector_position"], episode.observations["contact"]
    np.testing.assert_array_equal(episode.controls, hand_controls(position, touch))
    np.testing.assert_array_equal(episode.controls[1:, :3], position[:-1])
    np.testing.assert_array_equal(episode.controls[0], [*position[0], 0, 0, 0, *touch[0]])


def test_arrays_are_as_the_task_says(episode: Episode) -> None:
    assert episode.states.shape == (STEPS, len(DOOR.components))
    assert episode.controls.shape == (STEPS, DOOR.control_size)
    for key, shape in DOOR.observations.items():
        assert episode.observations[key].shape == (STEPS, *shape), key
    floats = [episode.states, episode.controls, episode.qpos, *list(episode.observations.values())[1:]]
    assert {a.dtype for a in floats} == {np.dtype(np.float32)}
    assert all(np.isfinite(a).all() for a in floats)
    assert episode.observations["image"].dtype == np.uint8


def test_same_seed_same_trajectory_and_another_index_another() -> None:
    assert simulate_door(3, 2, 5).digest() == simulate_door(3, 2, 5).digest()
    assert simulate_door(3, 2, 5).digest() != simulate_door(3, 4, 5).digest()
    assert simulate_door(3, 2, 5).digest() != simulate_door(4, 2, 5).digest()


def test_a_longer_trajectory_begins_like_a_shorter_one() -> None:
    short, long = simulate_door(3, 1, 5), simulate_door(3, 1, 9)
    np.testing.assert_array_equal(short.qpos, long.qpos[:5])


def test_every_split_holds_both_policies_equally() -> None:
    indices = range(200)
    assert {s: sum(split_of(i) == s for i in indices) for s in ("train", "val", "test")} == {
        "train": 160,
        "val": 20,
        "test": 20,
    }
    for split in ("train", "val", "test"):
        policies = [policy_of(i) for i in indices if split_of(i) == split]
        assert policies.count("pull") == policies.count("push")


def test_quantise_rounds_to_powers_of_two() -> None:
    np.testing.assert_array_equal(quantise(np.array([0.3, -0.3]), 2), np.float32([0.25, -0.25]))


def test_replay_refuses_a_door_it_cannot_build(pull: Episode) -> None:
    with pytest.raises(BadInput, match="does not describe its door"):
        replay(DOOR, dataclasses.replace(pull, provenance={"hinge": [0.8]}))


def test_replay_refuses_other_joints(pull: Episode) -> None:
    with pytest.raises(BadInput, match=r"has 4 joint positions a step; the model of task 'door' has 10"):
        replay(DOOR, dataclasses.replace(pull, qpos=pull.qpos[:, :4]))


def test_no_joints_no_replay(pull: Episode) -> None:
    assert replay(DOOR, dataclasses.replace(pull, qpos=pull.qpos[:, :0])) is None
