"""Filters that are not this project's: any torch module that follows a small contract, or torchfilter's interface.

The contract, of which ``docs/own_filter.md`` has examples:

* ``module.initialize_beliefs(mean=, covariance=)`` starts N trajectories, (N, n) and (N, n, n). A module that has it is
  then called step by step, ``module(observations=, controls=)``: a dictionary of (N, ...) by the task's observation
  keys, and (N, c). A module that has it not is called once for all steps, with (T, N, ...) and (T, N, c).
* It returns the mean (N, n), a pair of mean and covariance (N, n, n), or a dictionary by the names in
  ``adapter.SHAPES``; with T in front where it was called once for all steps.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io import user_code
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import check_shapes
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.external.adapter import SHAPES, Adapter, Units, Values, checked, derived, named
from beliefscope.filters.external.hooks import Capture
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import START_VARIANCE


class Foreign(Checkpoint):
    """A filter from outside as everything downstream takes one: traced, evaluated and shown, but not stepped by hand.

    Attributes:
        adapter: the module, and how to speak to it. source: where it came from, as named by the user.
        hash: SHA-256 of the source's name, of the files of its classes and of its state dictionary.
    """

    def __init__(self, adapter: Adapter, task: Task, name: str, source: str = "") -> None:
        """Raises BadInput where the adapter does not fit the task."""
        values = {
            "name": name,
            "record": {"source": source or name},
            "hash": _hash(adapter, source or name),
            "adapter": adapter,
            "source": source or name,
            "_task": task,
            "_units": Units(task, adapter),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)  # a checkpoint is frozen
        adapter.module.eval()

    adapter: Adapter
    source: str
    _task: Task
    _units: Units

    @property
    def filter(self) -> Filter:
        """Raises BadInput: there is none of this project's."""
        raise BadInput(f"{self.source} is not a filter of this project, whose steps could be taken one by one")

    @property
    def task(self) -> Task:
        return self._task

    @property
    def kind(self) -> Literal["foreign"]:  # type: ignore[override]
        return "foreign"

    def start(self, episodes: Sequence[Episode]) -> Gaussian:
        """The first belief, as of our filters (``rollout.start_at_truth``): (N, n), (N, n, n), SI units.

        The covariance is 0.1 I in the adapter's standardised units, or in those of the filters that ship for the task.
        It is NaN where there are neither.
        """
        mean = torch.from_numpy(np.stack([episode.states[0] for episode in episodes])).float()
        std = self._units.std if self.adapter.std else _spread(self._task)
        return Gaussian(mean, torch.diag(START_VARIANCE * std.float() ** 2).expand(len(mean), -1, -1))

    def run(
        self, episodes: Sequence[Episode], seed: int = 0, progress: Callable[[float], None] | None = None
    ) -> tuple[Values, tuple[str, ...]]:
        """Filters N episodes of equal length at once, from the true state. Leaves no hook on the module.

        Args:
            seed: of torch's own generator, which is put back afterwards.
            progress: called with the share done, 0..1.

        Returns:
            What is known of each step, (T, N, ...) by the names of ``Trace``, SI units, float32; and the K names of
            the measurement models.

        Raises:
            BadInput: an episode does not fit the task, the module fails, or gives what is not as it should be; says
                at which step.
        """
        observations, controls = _inputs(self._task, episodes, _dtype(self.adapter.module))
        models: tuple[int, ...] = ()
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            if self._steps_alone:
                steps: list[Values] = []
                for step, took_part in self._steps(observations, controls, self.start(episodes)):
                    steps.append(step)
                    models = took_part
                    if progress is not None:
                        progress(len(steps) / len(controls))
                always = [name for name in steps[0] if all(name in step for step in steps)]
                values = {name: torch.stack([step[name] for step in steps]) for name in always}
            else:
                values = self._at_once(observations, controls)
                if progress is not None:
                    progress(1.0)
        return derived(self._units.to_si(values)), self._names(values, models)

    def live(self, episode: Episode, seed: int = 0) -> Iterator[tuple[Values, tuple[str, ...]]]:
        """``run`` of one episode, a step at a time as it is asked for: (N, ...) with N = 1, and the models' names.

        Raises BadInput as ``run``, and for a model of sequences, which takes no steps.
        """
        if not self._steps_alone:
            raise BadInput(f"{self.source} has no initialize_beliefs: it takes all steps at once, and cannot run live")
        observations, controls = _inputs(self._task, [episode], _dtype(self.adapter.module))
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            for step, models in self._steps(observations, controls, self.start([episode])):
                yield self._units.to_si(step), self._names({n: v[None] for n, v in step.items()}, models)

    @property
    def _steps_alone(self) -> bool:
        return hasattr(self.adapter.module, "initialize_beliefs")

    def _steps(
        self, observations: Mapping[str, Tensor], controls: Tensor, start: Gaussian
    ) -> Iterator[tuple[Values, tuple[int, ...]]]:
        """What each step says and shows, in the module's units, and which of its measurement models took part."""
        if start.covariance.isnan().any():
            raise BadInput(
                f"{self.source} starts from a covariance, and no filter ships for task {self._task.name!r} to say how "
                "large: give Adapter(module, mean=..., std=...)"
            )
        module, (n, count) = self.adapter.module, (len(self._task.components), len(start.mean))
        mean, covariance = self._units.of_start(start, _dtype(module))
        with self._blamed("initialize_beliefs"):
            getattr(module, "initialize_beliefs")(mean=mean, covariance=covariance)  # noqa: B009 - mypy takes it for a Tensor
        sizes: dict[str, int] = {"n": n}
        with Capture(module) as capture:
            for t in range(len(controls)):
                where = f"step {t}"
                with self._blamed(where):
                    seen = self.adapter.inputs({key: value[t] for key, value in observations.items()}, controls[t])
                    said = named(module(observations=seen[0], controls=seen[1]), self.source)
                    values = capture.step(said["estimate_mean"]) | said
                yield checked(values, (count,), sizes, f"{self.source} at {where}"), capture.models

    def _at_once(self, observations: Mapping[str, Tensor], controls: Tensor) -> Values:
        with self._blamed("all steps"):
            seen = self.adapter.inputs(dict(observations), controls)
            said = named(self.adapter.module(observations=seen[0], controls=seen[1]), self.source)
        return checked(said, controls.shape[:2], {"n": len(self._task.components)}, f"{self.source} over all steps")

    @contextmanager
    def _blamed(self, where: str) -> Iterator[None]:
        """What goes wrong in a stranger's code is told with the place."""
        try:
            yield
        except BadInput:
            raise
        except Exception as error:
            what = (str(error).strip().splitlines() or ["no message"])[0]
            raise BadInput(f"{self.source} fails at {where}: {type(error).__name__}: {what}") from error

    def _names(self, values: Values, models: tuple[int, ...]) -> tuple[str, ...]:
        return model_names(values, 2, self.adapter.modalities, self._task, models, self.source)


