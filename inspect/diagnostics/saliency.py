"""Saliency: attribution of one step's result to the pixels and channels of its observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task, display_name, with_unit
from beliefscope.datasets.text import percent
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.engine import Progress
from beliefscope.filters.external.calls import is_stepwise
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.attribution import TOLERANCE, integrate, occlude
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.external_step import ExternalStep
from beliefscope.inspect.diagnostics.single_step import SingleStep, Target, channels_of
from beliefscope.inspect.diagnostics.views import Array, ImagePanel, Table, Value
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.data import check_step
from beliefscope.inspect.traces.replay import Replay

MIN_CHANGE = 0.05
"""cm, degrees, nats: errors are relative to at least this change."""

BASELINES: dict[str, str] = {"gray": "gray images", "black": "black images"}
"""Baseline images; gray is the training mean over all pixels. Baseline of channels: their training mean."""

MEAN = "the mean"
"""Baseline of a filter without images."""


@dataclass(frozen=True)
class Attribution:
    """Attribution relative to one baseline.

    Attributes:
        baseline: name in ``BASELINES``, or ``MEAN``.
        value: target value at the baseline.
        integrated: modality -> (H, W) or (d,) integrated gradients in the target's unit.
        points: number of gradients on the path.
        gap: error of their sum relative to the change of the target, or to ``MIN_CHANGE``.
    """

    baseline: str
    value: float
    integrated: Mapping[str, Array]
    points: int
    gap: float


@dataclass(frozen=True)
class Saliency(Diagnostic):
    """Result of ``saliency`` for one step with K modalities.

    Attributes:
        task, filter, episode, step: identification of the step.
        target: explained quantity.
        unit, factor: display unit and conversion factor.
        value: target value at the step.
        truth: true value if the target is a state component, otherwise None.
        inputs: modality -> (H, W) gray from 0 to 255, or (d,) SI units.
        means: training means of the inputs.
        occlusion: modality -> (H, W) or (d,): decrease of the target when pixels are set to the mean gray, or a channel
            to its mean.
        window: side of the occluded square in pixels.
        attributions: one per baseline; a filter without images has one baseline.
    """

    task: Task
    filter: str
    episode: int
    step: int
    target: str
    unit: str
    factor: float
    value: float
    truth: float | None
    inputs: Mapping[str, Array]
    means: Mapping[str, Array]
    occlusion: Mapping[str, Array]
    window: int
    attributions: tuple[Attribution, ...]

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of image modalities."""
        return tuple(name for name, values in self.inputs.items() if values.ndim == 2)

    @property
    def verdict(self) -> str:
        text = f"At step {self.step} of episode {self.episode}, {self._title} is {self._format(self.value)}"
        if self.truth is not None:
            text += f", error {self._format(self.value - self.truth, '+')}"
        sentences = [f"{text}."]
        for attribution in self.attributions:
            sums = ", ".join(
                f"{name} {self._format(float(values.sum()), '+')}" for name, values in attribution.integrated.items()
            )
            sentence = f"Relative to {self._baseline(attribution)} ({self._format(attribution.value)}): {sums}"
            if strongest := self._strongest(attribution):
                sentence += f"; strongest channel {strongest}"
            sentences.append(f"{sentence}.")
        if not self.attributions:
            return " ".join([*sentences, self._occlusion_sentence()])
        incomplete = [attribution for attribution in self.attributions if attribution.gap >= TOLERANCE]
        sentences += [
            f"Relative to {attribution.baseline}, the integrated gradients miss {percent(attribution.gap, '.1f')} of "
            f"the change after {attribution.points} points and are only approximate."
            for attribution in incomplete
        ]
        if not incomplete:
            worst = max(attribution.gap for attribution in self.attributions)
            sentences.append(f"Integrated gradients are complete within {percent(max(worst, 1e-4), '.2f')}.")
        return " ".join(sentences)

    def _occlusion_sentence(self) -> str:
        """Largest effect of an occluded square or channel of each modality."""
        largest = {name: values.flat[int(np.abs(values).argmax())] for name, values in self.occlusion.items()}
        text = ", ".join(f"{display_name(name)} {self._format(float(value), '+')}" for name, value in largest.items())
        return f"Largest change by one channel or square: {text}; no integrated gradients of an external filter."

    @property
    def _title(self) -> str:
        kind, _, name = self.target.partition(":")
        titles = {"log-likelihood": f"the log-likelihood of {name} relative to its evidence", "beta": f"beta of {name}"}
        return titles.get(kind, display_name(kind))

    def _format(self, value: float, sign: str = "") -> str:
        rounded = round(self.factor * value, self._digits) + 0.0  # avoids -0
        return f"{rounded:{sign}.{self._digits}f} {self.unit}".strip()

    @property
    def _digits(self) -> int:
        return 3 if self.target.startswith("beta") else 2

    def _baseline(self, attribution: Attribution) -> str:
        """Description of the baseline, including channels."""
        vectors = [name for name in self.inputs if name not in self.image_names]
        images = [BASELINES[attribution.baseline]] if self.image_names else []
        return " and ".join(images + [f"mean {name}" for name in vectors])

    def _strongest(self, attribution: Attribution) -> str:
        """The channel with the largest attribution; empty if all round to zero."""
        channels = channels_of(self.task, attribution.integrated)
        candidates = [
            (abs(value), f"{channel.name} ({self._format(float(value), '+')})")
            for modality, names in channels.items()
            for channel, value in zip(names, attribution.integrated[modality], strict=True)
            if round(self.factor * value, self._digits)
        ]
        return max(candidates)[1] if candidates else ""

    def tables(self) -> list[Table]:
        target, tables = with_unit(self.target, self.unit), []
        if self.attributions:
            sums: list[tuple[Value, ...]] = []
            for attribution in self.attributions:
                totals = [self.factor * values.sum() for values in attribution.integrated.values()]
                change = self.factor * (self.value - attribution.value)
                numbers = [*totals, sum(totals), change, 100.0 * attribution.gap]
                sums.append((self._baseline(attribution), *map(_rounded, numbers), attribution.points))
            heads = ("baseline", *self.inputs, "sum", "change", "error (%)", "points")
            tables.append(Table(f"Integrated gradients of {target}, by modality", heads, sums))
        rows: list[tuple[Value, ...]] = []
        for modality, channels in channels_of(self.task, self.inputs).items():
            for i, channel in enumerate(channels):
                display_unit, factor = channel.conversion
                observations = [factor * values[modality][i] for values in (self.inputs, self.means)]
                sources = [*(attribution.integrated for attribution in self.attributions), self.occlusion]
                values = [self.factor * source[modality][i] for source in sources]
                rows.append((modality, channel.name, display_unit, *map(_rounded, [*observations, *values])))
        if rows:
            baselines = [f"relative to {attribution.baseline}" for attribution in self.attributions]
            head = ("modality", "channel", "unit", "value", "training mean", *baselines, "occlusion")
            tables.append(Table(f"Integrated gradients and occlusion of {target}, by channel", head, rows))
        return tables

    def images(self) -> list[ImagePanel]:
        panels = []
        for name in self.image_names:
            panels.append(ImagePanel(f"{name} at step {self.step}", self.inputs[name], "gray", signed=False))
            unit = f"{self.unit}/pixel" if self.unit else "per pixel"
            for attribution in self.attributions:
                title = f"{name}, integrated gradients from {attribution.baseline}"
                panels.append(ImagePanel(title, self.factor * attribution.integrated[name], unit))
            title = f"{name}, occlusion by {self.window} x {self.window} gray pixels"
            panels.append(ImagePanel(title, self.factor * self.occlusion[name], self.unit))
        return panels


