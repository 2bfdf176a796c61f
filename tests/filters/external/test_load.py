"""External filters loaded by file or module name: errors, hashes and adapters."""

from __future__ import annotations

import importlib
import logging
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, type_name
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter, as_external, load_external
from beliefscope.filters.open_filter import open_filter


@pytest.fixture(scope="module")
def episode() -> Episode:
    with open_dataset(sample_path("door")) as data:
        return data[0]


FILE = """
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
class Filter(nn.Module):
    value = {value}
    def initialize_beliefs(self, mean, covariance): self.at = 0
    def forward(self, observations, controls):
        self.at += 1
        return self.value if self.at == 4 else torch.zeros(len(controls), 3)
build = Filter
NUMBER = 3
def number(): return 3
def fails(): raise KeyError("weights.pt")
def other():
    filter = Filter()
    filter.task = "push"
    return filter
"""


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("missing.py:build", "", r"^missing\.py does not exist\.$"),
        ("no.such.module:build", "", r"^module 'no\.such\.module' cannot be imported: ModuleNotFoundError"),
        ("own.py:biuld", "", r"^own\.py has no 'biuld'\. Available: Filter, build, number, fails, other\.$"),
        ("own.py:NUMBER", "", r"^own\.py has 'NUMBER', which is not callable\. Available"),
        ("own.py:number", "", r"^own\.py:number returns an int, expected a filter, which can be called or has forward"),
        ("own.py:fails", "", r"^own\.py:fails fails when called: KeyError: 'weights\.pt'$"),
        ("own.py:other", "", r"^filter 'own\.py:other' is for task 'push', not for 'door'$"),
        ("own.py:build", "1 / 0", r"^own\.py cannot be run: ZeroDivisionError"),
        (
            "own.py:build",
            "None",
            r"^own\.py:build returns a NoneType, expected a mean, a pair of mean and covariance, or",
        ),
        (
            "own.py:build",
            "torch.zeros(1, 2)",
            r"build at step 3 returns estimate_mean of shape \(1, 2\), expected \(1, 3\)$",
        ),
        (
            "own.py:build",
            "torch.full((1, 3), float('nan'))",
            r"build at step 3 returns estimate_mean with a number that is",
        ),
    ],
)
def test_invalid_filter_sources_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, episode: Episode, name: str, value: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(FILE.format(value=value or "None"))
    path = list(sys.path)
    with pytest.raises(BadInput, match=message):
        load_external(name, "door").run([episode])
    assert sys.path == path


def test_hash_depends_on_weights_code_and_adapter(tmp_path: Path) -> None:
    (tmp_path / "helper.py").write_text("from torch import nn\nclass One(nn.Linear):\n    task = 'door'\n")
    code = "import torch\nfrom helper import One\ndef build():\n    torch.manual_seed({})\n    return One(2, 2)\n"
    hashes = []
    for seed in (0, 0, 1):
        (tmp_path / "own.py").write_text(code.format(seed))
        hashes.append(load_external(f"{tmp_path}/own.py:build").hash)
    sys.modules.pop("helper")
    assert hashes[0] == hashes[1] != hashes[2]
    first, second = Adapter(nn.Linear(2, 2), std=(1, 1, 1)), Adapter(nn.Linear(2, 2), std=(1, 1, 2))
    assert ExternalFilter(first, DOOR, "a").hash != ExternalFilter(second, DOOR, "a").hash


def test_hash_covers_numbers_of_modules_and_not_their_state() -> None:
    """Modules with the same weights that differ in a setting are other filters; a step leaves the hash as it is."""

    class Scaled(nn.Module):
        def __init__(self, scale: float) -> None:
            super().__init__()
            self.options, self.head = {"scale": scale}, nn.Identity()

        def initialize_beliefs(self, *, mean: Tensor, covariance: Tensor) -> None:
            self.mean = mean

        def forward(self, *, observations: object, controls: Tensor) -> Tensor:
            return self.mean

    first, second = Scaled(1.0), Scaled(1.0)
    second.initialize_beliefs(mean=torch.ones(1, 3), covariance=torch.eye(3))
    hashes = [as_external(module, "scaled", DOOR).hash for module in (first, second, Scaled(2.0))]
    assert hashes[0] == hashes[1] != hashes[2]


