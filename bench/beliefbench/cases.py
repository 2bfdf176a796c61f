"""Cases of the benchmark: what is planted where, and the split into tuning and test."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from beliefbench import shifts
from beliefbench.model_faults import MODEL_CAUSES, with_equations
from beliefbench.sensor_faults import LABEL_CAUSES, SENSOR_CAUSES
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.healthy_profile import find_profile

FILTERS = {
    "tuning": (("door", "crossmodal-ekf"), ("door", "crossmodal-pf")),
    "test": (("push", "crossmodal-ekf"), ("push", "crossmodal-pf"), ("push", "unimodal-ekf"), ("push", "unimodal-pf")),
    "field-tuning": (("push-field", "information-ekf"),),
    "field-test": (("door-field", "information-ekf"),),
}
"""Split -> tasks and filters."""

EPISODES, STEPS, FIELD_STEPS, PARTICLES = 6, 100, 200, 300
CLEAN, PAIRS = 10, 8
"""Number of clean controls and of pairs of causes per filter."""

SENSORS_OF_PAIRS = ("image.blackout", "image.frozen", "image.shift", "force.bias", "force.stuck", "effector.offset")
MODELS_OF_PAIRS = ("model.image.bias", "model.haptics.broken", "dynamics.frozen", "process_noise.small")


@dataclass(frozen=True)
class Planted:
    """A cause at one of the four levels. Details for the reader: faults as text, and the affected episodes."""

    cause: str
    level: int
    magnitude: float | str
    faults: str = ""
    episodes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Spec:
    """Everything that determines a case. The files are a function of this and of the pretrained checkpoints."""

    task: str
    filter: str
    planted: tuple[Planted, ...]
    seed: int
    episodes: int = EPISODES
    steps: int = STEPS

    @property
    def name(self) -> str:
        """Of the folder: it does not name the cause."""
        return f"{self.split}-{self.seed}"

    @property
    def label(self) -> str:
        """Such as ``door crossmodal-ekf image.frozen (10)``."""
        causes = " + ".join(f"{p.cause} ({p.magnitude})" for p in self.planted) or "clean"
        return f"{self.task} {self.filter} {causes}"

    @property
    def split(self) -> str:
        """Name of the split to which task, filter, levels and seed all belong, else ``unused``.

        Splits for tuning have even levels and even seeds, those for tests odd ones.
        """
        for split, filters in FILTERS.items():
            numbers = [self.seed, *(p.level for p in self.planted)]
            if (self.task, self.filter) in filters and all(number % 2 == parity(split) for number in numbers):
                return split
        return "unused"

    @property
    def rng(self) -> np.random.Generator:
        label = self.label.replace("contact.inverted", "contact.flipped")  # its name when results were measured
        return np.random.default_rng([self.seed, zlib.crc32(label.encode())])


def parity(split: str) -> int:
    """Remainder of the levels and seeds of a split: 0 for tuning, 1 for a test."""
    return int(split.endswith("test"))


def magnitudes() -> dict[str, tuple[float | str, ...]]:
    """Cause -> magnitudes of its levels; a cause with fewer than four repeats them."""
    return {
        **{name: cause.magnitudes for name, cause in SENSOR_CAUSES.items()},
        **LABEL_CAUSES,
        **{name: cause.magnitudes for name, cause in MODEL_CAUSES.items()},
        "data.shift": shifts.MAGNITUDES,
    }


def planted(cause: str, level: int) -> Planted:
    values = magnitudes()[cause]
    return Planted(cause, level, values[level % len(values)])


def causes_of(task: str, filter_: str) -> list[str]:
    """Causes that can be planted in a filter. The physics of field tasks vary between all episodes."""
    built = architecture(task, filter_)
    model = {cause: kind.applies(built) for cause, kind in MODEL_CAUSES.items()}
    return [cause for cause in magnitudes() if model.get(cause, cause != "data.shift" or task in shifts.TASKS)]


def plan(split: str, repeats: int = 1) -> list[Spec]:
    """The cases of a split: every cause in every filter, ``CLEAN`` controls and ``PAIRS`` pairs per filter.

    The level alternates between the two of the split, from cause to cause, filter to filter and repeat to repeat.
    """
    odd = parity(split)
    seeds: Iterator[int] = iter(range(1000 + odd, 10**6, 2))
    specs = []
    for repeat in range(repeats):
        for f, (task, name) in enumerate(FILTERS[split]):
            for c, cause in enumerate(causes_of(task, name)):
                level = odd + 2 * ((f + c + repeat) % 2)
                specs.append(Spec(task, name, (planted(cause, level),), next(seeds)))
            specs += [Spec(task, name, (), next(seeds)) for _ in range(CLEAN)]
            for pair in range(PAIRS):
                first = SENSORS_OF_PAIRS[(pair + f) % len(SENSORS_OF_PAIRS)]
                second = MODELS_OF_PAIRS[(pair + repeat) % len(MODELS_OF_PAIRS)]
                both = tuple(planted(cause, odd + 2) for cause in (first, second))
                specs.append(Spec(task, name, both, next(seeds)))
    assert all(spec.split == split for spec in specs)
    return [replace(spec, steps=FIELD_STEPS) for spec in specs] if split.startswith("field") else specs


@dataclass(frozen=True)
class Case:
    """A case as a tool sees it.

    Attributes:
        checkpoint: with the healthy profile of its original. episodes: by index. seed: of the random numbers.
        runnable: whether the files alone define the filter; else its equations were changed in memory (``equations``).
    """

    name: str
    checkpoint: Checkpoint
    episodes: Mapping[int, Episode]
    particles: int
    seed: int
    folder: Path
    runnable: bool


def load_case(folder: Path) -> Case:
    """Read a case. The checkpoint has the faulty equations, and the original's healthy profile of this version."""
    truth = read_truth(folder)
    checkpoint = load_checkpoint(folder / "checkpoint.safetensors")
    checkpoint = replace(checkpoint, healthy_profile=healthy_profile(truth["task"], truth["filter"]))
    causes = [(p["cause"], p["magnitude"]) for p in truth["planted"] if p["cause"] in MODEL_CAUSES]
    for cause, magnitude in causes:
        with_equations(checkpoint.filter, cause, magnitude)
    with open_dataset(folder / "episodes.h5") as data:
        episodes = dict(enumerate(data))
    settings = json.loads((folder / "settings.json").read_text())
    runnable = not any(MODEL_CAUSES[cause].equations for cause, _ in causes)
    return Case(folder.name, checkpoint, episodes, settings["particles"], settings["seed"], folder, runnable)


@cache
def healthy_profile(task: str, filter_: str) -> dict[str, Any]:
    """JSON of the healthy profile of a pretrained checkpoint."""
    profile = find_profile(task, filter_, load_checkpoint(pretrained_path(task, filter_)).hash, None)
    assert profile is not None
    return profile.to_json()


def read_truth(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "truth.json").read_text())


def write_truth(folder: Path, spec: Spec, effect: Mapping[str, Any]) -> None:
    document = asdict(spec) | {"split": spec.split, **effect}
    (folder / "truth.json").write_text(json.dumps(document, indent=1) + "\n")


def folders(directory: Path) -> list[Path]:
    """Folders of the complete cases in a directory."""
    return sorted(path.parent for path in directory.glob("*/truth.json"))