def _rounded(value: float) -> float:
    """Rounded to single precision accuracy, without -0."""
    return round(float(value), 4) + 0.0


def saliency(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    target: str | None = None,
    step: int | None = None,
    at: Literal["truth", "estimate"] = "truth",
    window: int = 4,
    progress: Progress = None,
) -> Saliency:
    """Attribute the result of one step to its observations.

    Args:
        traces: of several traces, the one with the largest position error (at the step) is used.
        target: a component of the estimate, ``log-likelihood:MODEL`` or ``beta:MODEL``; by default the component with
            the largest error in training standard deviations.
        step: by default the step with the largest position error after the task's warm-up.
        at: position at which the log-likelihood is evaluated.
        window: side of the occluded square in pixels.

    Raises BadInput for an unknown target, a step outside the trace or an invalid window.
    """
    report = progress or (lambda share: None)
    trace, step = _worst(traces, step)
    single_step: ExternalStep | SingleStep
    if isinstance(checkpoint, ExternalFilter):
        single_step = ExternalStep(checkpoint, trace, step)
    else:
        single_step = SingleStep(Replay(checkpoint, trace, lambda share: report(0.05 * share)), step, at)
    sides = [side for values in single_step.inputs if values.ndim == 3 for side in values.shape[1:]]
    if not 1 <= window <= min(sides, default=window):
        raise BadInput(f"window must be 1 to {min(sides)} pixels, the size of the image, not {window}")
    explained = single_step.target(target or _largest_error(trace, checkpoint, step))
    report(0.05)
    occlusion = occlude(explained, single_step.inputs, single_step.means, window)
    report(0.1)
    attributions = []
    if isinstance(explained, Target):  # the steps of an external filter need not be differentiable
        names = list(BASELINES) if sides else [MEAN]
        for i, name in enumerate(names):
            part = partial(_part, report, i, len(names))
            attributions.append(_attribution(explained, name, part))
            part(1.0)
    with torch.no_grad():
        value = float(explained(*single_step.inputs))
    components = [c.name for c in checkpoint.task.components]
    truth = trace.episode.states[step, components.index(explained.name)] if explained.name in components else None
    return Saliency(
        task=checkpoint.task,
        filter=trace.filter,
        episode=trace.episode_index,
        step=step,
        target=explained.name,
        unit=explained.unit,
        factor=explained.factor,
        value=value,
        truth=None if truth is None else float(truth),
        inputs=_by_modality(single_step, single_step.inputs),
        means=_by_modality(single_step, single_step.means),
        occlusion=_by_modality(single_step, occlusion),
        window=window,
        attributions=tuple(attributions),
    )


