"""External filters: torch modules that follow a small contract, or torchfilter's interface.

The contract (examples in ``docs/own_filter.md``):

* ``module.initialize_beliefs(mean=, covariance=)`` starts N trajectories, (N, n) and (N, n, n). A module with this
  method is then called step by step, ``module(observations=, controls=)``: a dictionary of (N, ...) by the task's
  observation keys, and (N, c). A module without it is called once for all steps, with (T, N, ...) and (T, N, c).
* It returns the mean (N, n), a pair of mean and covariance (N, n, n), or a dictionary with the keys of
  ``adapter.SHAPES``; with a leading axis T if called once for all steps.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io import user_code
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.batch import check_shapes, start_offset
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.external.adapter import SHAPES, Adapter, Units, Values, check_values, derived, named_values
from beliefscope.filters.external.hooks import Capture
from beliefscope.filters.filter import Filter
from beliefscope.filters.rollout import START_VARIANCE


class ExternalFilter(Checkpoint):
    """An external filter as a checkpoint: it can be traced, evaluated and displayed, but not stepped by the caller.

    Attributes:
        adapter: the module and its conventions. source: its origin, as given by the user.
        hash: SHA-256 of the source's name, of the files of its classes and of its state dictionary.
    """

    def __init__(self, adapter: Adapter, task: Task, name: str, source: str = "") -> None:
        """Raises BadInput if the adapter does not fit the task."""
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
        """Raises BadInput: an external filter has no ``Filter``."""
        raise BadInput(f"{self.source} is an external filter, which does not support this operation")

    @property
    def task(self) -> Task:
        return self._task

    @property
    def kind(self) -> Literal["external"]:  # type: ignore[override]
        return "external"

    def start(self, episodes: Sequence[Episode]) -> Gaussian:
        """The first belief, as in ``rollout.first_belief``: (N, n), (N, n, n), SI units.

        The variance 0.1 of components that start at the truth is in the adapter's standardised units, or in those of
        the task's pretrained filters. It is NaN if there are neither.
        """
        means = [episode.states[0] + start_offset(self._task, episode) for episode in episodes]
        mean = torch.from_numpy(np.stack(means)).float()
        std = self._units.std if self.adapter.std else _state_std(self._task)
        variance = torch.from_numpy(self._task.start_variance()).float()
        variance = torch.where(variance.isnan(), START_VARIANCE * std.float() ** 2, variance)
        return Gaussian(mean, torch.diag(variance).expand(len(mean), -1, -1))

    def run(
        self,
        episodes: Sequence[Episode],
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        start: Gaussian | None = None,
    ) -> tuple[Values, tuple[str, ...]]:
        """Filters N episodes of equal length at once. Removes all hooks from the module.

        Args:
            seed: of torch's global generator, whose state is restored.
            progress: called with the completed fraction, 0..1.
            start: first belief, as returned by ``start``, the default. A module that processes all steps at once
                does not use it.

        Returns:
            The values of each step, (T, N, ...) by the names of ``Trace``, SI units, float32; and the K names of the
            measurement models.

        Raises:
            BadInput: an episode does not fit the task, the module fails, or it returns invalid values; the message
                names the step.
        """
        observations, controls = _inputs(self._task, episodes, _dtype(self.adapter.module))
        models: tuple[int, ...] = ()
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            if self._stepwise:
                steps: list[Values] = []
                for values, models in self._steps(observations, controls, start or self.start(episodes)):  # noqa: B007
                    steps.append(values)
                    if progress is not None:
                        progress(len(steps) / len(controls))
                common = [name for name in steps[0] if all(name in step for step in steps)]
                values = {name: torch.stack([step[name] for step in steps]) for name in common}
            else:
                values = self._at_once(observations, controls)
                if progress is not None:
                    progress(1.0)
        return derived(self._units.to_si(values)), self._names(values, models)

    def live(self, episode: Episode, seed: int = 0) -> Iterator[tuple[Values, tuple[str, ...]]]:
        """Like ``run`` for one episode, as an iterator over steps: (N, ...) with N = 1, and the models' names.

        Raises BadInput as ``run``, and for a module that processes whole sequences.
        """
        if not self._stepwise:
            raise BadInput(
                f"{self.source} has no initialize_beliefs: it processes all steps at once, and cannot run live"
            )
        observations, controls = _inputs(self._task, [episode], _dtype(self.adapter.module))
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            for step, models in self._steps(observations, controls, self.start([episode])):
                yield self._units.to_si(step), self._names({n: v[None] for n, v in step.items()}, models)

    @property
    def _stepwise(self) -> bool:
        return hasattr(self.adapter.module, "initialize_beliefs")

    def _steps(
        self, observations: Mapping[str, Tensor], controls: Tensor, start: Gaussian
    ) -> Iterator[tuple[Values, tuple[int, ...]]]:
        """The values of each step, in the module's units, and the indices of the measurement models that took part."""
        if start.covariance.isnan().any():
            raise BadInput(
                f"{self.source} needs an initial covariance, and task {self._task.name!r} has no pretrained filter to "
                "take it from: give Adapter(module, mean=..., std=...)"
            )
        module, (n, count) = self.adapter.module, (len(self._task.components), len(start.mean))
        mean, covariance = self._units.from_si(start, _dtype(module))
        with self._errors_at("initialize_beliefs"):
            getattr(module, "initialize_beliefs")(mean=mean, covariance=covariance)  # noqa: B009 - mypy infers a Tensor
        sizes: dict[str, int] = {"n": n}
        with Capture(module) as capture:
            for t in range(len(controls)):
                where = f"step {t}"
                with self._errors_at(where):
                    inputs = self.adapter.inputs({key: value[t] for key, value in observations.items()}, controls[t])
                    output = named_values(module(observations=inputs[0], controls=inputs[1]), self.source)
                    values = capture.step(output["estimate_mean"]) | output
                yield check_values(values, (count,), sizes, f"{self.source} at {where}"), capture.models

    def _at_once(self, observations: Mapping[str, Tensor], controls: Tensor) -> Values:
        with self._errors_at("all steps"):
            inputs = self.adapter.inputs(dict(observations), controls)
            output = named_values(self.adapter.module(observations=inputs[0], controls=inputs[1]), self.source)
        return check_values(
            output, controls.shape[:2], {"n": len(self._task.components)}, f"{self.source} over all steps"
        )

    @contextmanager
    def _errors_at(self, where: str) -> Iterator[None]:
        """Turns exceptions of the module into BadInput with the location."""
        try:
            yield
        except BadInput:
            raise
        except Exception as error:
            message = (str(error).strip().splitlines() or ["no message"])[0]
            raise BadInput(f"{self.source} fails at {where}: {type(error).__name__}: {message}") from error

    def _names(self, values: Values, models: tuple[int, ...]) -> tuple[str, ...]:
        return model_names(values, 2, self.adapter.modalities, self._task, models, self.source)


