"""External filters: Python objects that follow a small contract, or torchfilter's interface.

The contract (examples in ``docs/own_filter.md``):

* ``filter.initialize_beliefs(mean=, covariance=)`` starts N trajectories, (N, n) and (N, n, n); without parameters, the
  filter supplies its own initial belief and may return it. A filter with this method is then called step by step,
  ``filter(observations=, controls=)``: a dictionary of (N, ...) by the task's observation keys, and (N, c). A filter
  without it is called once for all steps, with (T, N, ...) and (T, N, c). Instead of ``__call__`` it may have
  ``forward``.
* It returns the mean (N, n), a pair of mean and covariance (N, n, n), or a dictionary with the keys of
  ``adapter.SHAPES`` and ``extra``; with a leading axis T if called once for all steps.
* With ``Adapter(batched=False)``, no array has the axis N.
* ``get_state()`` and ``set_state(state)`` are optional: by default all attributes but parameters are copied.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, type_name
from beliefscope.datasets.io import user_code
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.batch import start_offset
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.adapter import (
    SHAPES,
    Adapter,
    FailedStep,
    Units,
    Values,
    check_values,
    copied,
    model_names,
    named_values,
)
from beliefscope.filters.external.calls import (
    call,
    described,
    device_of,
    dtype_of,
    evaluation_mode,
    has_own_start,
    initialize,
    inputs_of,
    is_stepwise,
    kept_generators,
    restore,
    seeded,
    snapshot,
    steps_of,
    takes_file,
    with_advice,
)
from beliefscope.filters.external.derived_values import derived
from beliefscope.filters.external.fingerprint import fingerprint
from beliefscope.filters.external.module_weights import load_weights, pretrained_std
from beliefscope.filters.external.step_values import StepValues, check_steps, stacked, with_ancestors
from beliefscope.filters.external.torchfilter_hooks import Capture
from beliefscope.filters.filter import Filter
from beliefscope.filters.names import code_parts, external_name
from beliefscope.filters.rollout import START_VARIANCE


class ExternalFilter(Checkpoint):
    """An external filter as a checkpoint: it can be traced, evaluated and displayed, but not stepped by the caller.

    Attributes:
        adapter: the filter and its conventions. source: its origin, as given by the user.
        hash: SHA-256 of its class, of the files of its classes and of its parameters: the same in Python and on the
            command line.
    """

    def __init__(self, adapter: Adapter, task: Task, name: str, source: str = "") -> None:
        """Raises BadInput if the adapter does not fit the task."""
        values = {
            "name": name,
            "record": {"source": source or name},
            "hash": fingerprint(adapter),
            "adapter": adapter,
            "source": source or name,
            "_task": task,
            "_units": Units(task, adapter),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)  # a checkpoint is frozen
        if isinstance(adapter.module, nn.Module):
            evaluation_mode(adapter.module, name)

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

        The variance of components that start at the truth is ``initial_std`` squared, or else 0.1 in the adapter's
        standardised units, or in those of the task's pretrained filters. It is NaN if there are neither. A filter with
        a start of its own is initialised, and its belief is NaN as far as it returns none.
        """
        if has_own_start(self.adapter.module):
            return self._own_start(len(episodes))
        means = [episode.states[0] + start_offset(self._task, episode) for episode in episodes]
        mean = torch.from_numpy(np.stack(means)).float()
        if self._units.initial_std is not None:
            own = self._units.initial_std.float() ** 2
        else:
            own = START_VARIANCE * (self._units.std if self.adapter.std else pretrained_std(self._task)).float() ** 2
        variance = torch.from_numpy(self._task.start_variance()).float()
        variance = torch.where(variance.isnan(), own, variance)
        return Gaussian(mean, torch.diag(variance).expand(len(mean), -1, -1))

    def _own_start(self, count: int) -> Gaussian:
        n = len(self._task.components)
        with self._errors_at("initialize_beliefs"):
            belief = initialize(self.adapter.module)
            values = {} if belief is None else named_values(belief, self.source, self._task)
            values = {name: value.expand(count, *value.shape[-len(SHAPES[name]) :]) for name, value in values.items()}
        values = self._units.to_si(check_values(values, (count,), {"n": n}, f"{self.source} at initialize_beliefs"))
        unknown = torch.full((count, n, n), torch.nan)
        return Gaussian(values.get("estimate_mean", unknown[..., 0]), values.get("estimate_covariance", unknown))

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.name} of task {self.task.name}, {self.hash[:12]}>"

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
        filter_, batched, n = self.adapter.module, self.adapter.batched, len(self._task.components)
        belief = self._belief(start or self.start(episodes)) if is_stepwise(filter_) else ()
        observations, controls = inputs_of(self._task, episodes, dtype_of(filter_))
        groups: Sequence[Any] = [slice(None)] if batched else range(len(episodes))  # an index removes the axis N
        runs: list[tuple[Values, tuple[int, ...]]] = []
        steps: list[list[Values]] = []  # of each run
        report = progress or (lambda done: None)
        with torch.no_grad(), kept_generators(filter_) as seed_generators, with_advice(filter_, episodes):
            try:
                for number, group in enumerate(groups):
                    seed_generators(seed)
                    share = partial(lambda number, done: report((number + done) / len(groups)), number)
                    inputs, first = _at(group, observations, controls), [part[group] for part in belief]
                    runs.append(self._run(*inputs, first, steps, share))
                values = runs[0][0] if batched else stacked([values for values, _ in runs], dim=1)
                check_values(values, controls.shape[:2], {"n": n}, f"{self.source} over all steps")
            except (BadInput, RuntimeError):  # torch.stack refuses different shapes
                # An invalid value is the likely cause.
                check_steps(steps, controls[0, groups[0]].shape[:-1], {"n": n}, self.source)
                raise
        return derived(self._units.to_si(values), self._task), self._names(values, runs[0][1])

    def _run(
        self,
        observations: Values,
        controls: Tensor,
        belief: Sequence[Tensor],
        steps: list[list[Values]],
        progress: Callable[[float], None],
    ) -> tuple[Values, tuple[int, ...]]:
        """Unchecked values by one call of a filter of whole sequences, or by T calls, whose values ``steps`` receives.

        They are in the filter's units and, as the inputs, (T, N, ...), or (T, ...) without the axis N.
        """
        models: tuple[int, ...] = ()
        if not is_stepwise(self.adapter.module):
            with self._errors_at("all steps"):
                values = copied(self._values(observations, controls, device_of(self.adapter.module)))
            progress(1.0)
            return values, models
        record = StepValues(len(controls))
        steps.append(record.steps)
        for values, models in self._steps(observations, controls, belief):  # noqa: B007
            record.append(values)
            progress(len(record.steps) / len(controls))
        return record.stacked(), models

    def live(self, episode: Episode, seed: int = 0) -> Generator[tuple[Values, tuple[str, ...]]]:
        """Like ``run`` for one episode, as an iterator over steps: (N, ...) with N = 1, and the models' names.

        Raises BadInput as ``run``, and for a filter that processes whole sequences.
        """
        if not is_stepwise(self.adapter.module):
            reason = "it processes all steps at once, and cannot run live"
            raise BadInput(f"{self.source} has no initialize_beliefs: {reason}")
        observations, controls = inputs_of(self._task, [episode], dtype_of(self.adapter.module))
        with torch.no_grad(), seeded(seed, self.adapter.module):
            sizes, batched = {"n": len(self._task.components)}, self.adapter.batched
            inputs = _at(slice(None) if batched else 0, observations, controls)
            for t, (values, models) in enumerate(self._steps(*inputs, self._single(episode))):
                values = values if batched else stacked([values])
                step = check_values(with_ancestors(values), (1,), sizes, f"{self.source} at step {t}", t)
                yield self._units.to_si(copied(step)), self._names({n: v[None] for n, v in step.items()}, models)

    def own_states(self, states: Tensor, dtype: torch.dtype) -> Tensor:
        """States (C, n) in SI units, in the filter's own."""
        return self._units.states_from_si(states, dtype)

    def begin(self, episode: Episode) -> None:
        """Initialises the filter for an episode. Raises BadInput as ``run``."""
        with torch.no_grad():
            self._initialize(self._single(episode))

    def step(self, observations: Mapping[str, Tensor], controls: Tensor) -> Values:
        """Returned values of one more step from the filter's state, (N, ...), SI units. Raises BadInput as ``run``."""
        batched, device, leading = self.adapter.batched, device_of(self.adapter.module), controls.shape[:1]
        if not batched:
            observations, controls = {key: value[0] for key, value in observations.items()}, controls[0]
        with torch.no_grad(), self._errors_at("one step"):
            values = self._values(observations, controls, device)
            output = copied(values) if batched else stacked([values])
        return self._units.to_si(check_values(output, leading, {"n": len(self._task.components)}, self.source))

    def snapshot(self) -> Any:
        """The filter's state, for ``restore``. Raises BadInput if it can be neither returned nor copied."""
        return snapshot(self.adapter.module, self.source)

    def restore(self, state: Any) -> None:
        """Returns the filter to a state of ``snapshot``, which stays valid."""
        restore(self.adapter.module, state)

    def _steps(
        self, observations: Mapping[str, Tensor], controls: Tensor, belief: Sequence[Tensor]
    ) -> Iterator[tuple[Values, tuple[int, ...]]]:
        """The unchecked values of each step, in the filter's units, and the indices of the participating models."""
        self._initialize(belief)
        filter_ = self.adapter.module
        recorded = filter_ if isinstance(filter_, nn.Module) and self.adapter.batched else None
        device = device_of(filter_)
        with Capture(recorded) as capture:
            for t, (inputs, control) in enumerate(steps_of(observations, controls)):
                try:
                    output = self._values(inputs, control, device)
                    values = capture.step(output["estimate_mean"]) | output
                except BadInput:
                    raise
                except Exception as error:
                    raise FailedStep(str(self._error(f"step {t}", error)), t) from error
                yield values, capture.models

    def _initialize(self, belief: Sequence[Tensor]) -> None:
        with self._errors_at("initialize_beliefs"):
            initialize(self.adapter.module, *belief)

    def _single(self, episode: Episode) -> Sequence[Tensor]:
        """The first belief of an episode as the filter takes it: with the axis N = 1 or, if it takes none, without."""
        belief = self._belief(self.start([episode]))
        return belief if self.adapter.batched else [part[0] for part in belief]

    def _belief(self, start: Gaussian) -> Sequence[Tensor]:
        """Mean (N, n) and covariance (N, n, n) in the filter's units; none for a filter with a start of its own."""
        if has_own_start(self.adapter.module):
            return ()
        if start.covariance.isnan().any():
            raise BadInput(
                f"{self.source} needs an initial covariance, and task {self._task.name!r} has no pretrained filter to "
                "take it from: give Adapter(module, initial_std=...), or an initialize_beliefs without parameters"
            )
        return self._units.from_si(start, dtype_of(self.adapter.module))

    def _values(self, observations: Mapping[str, Tensor], controls: Tensor, device: torch.device) -> Values:
        """The filter's output by name, for inputs that have the axis N only if the filter takes it."""
        return named_values(call(self.adapter, observations, controls, device), self.source, self._task)

    @contextmanager
    def _errors_at(self, where: str) -> Iterator[None]:
        """Turns exceptions of the module into BadInput with the location."""
        try:
            yield
        except BadInput:
            raise
        except Exception as error:
            raise self._error(where, error) from error

    def _error(self, where: str, error: Exception) -> BadInput:
        return BadInput(f"{self.source} {described(error, where, self.adapter, self._task)}")

    def _names(self, values: Values, models: tuple[int, ...]) -> tuple[str, ...]:
        return model_names(values, 2, self.adapter.modalities, self._task, models, self.source)