def test_hash_is_the_same_in_python_and_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "class Own:\n    task = 'door'\n    def __call__(self, *, observations, controls): {}\n"
    (tmp_path / "own_place.py").write_text(code.format("return controls[..., :3]"))
    monkeypatch.syspath_prepend(tmp_path)
    in_python = as_external(importlib.import_module("own_place").Own(), "Own").hash
    assert in_python == load_external(f"{tmp_path}/own_place.py:Own").hash
    sys.modules.pop("own_place")


def test_hash_covers_functions_that_a_filter_holds(tmp_path: Path) -> None:
    """Functions in attributes and enclosed by methods, values that they enclose, classes, imported files, the start."""
    code = """
import beliefscope as bs
from sensor_model import expected

class Held:
    def __init__(self, update): self._update = update
    def initialize_beliefs(self, *, mean, covariance): self.mean = mean
    def __call__(self, *, observations, controls): return self._update(self.mean)

class Model:
    def step(self, mean): return mean

class Other(Model):
    def step(self, mean): return -mean

def held(r=1.0, model=Model, std=1.0):
    filter_ = model()
    filter_.update = lambda mean: r * filter_.step(mean)
    return bs.Adapter(Held(filter_.update), initial_std=(std,) * 3, task="door")

def noisy(): return held(r=2.0)
def other(): return held(model=Other)
def uncertain(): return held(std=2.0)

def local(function):
    class Local(Held):
        def __call__(self, *, observations, controls): return function(self.mean)
    return bs.Adapter(Local(None), task="door")

def plus(): return local(lambda mean: mean + 1)
def minus(): return local(lambda mean: mean - 1)
"""
    (tmp_path / "held.py").write_text(code)

    def hash_of(name: str) -> str:
        return load_external(f"{tmp_path}/held.py:{name}").hash

    (tmp_path / "sensor_model.py").write_text("def expected(): return 1")
    hashes = [hash_of(name) for name in ("held", "noisy", "other", "uncertain", "plus", "minus")]
    assert len(set(hashes)) == len(hashes)
    assert hash_of("held") == hashes[0]
    (tmp_path / "sensor_model.py").write_text("def expected(): return 2")
    assert hash_of("held") != hashes[0]
    sys.modules.pop("sensor_model")


def test_hash_covers_no_state_of_the_process() -> None:
    """A filter may hold a module, such as NumPy or PyTorch for its arithmetic, a logger or a lock."""

    class Logging(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.library, self.log, self.stop = torch, logging.getLogger("filter"), threading.Event()

    first = as_external(module := Logging(), "logging", "door").hash
    logging.getLogger("another").setLevel("DEBUG")
    module.stop.set()
    assert first == as_external(module, "logging", "door").hash


def test_a_module_in_training_mode_runs_in_evaluation_mode_with_a_warning() -> None:
    noisy = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))
    with pytest.warns(UserWarning, match="noisy is in training mode; it runs in evaluation mode: without dropout"):
        ExternalFilter(Adapter(noisy), DOOR, "noisy")
    assert not noisy[1].training


def test_hash_covers_code_without_a_file() -> None:
    """Classes and functions of notebooks: their modules have no file."""

    def filter_of(code: str) -> Any:
        names: dict[str, Any] = {"__name__": "no_such_module"}
        exec(f"def outer(b):\n    def own(*, observations, controls): return {code}\n    return own", names)
        return names["outer"]

    a, b = (as_external(filter_of(f"controls + {n} + b")(0), "own", "door").hash for n in (1, 2))
    enclosed = as_external(filter_of("controls + 1 + b")(1), "own", "door").hash
    assert len({a, b, enclosed}) == 3
    assert a == as_external(filter_of("controls + 1 + b")(0), "own", "door").hash