def model_names(
    values: Values, axis: int, given: Sequence[str], task: Task, models: Sequence[int] = (), who: str = "the filter"
) -> tuple[str, ...]:
    """Of the measurement models: as given, after the task's modalities where there are as many, or numbered.

    Args:
        axis: of the values along which they lie. models: which of all took part, where not all did.

    Raises BadInput where there are others than the given.
    """
    counts = [values[name].shape[axis] for name, shape in SHAPES.items() if shape[0] == "K" and name in values]
    count, given, known = max(counts, default=0), tuple(given), tuple(task.modalities)
    for names in (given, known):
        if count and len(names) > count == len(models):
            return tuple(names[k] for k in models)
        if count and len(names) == count:
            return names
    if given and count:
        raise BadInput(f"{who} names {len(given)} modalities, {', '.join(given)}, but has {count}")
    return ("+".join(known),) if count == 1 else tuple(f"model-{k + 1}" for k in range(count))


def load_foreign(source: str, task: str = "", unsaid: str = "") -> Foreign:
    """The filter that ``path/to/file.py:NAME`` or ``package.module:NAME`` makes when it is called without arguments.

    Args:
        task: name of the task; without it, what the filter says, by ``Adapter.task`` or an attribute ``task``.
        unsaid: name of the task where neither says it.

    Raises:
        BadInput: nothing is there by that name, it fails, gives no torch module, or one for another task.
    """
    place, _, attribute = source.rpartition(":")
    with user_code.importable(place):
        module = user_code.run(place)
        build = getattr(module, attribute, None)
        if not callable(build):
            here = [
                n for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == module.__name__
            ]
            what = f"holds no {attribute!r}" if build is None else f"holds {attribute!r}, which cannot be called"
            raise BadInput(f"{place} {what}. To be called in it: {', '.join(here) or 'nothing'}.")
        try:
            built = build()
        except Exception as error:
            raise BadInput(f"{source} fails when it is called: {type(error).__name__}: {error}") from error
    adapter = Adapter(built) if isinstance(built, nn.Module) else built
    if not isinstance(adapter, Adapter) or not isinstance(adapter.module, nn.Module):
        found = adapter.module if isinstance(adapter, Adapter) else adapter
        raise BadInput(f"{source} gives a {type(found).__name__}, expected a torch.nn.Module, or an Adapter of one")
    meant = adapter.task or getattr(adapter.module, "task", "")
    meant = meant if isinstance(meant, str) else ""
    task = task or meant or unsaid
    if not task:
        raise BadInput(
            f"{source} does not say which task it is for: give it an attribute task, or name one with --task"
        )
    known = load_task(task)
    if meant and meant != known.name:
        raise BadInput(f"filter {source!r} is for task {meant!r}, not for {known.name!r}")
    return Foreign(
        adapter, known, f"{Path(place).stem}-{attribute}" if place.endswith(".py") else source.replace(":", "-"), source
    )