def _at(index: Any, observations: Mapping[str, Tensor], controls: Tensor) -> tuple[Values, Tensor]:
    """Inputs (T, N, ...) of some of the N episodes; of one of them, without the axis N."""
    return {key: value[:, index] for key, value in observations.items()}, controls[:, index]


def load_external(
    source: str, task: str | Task = "", given: Sequence[Task] = (), named: Sequence[Task] = ()
) -> ExternalFilter:
    """The filter that ``FILE.py:FUNCTION`` or ``MODULE:FUNCTION`` returns when called.

    The global generators of torch and NumPy are seeded for the call. ``FILE.py:FUNCTION@FILE.safetensors`` loads
    weights into the module, such as those of a fine-tuning run; a function with a parameter receives their path.

    Args:
        task: of the filter. Default: ``Adapter.task`` or an attribute ``task``, else the only given task.
        given: user-defined tasks that the filter may name. named: further ones, which are never the default.

    Raises:
        BadInput: the name does not exist, the call fails or does not return a filter, or the task differs.
    """
    place, attribute, weights = code_parts(source)
    with user_code.importable(place):
        module = user_code.load_module(place)
        build = getattr(module, attribute, None)
        if not callable(build):
            problem = f"has no {attribute!r}" if build is None else f"has {attribute!r}, which is not callable"
            raise BadInput(f"{place} {problem}. Available: {', '.join(user_code.functions_of(module)) or 'none'}.")
        if (takes_weights := takes_file(build)) and not weights:
            raise BadInput(f"{source} needs weights: {place}:{attribute}@FILE.safetensors")
        try:
            with seeded(0, None):  # the same parameters, and so the same hash, in every process
                result = build(*[Path(weights)] * takes_weights)
        except Exception as error:
            raise BadInput(f"{source} fails when called: {type(error).__name__}: {error}") from error
    if weights:
        load_weights(result.module if isinstance(result, Adapter) else result, Path(weights), place)
    return as_external(result, source, task, given, external_name(source), named)


