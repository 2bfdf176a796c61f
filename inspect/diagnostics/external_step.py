"""One step of an external filter, repeated with other inputs from the state before it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.errors import check_name
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.external.calls import dtype_of, inputs_of, seeded
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.data import check_origin, check_step


class ExternalStep:
    """A step of a repeated run, with the random numbers of the trace; the interface of ``SingleStep``.

    Attributes:
        modalities: the task's modalities.
        inputs: observation of each modality, (1, H, W) or (1, d), float. means: their means over the episode.
    """

    def __init__(self, external: ExternalFilter, trace: Trace, step: int) -> None:
        """Raises BadInput if the trace is of another filter, or the filter cannot return to the state."""
        check_origin(external, trace)
        check_step(step, len(trace))
        task, self._external = trace.task, external
        self._components = [component.name for component in task.components]
        self.modalities = tuple(task.modalities)
        readings = Steps.from_episodes(task, [trace.episode]).episode(0).observations
        series = [readings[name].float() for name in self.modalities]
        self.inputs = tuple(values[step] for values in series)
        self.means = tuple(values.nanmean(0) for values in series)
        observations, controls = inputs_of(task, [trace.episode], dtype_of(external.adapter.module))
        self._observations, self._controls = {k: v[step] for k, v in observations.items()}, controls[step]
        before = external.live(trace.episode, trace.seed)
        for _ in range(step):
            next(before)
        if not step:
            external.begin(trace.episode)
        self._state = external.snapshot()
        self._random = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002 - the filter's generators
        before.close()  # restores the generators

    def target(self, name: str) -> ExternalTarget:
        """Target function of a component of the estimate. Raises BadInput for another name."""
        check_name(f"target of filter {self._external.name!r}", name, self._components)
        return ExternalTarget(self, self._external.task, name)

    def estimates(self, *inputs: Tensor) -> Tensor:
        """(B, n) SI units: estimates of the step with other inputs, (B, ...) each, one after another."""
        rows = []
        with seeded(0, self._external.adapter.module):  # restores the generators
            for i in range(len(inputs[0])):
                self._external.restore(self._state)
                torch.set_rng_state(self._random[0])
                np.random.set_state(self._random[1])  # noqa: NPY002
                values = self._external.step(self._keys([values[i : i + 1] for values in inputs]), self._controls)
                rows.append(values["estimate_mean"][0])
        return torch.stack(rows)

    def _keys(self, inputs: list[Tensor]) -> dict[str, Tensor]:
        """Observations by key of the readings of the modalities, in their original types."""
        observations = dict(self._observations)
        for name, values in zip(self.modalities, inputs, strict=True):
            keys = self._external.task.modalities[name]
            sizes = [self._external.task.observations[key][0] for key in keys]
            parts = [values] if values.ndim == 3 else values.split(sizes, dim=-1)
            for key, part in zip(keys, parts, strict=True):
                like = observations[key]
                rounded = part.round().clamp(0, 255) if like.dtype == torch.uint8 else part
                observations[key] = rounded.to(like.dtype).reshape(like.shape)
        return observations


class ExternalTarget:
    """Function of the inputs of a step: a component of the estimate, (B,); the interface of ``Target``."""

    def __init__(self, step: ExternalStep, task: Task, name: str) -> None:
        self.name, self._step, self._component = name, step, task.index(name)
        self.unit, self.factor = task.components[self._component].conversion

    def __call__(self, *inputs: Tensor) -> Tensor:
        return self._step.estimates(*inputs)[:, self._component]