def _inputs(task: Task, episodes: Sequence[Episode], dtype: torch.dtype) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (T, N, ...) by key, pictures as uint8; controls (T, N, c)."""
    for number, episode in enumerate(episodes):
        check_shapes(task, episode, f"episode {number}")
    observations = {
        key: torch.from_numpy(np.stack([episode.observations[key] for episode in episodes], axis=1))
        for key in task.observations
    }
    controls = torch.from_numpy(np.stack([episode.controls for episode in episodes], axis=1)).to(dtype)
    return {k: v if v.dtype == torch.uint8 else v.to(dtype) for k, v in observations.items()}, controls


def _spread(task: Task) -> Tensor:
    """(n,) m and rad: standard deviations of the states that the filters that ship were trained on; else NaN."""
    for name in filters_of(task):
        with suppress(BadInput):  # not every filter ships
            return load_checkpoint(shipped(task.name, name)).filter.statistics.mean_std("state")[1]
    return torch.full((len(task.components),), torch.nan)


def _dtype(module: nn.Module) -> torch.dtype:
    """That of the module's numbers."""
    numbers = (tensor.dtype for tensor in (*module.parameters(), *module.buffers()) if tensor.is_floating_point())
    return next(numbers, torch.float32)


def _hash(adapter: Adapter, source: str) -> str:
    """SHA-256 of everything that a run of the module depends on, as far as it can be seen."""
    digest = hashlib.sha256(repr((source, [*adapter.components], [*adapter.mean], [*adapter.std])).encode())
    digest.update(repr([*adapter.modalities]).encode())
    names = {type(part).__module__ for part in adapter.module.modules()} | {adapter.inputs.__module__}
    files = {getattr(sys.modules.get(name), "__file__", None) for name in names}
    for file in sorted(filter(None, files)):
        with suppress(OSError):
            digest.update(Path(file).read_bytes())
    for key, value in sorted(adapter.module.state_dict().items()):
        digest.update(key.encode())
        if isinstance(value, Tensor):
            value = value.detach().cpu().contiguous()
            digest.update(repr((value.dtype, value.shape)).encode())
            digest.update(value.flatten().view(torch.uint8).numpy().tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()
