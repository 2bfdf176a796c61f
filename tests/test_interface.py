"""The public Python interface: lazily imported, complete, documented."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import nn

import beliefscope as bs
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.trace import trace

ROOT = Path(__file__).parents[1]
DOCS = (ROOT / "docs" / "python.md").read_text()

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run() -> bs.Trace:
    return bs.trace("door/crossmodal-ekf", "door", 9, faults="blackout=0.4")


def test_import_is_light() -> None:
    loaded = "sorted(name for name in sys.modules if name.startswith('beliefscope'))"
    code = f"import sys, beliefscope; print(*{loaded}, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == ["beliefscope", "False"]


def test_every_public_name_exists_and_is_documented() -> None:
    for name in bs.__all__:
        assert getattr(bs, name) is not None
        assert name == "__version__" or re.search(rf"`{name}[`(]", DOCS), name
    assert dir(bs) == bs.__all__
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        bs.nothing  # noqa: B018


def test_documented_code_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    names: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", DOCS, re.DOTALL)
    assert len(blocks) == 3
    exec(compile("\n".join(blocks), "python.md", "exec"), names)
    assert names["mine"].task.name == "push"


def test_functions_agree_with_those_of_the_modules(run: bs.Trace) -> None:
    filter_, data = bs.load_filter("door/crossmodal-ekf"), bs.open_dataset("door")
    direct = trace(filter_, data[9], 9, faults=bs.Faults.parse("blackout=0.4"))
    np.testing.assert_array_equal(run.estimate_mean, direct.estimate_mean)
    metrics = bs.evaluate(filter_, data, [9])
    assert metrics.rmse == evaluate(filter_.filter, [data[9]]).rmse
    assert set(metrics.baselines) == {"stay", "dynamics"}
    assert [m.step for m in bs.maps(filter_, run, [3, 50])] == [3, 50]
    first = bs.trace(filter_, data)
    assert first.episode_index == data.held_out()[0]


def test_task_and_episode_need_few_fields(tmp_path: Path) -> None:
    task = bs.Task(
        "tank", (bs.Component("level", "m"), bs.Component("flow", "l/s")), {"gauge": (1,)}, {"g": ("gauge",)}, 0, 0.1
    )
    assert (task.map_components, task.map_half_width) == (("level",), 0.135)
    episodes = [bs.Episode(task, np.full((40, 2), k), observations={"gauge": np.ones((40, 1))}) for k in (1.0, 2.0)]
    path = bs.save_dataset(episodes, tmp_path / "tank.h5")
    stored, listed = bs.open_dataset(path, task), bs.open_dataset(episodes)
    assert stored.hash == listed.hash
    assert stored[1].dt == 0.1

    def twice(**inputs: Any) -> Any:
        return np.repeat(inputs["observations"]["gauge"], 2, -1)

    for filter_ in (bs.load_filter(twice, task), twice):
        assert bs.trace(filter_, episodes, 1).estimate_mean[0].tolist() == [1.0, 1.0]
    with pytest.raises(bs.BadInput, match="empty list"):
        bs.open_dataset([])
    with pytest.raises(bs.BadInput, match="tasks 'tank' and 'push'"):
        bs.open_dataset([episodes[0], bs.open_dataset("push")[0]])


def test_episodes_that_no_command_could_read_are_not_saved(tmp_path: Path) -> None:
    task = bs.Task("tank", (bs.Component("level", "m"),), {"gauge": (1,), "eye": (4, 4)}, {"g": ("gauge",)}, 0, 0.1)
    good = bs.Episode(task, np.zeros((5, 1)), observations={"gauge": np.ones((5, 1)), "eye": np.zeros((5, 4, 4), "u1")})
    path = bs.save_dataset([good], tmp_path / "tank.h5")
    before = path.read_bytes()
    gauge = np.ones((5, 1))
    gauge[3] = np.nan
    cases = {
        "'observations/gauge' of episode 1 is nan at step 3, expected finite numbers; .* a mask": {"gauge": gauge},
        r"'observations/gauge' of episode 1 has shape \(4, 1\), expected \(5, 1\)": {"gauge": np.ones((4, 1))},
        "'observations/eye' of episode 1 is float32, expected uint8": {"eye": np.zeros((5, 4, 4))},
        "has 'observations/nose', which task 'tank' does not declare. Available: observations/gauge": {"nose": gauge},
    }
    for message, changed in cases.items():
        with pytest.raises(bs.BadInput, match=message):
            bs.save_dataset([good, replace(good, observations={**good.observations, **changed})], path)
    with pytest.raises(bs.BadInput, match="'observations/gauge' of episode 0 is nan at step 3"):
        bs.open_dataset([replace(good, observations={**good.observations, "gauge": gauge})])
    for message, other in {
        "episode 1 has no 'observations/gauge'": replace(good, observations={"eye": good.observations["eye"]}),
        "'split' of episode 1 is 'training'. Available: train, val, test": replace(good, split="training"),
        "'time' of episode 1 is 0 s at step 1, after 0 s; expected ascending": replace(good, time=np.zeros(5)),
        "'dt' of episode 1 is 0.2 s; task 'tank' has steps of 0.1 s": replace(good, dt=0.2),
        "expected at least one step": good.part(0, 0),
    }.items():
        with pytest.raises(bs.BadInput, match=message):
            bs.save_dataset([good, other], path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["tank.h5"]


def test_every_function_has_a_call_in_the_example() -> None:
    example = (ROOT / "examples" / "06_public_calls.py").read_text()
    functions = [name for name in bs.__all__ if name[0].islower()]
    assert not [name for name in functions if f"bs.{name}(" not in example]


@pytest.mark.long
def test_example_runs(tmp_path: Path) -> None:
    names = runpy.run_path(str(ROOT / "examples" / "06_public_calls.py"))
    names["main"](tmp_path)
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    assert "<html" in (tmp_path / "run.html").read_text()


def test_record(run: bs.Trace, tmp_path: Path) -> None:
    path = bs.record(run, tmp_path / "run.rrd", "door/crossmodal-ekf", map_stride=50)
    assert path.stat().st_size > 10_000


@pytest.mark.long
def test_representations(run: bs.Trace) -> None:
    assert repr(run) == "<Trace: crossmodal-ekf over 100 steps of door episode 9, seed 0, blackout=0.4>"
    diagnosis = bs.diagnose("door/crossmodal-ekf", "door", [9, 19, 29], faults="image_frozen:from=40")
    (map_,) = bs.maps("door/crossmodal-ekf", run, 40)
    results = [run, map_, diagnosis, bs.evaluate("door/crossmodal-ekf", "door", [9])]
    results += bs.inspect_run(run, "door/crossmodal-ekf").values()
    for result in results:
        html = result._repr_html_()
        assert len(html) < 50_000
        assert html.count("<table>") == html.count("</table>")
        assert re.search(r"<table>|<img", html)
    assert diagnosis.headline in diagnosis._repr_html_()
    for figure in (map_.plot(), bs.inspect_run(run)["errors"].plot()):
        assert figure._repr_png_().startswith(b"\x89PNG")  # displayed without pyplot
    assert repr(map_) == "<LikelihoodMap: likelihood of image, haptics, fused at step 40, 41 x 41 cells>"


def test_diagnosis_against_the_record_of_another_filter() -> None:
    task = bs.Task("tank", (bs.Component("level", "m"),), {"gauge": (1,)}, {"g": ("gauge",)}, 0, 0.1, warmup=0)
    rng = np.random.default_rng(0)
    levels = [np.cumsum(rng.normal(0.0, 0.1, (40, 1)), axis=0) for _ in range(23)]
    readings = [level + rng.normal(0.0, 0.05, (40, 1)) for level in levels]
    episodes = [bs.Episode(task, x, observations={"gauge": z}) for x, z in zip(levels, readings, strict=True)]
    clean, data = episodes[:20], episodes[20:]

    def correct(**inputs: Any) -> Any:
        return inputs["observations"]["gauge"]

    def wrong(**inputs: Any) -> Any:
        return inputs["observations"]["gauge"] + 1.0

    assert bs.diagnose(wrong, data, profile_from=clean).state == "healthy"  # an error of its record
    assert len(bs.trace(correct, clean[0])) == 40, "a single episode"
    record = bs.healthy_record(correct, clean)
    assert record.episodes == len(clean)
    assert bs.diagnose(wrong, data, profile_from=record).state != "healthy"
    assert bs.diagnose(correct, data, profile_from=record) == bs.diagnose(correct, data, profile_from=clean)
    with pytest.raises(bs.BadInput, match="healthy record of task tank, but crossmodal-ekf is of task door"):
        bs.diagnose("door/crossmodal-ekf", "door", profile_from=record)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("crossmodal-pf", "neither TASK/NAME"),
        ("door/nosuch", "filter 'nosuch' does not exist"),
        ("missing.safetensors", "does not exist"),
        (3, "expected a filter"),
    ],
)
def test_unusable_filters(source: object, message: str) -> None:
    with pytest.raises(bs.BadInput, match=message):
        bs.load_filter(source, task="door")


def test_sweeps_take_checkpoints_and_build_functions(tmp_path: Path) -> None:
    mine = bs.load_filter(lambda *, observations, controls: controls[..., :2], task="push", name="mine")
    with pytest.raises(bs.BadInput, match=r"filter 'mine' was built in Python, .*: give its build function"):
        bs.sweep(tmp_path / "sweep", [mine])
    with pytest.raises(bs.BadInput, match=r"own\.py"):
        bs.sweep(tmp_path / "sweep", ["path/own.py:build"])
    with pytest.raises(bs.BadInput, match=r"filter 'Identity' was built in Python, .*: give its build function"):
        bs.sweep(tmp_path / "sweep", [bs.Adapter(nn.Identity(), task="push")])
    result = bs.sweep(tmp_path / "sweep", bs.load_filter("push/haptics-ekf"), "push", faults="blackout=0.5")
    assert result.overview().column("faults").to_pylist() == ["blackout=0.5"]