class UnavailableFilter(ExternalFilter):
    """Stands for the filter of a live run that this server does not have. It can be drawn, but not run."""

    def __init__(self, name: str, hash_: str, task: Task) -> None:
        values = {"name": name, "record": {}, "hash": hash_, "source": name}
        for key, value in (values | {"_task": task}).items():
            object.__setattr__(self, key, value)  # checkpoints are frozen

    def run(self, *_: Any, **__: Any) -> Any:
        """Raises BadInput."""
        raise BadInput(f"this server has only a live run of filter {self.name!r}; add the filter with --filter")


def model_names(
    values: Values, axis: int, names: Sequence[str], task: Task, models: Sequence[int] = (), source: str = "the filter"
) -> tuple[str, ...]:
    """Names of the measurement models: as given, or the task's modalities if there are as many, or numbered.

    A single model of a task with several modalities is never named after one that it may not read.

    Args:
        axis: of the values that indexes the models. models: indices of the participating models, if not all.

    Raises BadInput if the number of given names does not match.
    """
    counts = [values[name].shape[axis] for name, shape in SHAPES.items() if shape[0] == "K" and name in values]
    count, modalities = max(counts, default=0), tuple(task.modalities)
    for candidates in (tuple(names), modalities):
        if count and len(candidates) > count == len(models):
            return tuple(candidates[k] for k in models)
        if count and len(candidates) == count:
            return candidates
    if names and count:
        raise BadInput(f"{source} names {len(names)} modalities, {', '.join(names)}, but has {count}")
    return tuple(f"model-{k + 1}" for k in range(count))