@pytest.mark.parametrize(
    ("adapter", "message"),
    [
        ({"components": ("angle", "hinge_x", "hinge_z")}, "component 'hinge_z' of task 'door' does not exist"),
        ({"components": ("angle",)}, "Adapter's components are angle; task 'door' has hinge_x, hinge_y, angle"),
        ({"mean": (0.0, 1.0)}, "Adapter's mean has 2 numbers, expected 3"),
        ({"std": (1.0, 0.0, 1.0)}, r"Adapter's std is \(1.0, 0.0, 1.0\), expected numbers above 0"),
    ],
)
def test_adapters_that_do_not_fit_the_task_are_rejected(adapter: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        ExternalFilter(Adapter(nn.Linear(2, 2), **adapter), DOOR, "mine")


@pytest.mark.parametrize("given", ["own.py", "./own.py"])
def test_a_python_file_without_a_function_is_refused_with_its_functions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    monkeypatch.chdir(tmp_path)
    source = "def _own(): ...\ndef make(a=1, *, b=2): ...\ndef needs(a): ...\ndef needs_too(*, a): ...\nraise OSError\n"
    (tmp_path / "own.py").write_text(source)
    expected = "Python file: add the function that returns the filter, own.py:make. "
    with pytest.raises(BadInput) as error:
        open_filter("door", given)
    assert str(error.value).endswith(f"{expected}Functions without arguments: make.")
    for content in ("def (", None):
        (tmp_path / "own.py").unlink() if content is None else (tmp_path / "own.py").write_text(content)
        with pytest.raises(BadInput, match=r"own\.py:build\.$"):
            open_filter("door", given)


@pytest.mark.parametrize(("value", "name"), [(3, "an int"), (None, "a NoneType"), (nn.ReLU(), "a ReLU")])
def test_type_name_has_its_article(value: object, name: str) -> None:
    assert type_name(value) == name


def test_filter_has_a_short_text(episode: Episode) -> None:
    """A session prints what ``load_filter`` returns; the fields of a trained checkpoint are not available."""

    def still(*, observations: dict[str, Any], controls: Any) -> Any:
        return controls[..., :3]

    external = as_external(still, "still", episode.task)
    assert repr(external) == f"<ExternalFilter: still of task door, {external.hash[:12]}>"


def test_named_tasks_are_not_the_default(tmp_path: Path) -> None:
    own = replace(DOOR, name="own")
    path = tmp_path / "own_filter.py"
    path.write_text(FILE.format(value=0).replace("'push'", "'own'").replace('"push"', '"own"'))
    assert load_external(f"{path}:other", given=[DOOR], named=[own]).task.name == "own"
    assert load_external(f"{path}:build", given=[DOOR], named=[own]).task.name == "door"
    with pytest.raises(BadInput, match=r"does not name its task"):
        load_external(f"{path}:build", named=[own])


WIDE = """
from safetensors import safe_open
from torch import nn
class Filter(nn.Module):
    task = "door"
    def __init__(self, width):
        super().__init__()
        self.head = nn.Linear(width, 3, bias=False)
    def initialize_beliefs(self, mean, covariance): pass
    def forward(self, observations, controls): return self.head.weight.sum(1).expand(len(controls), -1)
def build(weights):
    with safe_open(weights, "pt") as file:
        return Filter(file.get_slice("head.weight").get_shape()[1])
"""


def test_a_build_function_with_a_parameter_receives_the_path_of_the_weights(tmp_path: Path, episode: Episode) -> None:
    (tmp_path / "own.py").write_text(WIDE)
    for width in (2, 5):
        save_file({"head.weight": torch.ones(3, width)}, tmp_path / f"{width}.safetensors")
        external = load_external(f"{tmp_path}/own.py:build@{tmp_path}/{width}.safetensors")
        values, _ = external.run([episode])
        assert values["estimate_mean"].unique().tolist() == [width]
    with pytest.raises(BadInput, match=r"own\.py:build needs weights: .*own\.py:build@FILE\.safetensors$"):
        load_external(f"{tmp_path}/own.py:build")
