"""Field tasks: every ingredient acts, can be switched off alone, and is recorded; controls reveal no measurement."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import beliefscope
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.simulation import door_field, push_field
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.door_field import DOOR_FIELD, simulate_door_field
from beliefscope.datasets.simulation.ingredients import draw
from beliefscope.datasets.simulation.push_field import PUSH_FIELD, simulate_push_field
from beliefscope.datasets.simulation.push_field_yaw import PUSH_FIELD_YAW
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.store import open_dataset
from beliefscope.datasets.task import Task

FIELD_TASKS = (DOOR_FIELD, PUSH_FIELD, PUSH_FIELD_YAW)
STEPS = 60
SENSORS = {"camera-pose", "sleeve", "image-quality", "outages", "wrist", "hand-pose"}


@pytest.fixture(scope="module", params=FIELD_TASKS, ids=lambda task: task.name)
def task(request: pytest.FixtureRequest) -> Task:
    definition = request.param
    assert isinstance(definition, Task)
    return definition


@pytest.fixture(scope="module")
def episode(task: Task) -> Episode:
    return simulated(task)


def simulated(task: Task, *without: str, index: int = 0, steps: int = STEPS) -> Episode:
    assert task.simulate is not None
    return task.simulate(7, index, steps, without)


@pytest.mark.first(1)
def test_simulation_is_deterministic_and_motion_does_not_depend_on_the_length(task: Task, episode: Episode) -> None:
    assert simulated(task).digest() == episode.digest()
    assert simulated(task, index=1, steps=9).digest() != simulated(task, steps=9).digest()
    sensors_off = tuple(task.ingredients.keys() - {"aim"})
    short, long = (simulated(task, *sensors_off, steps=steps) for steps in (9, 20))
    np.testing.assert_array_equal(short.qpos, long.qpos[:9])


def test_arrays_match_the_task(task: Task, episode: Episode) -> None:
    assert find_task(task.name) is task
    assert episode.states.shape == (STEPS, len(task.components))
    assert episode.controls.shape == (STEPS, task.control_size)
    for key, shape in task.observations.items():
        assert episode.observations[key].shape == (STEPS, *shape), key
    json.dumps(dict(episode.provenance), allow_nan=False)


def test_provenance_has_the_values_of_all_ingredients(task: Task, episode: Episode) -> None:
    values = episode.provenance["ingredients"]
    assert list(values) == list(task.ingredients)
    for name, ingredient in task.ingredients.items():
        assert values[name].keys() == ingredient.ranges.keys()
        assert all(low <= values[name][key] <= high for key, (low, high) in ingredient.ranges.items())


@pytest.mark.parametrize("name", ["aim", "outages", "start"])
def test_switching_an_ingredient_off_leaves_the_other_draws_unchanged(task: Task, name: str) -> None:
    every, rest = draw(task, 3, 4), draw(task, 3, 4, [name])
    assert name not in rest
    assert all(rest[other].values == every[other].values for other in every if other != name)
    assert all(rest[other].rng.random() == every[other].rng.random() for other in rest)


@pytest.mark.first(6)
@pytest.mark.parametrize("name", sorted(SENSORS))
def test_sensor_ingredients_change_their_sensor_and_nothing_else(task: Task, episode: Episode, name: str) -> None:
    other = simulated(task, name)
    changed = {key for key, values in episode.observations.items() if (values != other.observations[key]).any()}
    expected = {"wrist": {"force", "torque"}, "hand-pose": {"effector_position"}}
    assert changed == expected.get(name, {"image"})
    np.testing.assert_array_equal(other.states, episode.states)
    np.testing.assert_array_equal(other.controls, episode.controls)


@pytest.mark.first(1)
@pytest.mark.slow
def test_ingredients_of_the_physics_change_the_motion(task: Task) -> None:
    sensors = tuple(SENSORS)
    base = simulated(task, *sensors, steps=100)
    physics = task.ingredients.keys() - SENSORS - {"start", "hidden-frame"}
    for name in physics:
        assert (simulated(task, *sensors, name, steps=100).states != base.states).any(), name


def test_hidden_frame_is_invisible_to_the_camera_only() -> None:
    off = [name for name in DOOR_FIELD.ingredients if name != "hidden-frame"]
    hidden, visible = simulate_door_field(1, 0, 5, off), simulate_door_field(1, 0, 5, [*off, "hidden-frame"])
    assert (hidden.observations["image"] != visible.observations["image"]).any()
    np.testing.assert_array_equal(hidden.qpos, visible.qpos)


def test_without_ingredients_only_the_control_loop_differs_from_the_paper_task() -> None:
    field = simulate_door_field(5, 0, 3, list(DOOR_FIELD.ingredients))
    assert DOOR.simulate is not None
    paper = DOOR.simulate(5, 0, 3)
    np.testing.assert_array_equal(field.observations["image"][0], paper.observations["image"][0])
    assert field.provenance["hinge"] == paper.provenance["hinge"]
    assert "start_offset" not in field.provenance


def test_controls_do_not_depend_on_the_measured_hand(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    """A controller that holds the hand back changes the measured positions, but not the commanded path."""
    before = simulated(task, index=1, steps=12)
    module = door_field if task is DOOR_FIELD else push_field
    monkeypatch.setattr(module, "IMPEDANCE", replace(module.IMPEDANCE, lead=0.005))
    after = simulated(task, index=1, steps=12)
    difference = after.observations["effector_position"] - before.observations["effector_position"]
    assert np.linalg.norm(difference, axis=1).max() > 0.01
    np.testing.assert_array_equal(after.controls, before.controls)
    previous, change = before.controls[:, :3], before.controls[:, 3:]
    np.testing.assert_allclose(previous[1:], (previous + change)[:-1], atol=1e-6)


def test_faults_leave_the_commanded_path_unchanged(task: Task, episode: Episode) -> None:
    faulty = Faults.parse("effector_offset=0.02,contact_inverted").apply(episode)
    np.testing.assert_array_equal(faulty.controls, episode.controls)


def test_first_belief_is_off_by_the_drawn_distance(task: Task) -> None:
    offsets = []
    for index in range(8):
        episode = simulated(task, index=index, steps=2)
        offsets.append(episode.provenance["start_offset"])
    units = np.array([component.unit for component in task.components])
    for unit, (low, high) in task.start_distance.items():
        distance = np.linalg.norm(np.array(offsets)[:, units == unit], axis=1)
        assert (distance > low - 1e-6).all()
        assert (distance < high + 1e-6).all()


def test_replay_has_the_object_of_the_episode(task: Task, episode: Episode) -> None:
    replayed = replay(task, episode)
    assert replayed is not None
    model, values = replayed.model, episode.provenance["ingredients"]
    if task is PUSH_FIELD:
        assert model.geom("puck").size[0] == pytest.approx(values["puck"]["radius"])
        np.testing.assert_allclose(replayed.positions[:, model.body("puck").id, :2], episode.states, atol=1e-7)
    elif task is PUSH_FIELD_YAW:
        expected = [values["block"]["length"] / 2, values["block"]["width"] / 2]
        np.testing.assert_allclose(model.geom("puck").size[:2], expected)
        along = replayed.rotations[:, model.body("puck").id, :2, 0]  # the x axis of the block
        yaw = episode.states[:, 2]
        # The block tilts by less than a degree, and positions of joints are rounded.
        np.testing.assert_allclose(along, np.stack([np.cos(yaw), np.sin(yaw)], axis=1), atol=2e-3)
        assert np.ptp(yaw) > 0.02, "pushes turn the block"
    else:
        assert 2 * model.geom("panel").size[1] == pytest.approx(values["panel"]["width"])
        np.testing.assert_allclose(replayed.positions[:, model.body("door").id, :2], episode.states[:, :2], atol=1e-7)
    broken = replace(
        episode,
        provenance={**episode.provenance, "ingredients": {"puck": {"size": 1}, "block": {"size": 1}, "panel": 3}},
    )
    with pytest.raises(BadInput, match="provenance does not describe its"):
        replay(task, broken)


@pytest.mark.slow
@pytest.mark.long
def test_pushes_reach_the_puck_and_nudges_move_it() -> None:
    episodes = [simulate_push_field(11, index, 200) for index in range(4)]
    contact = np.concatenate([episode.contact for episode in episodes])
    assert 0.1 < contact.mean() < 0.4
    assert all(10 < np.argmax(episode.contact) < 100 for episode in episodes), "free motion before the first contact"
    moved = [np.linalg.norm(np.diff(e.states[:, :2], axis=0), axis=1) for e in episodes]
    nudged = [moved[i][step - 1 : step + 2].sum() for i, e in enumerate(episodes) for step in e.provenance["nudges"]]
    assert np.median(nudged) > 0.01


def test_collect_switches_ingredients_off(tmp_path: Path) -> None:
    path = tmp_path / "field.h5"
    collect("push-field", 2, 5, 0, 1, path, without=["outages", "wrist"])
    with open_dataset(path) as data:
        assert data.task is PUSH_FIELD
        assert data[1].digest() == simulate_push_field(0, 1, 5, ["outages", "wrist"]).digest()
    with pytest.raises(BadInput, match=r"ingredient 'rain' of task 'push-field' does not exist\. Available: puck"):
        collect("push-field", 2, 5, 0, 1, path, without=["rain"])
    with pytest.raises(BadInput, match="ingredient 'outages' of task 'push' does not exist"):
        collect("push", 2, 5, 0, 1, path, without=["outages"])


def test_every_ingredient_is_documented() -> None:
    page = (Path(beliefscope.__file__).resolve().parents[2] / "docs" / "field_tasks.md").read_text()
    for task in FIELD_TASKS:
        section = page.split(f"## {task.name}\n")[1].split("\n## ")[0]
        rows = [line.split("|")[1:-1] for line in section.splitlines() if line.startswith("| `")]
        same = PUSH_FIELD.ingredients if task is PUSH_FIELD_YAW else {}
        assert [(name.strip(" `"), meaning.strip(), ranges.strip()) for name, meaning, ranges in rows] == [
            (name, ingredient.meaning, ranges_text(ingredient.ranges))
            for name, ingredient in task.ingredients.items()
            if ingredient != same.get(name)
        ]


def ranges_text(ranges: dict[str, tuple[float, float]]) -> str:
    return ", ".join(f"`{key}` {low:.3g} to {high:.3g}" for key, (low, high) in ranges.items())