def load_external(source: str, task: str | Task = "", given: Sequence[Task] = ()) -> ExternalFilter:
    """The filter that ``path/to/file.py:NAME`` or ``package.module:NAME`` returns when called without arguments.

    Args:
        task: of the filter. Default: ``Adapter.task`` or an attribute ``task``, else the only given task.
        given: user-defined tasks that the filter may name.

    Raises:
        BadInput: the name does not exist, the call fails or does not return a torch module, or the task differs.
    """
    place, _, attribute = source.rpartition(":")
    with user_code.importable(place):
        module = user_code.load_module(place)
        build = getattr(module, attribute, None)
        if not callable(build):
            functions = [
                n for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == module.__name__
            ]
            problem = f"has no {attribute!r}" if build is None else f"has {attribute!r}, which is not callable"
            raise BadInput(f"{place} {problem}. Available: {', '.join(functions) or 'none'}.")
        try:
            result = build()
        except Exception as error:
            raise BadInput(f"{source} fails when called: {type(error).__name__}: {error}") from error
    adapter = Adapter(result) if isinstance(result, nn.Module) else result
    if not isinstance(adapter, Adapter) or not isinstance(adapter.module, nn.Module):
        value = adapter.module if isinstance(adapter, Adapter) else adapter
        raise BadInput(f"{source} returns a {type(value).__name__}, expected a torch.nn.Module, or an Adapter of one")
    loaded = load_task(task) if task else None
    own = adapter.task or getattr(adapter.module, "task", "")
    if isinstance(own, str | Task) and own:
        own_task = next((t for t in (loaded, *given) if t is not None and t.name == own), None) or load_task(own)
        if loaded is not None and (other := difference(loaded, own_task)):
            raise BadInput(f"filter {source!r} is for {other}, not for {loaded.name!r}")
        loaded = loaded or own_task
    if loaded is None and len(given) == 1:
        loaded = given[0]
    if loaded is None:
        raise BadInput(f"{source} does not name its task: give it an attribute task, or use --task")
    name = f"{Path(place).stem}-{attribute}" if place.endswith(".py") else source.replace(":", "-")
    return ExternalFilter(adapter, loaded, name, source)


def _inputs(task: Task, episodes: Sequence[Episode], dtype: torch.dtype) -> tuple[dict[str, Tensor], Tensor]:
    """Observations (T, N, ...) by key, images as uint8; controls (T, N, c)."""
    for number, episode in enumerate(episodes):
        check_shapes(task, episode, f"episode {number}")
    observations = {
        key: torch.from_numpy(np.stack([episode.observations[key] for episode in episodes], axis=1))
        for key in task.observations
    }
    controls = torch.from_numpy(np.stack([episode.controls for episode in episodes], axis=1)).to(dtype)
    return {k: v if v.dtype == torch.uint8 else v.to(dtype) for k, v in observations.items()}, controls


def _state_std(task: Task) -> Tensor:
    """(n,) m and rad: standard deviations of the pretrained filters' training states; NaN if there are none."""
    for name in filters_of(task):
        with suppress(BadInput):  # not every filter is pretrained
            return load_checkpoint(shipped(task, name)).filter.statistics.mean_std("state")[1]
    return torch.full((len(task.components),), torch.nan)


def _dtype(module: nn.Module) -> torch.dtype:
    """The floating-point type of the module's parameters and buffers."""
    types = (tensor.dtype for tensor in (*module.parameters(), *module.buffers()) if tensor.is_floating_point())
    return next(types, torch.float32)


def _hash(adapter: Adapter, source: str) -> str:
    """SHA-256 of the adapter's settings, the module's source files and its state dictionary."""
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