def as_external(
    filter_: object,
    source: str,
    task: str | Task = "",
    given: Sequence[Task] = (),
    name: str = "",
    named: Sequence[Task] = (),
) -> ExternalFilter:
    """A filter of another project, or an ``Adapter`` of one, as a checkpoint.

    Args:
        source: its origin, for messages and the hash. task, given, named: as for ``load_external``.
        name: default: the source.

    Raises BadInput if it is not a filter, or if it does not fit the task.
    """
    adapter = filter_ if isinstance(filter_, Adapter) else Adapter(filter_)
    if not callable(adapter.module) and not hasattr(adapter.module, "forward"):
        raise BadInput(
            f"{source} returns {type_name(adapter.module)}, expected a filter, which can be called or has "
            "forward, or an Adapter of one"
        )
    loaded = load_task(task) if task else None
    own = adapter.task or getattr(adapter.module, "task", "")
    if isinstance(own, str | Task) and own:
        tasks = (*filter(None, [loaded]), *given, *named)
        own_task = next((t for t in tasks if t.name == own), None) or load_task(own)
        if loaded is not None and (other := difference(loaded, own_task)):
            raise BadInput(f"filter {source!r} is for {other}, not for {loaded.name!r}")
        loaded = loaded or own_task
    if loaded is None and len(given) == 1:
        loaded = given[0]
    if loaded is None:
        raise BadInput(f"{source} does not name its task: give it an attribute task, or use --task")
    return ExternalFilter(adapter, loaded, name or source, source)