def _part(report: Callable[[float], None], index: int, count: int, share: float) -> None:
    """Report the share that is done of one of several attributions, most of the time."""
    report(0.1 + 0.9 * (index + share) / count)


def _attribution(explained: Target, name: str, progress: Progress) -> Attribution:
    """Integrated gradients from the baseline of this name."""
    step = explained.step
    baselines = step.baseline(black=name == "black")
    integrated, points, gap = integrate(explained, step.inputs, baselines, MIN_CHANGE / explained.factor, progress)
    with torch.no_grad():
        value = float(explained(*baselines))
    return Attribution(name, value, _by_modality(step, integrated), points, gap)


def _by_modality(step: ExternalStep | SingleStep, values: tuple[Tensor, ...]) -> Mapping[str, Array]:
    """Modality -> its values, (1, ...) to (...)."""
    return {name: value[0].detach().double().numpy() for name, value in zip(step.modalities, values, strict=True)}


def _worst(traces: Sequence[Trace], step: int | None) -> tuple[Trace, int]:
    """The trace with the largest position error and its step, or the largest error at a given step."""
    if step is not None:
        candidates = [trace for trace in traces if 0 <= step < len(trace)]
        if not candidates:
            check_step(step, max(map(len, traces)))
        return max(candidates, key=lambda trace: measures.main_error(trace)[step, -1]), step
    scores = [np.where(measures.counted(trace), measures.main_error(trace)[:, -1], -1.0) for trace in traces]
    worst = int(np.argmax([score.max() for score in scores]))
    return traces[worst], int(scores[worst].argmax())


def _largest_error(trace: Trace, checkpoint: Checkpoint, step: int) -> str:
    """The component of the fused estimate with the largest error, in training standard deviations or by its RMSE."""
    error = np.abs(measures.errors(trace)[:, -1])
    if not isinstance(checkpoint, ExternalFilter):
        _, std = checkpoint.filter.statistics.mean_std("state")
        return checkpoint.task.components[int((error[step] / std.numpy()).argmax())].name
    relative = error[step] / np.maximum(np.sqrt(np.square(error).mean(0)), 1e-12)
    return checkpoint.task.components[int(np.nan_to_num(relative).argmax())].name


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """One-line reason why the diagnostic does not apply, or None."""
    if isinstance(checkpoint, ExternalFilter):
        if not is_stepwise(checkpoint.adapter.module):
            return f"filter {trace.filter} processes all steps at once"
        try:
            checkpoint.snapshot()
        except BadInput as error:
            return str(error)
    return None


ENTRY = Entry(
    name="saliency",
    title="Saliency",
    question="Which pixels and which channels of the other sensors determined the result of a step?",
    run=saliency,
    why_not=why_not,
    needs="filter",
    slow=True,
    options={
        "step": "step of the episode; by default the one with the largest position error",
        "target": "a component of the estimate, log-likelihood:MODALITY or beta:MODALITY; by default the component "
        "with the largest error",
        "at": "position of the log-likelihood: truth, the default, or estimate",
        "window": "side of the occluded square in pixels, 4 by default",
    },
)
