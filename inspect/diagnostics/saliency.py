"""Saliency: which pixels and which channels of one step's observations decided what the filter made of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Array, Diagnostic, Entry, Picture, Table, Value
from beliefscope.inspect.diagnostics.shapley import seen
from beliefscope.inspect.diagnostics.single_step import Moment, channel_names
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.replay import Replay

COMPLETE = 0.02
"""Integrated gradients may miss the change that they explain by this share of it, and no more."""

LEAST = 0.05
"""cm, degrees, nats: a smaller change is as good as one of this size, and its missing parts are shares of this."""

PIECES, POINTS, MOST_POINTS = 8, 4, 2048
"""Of the path from a baseline at first; gradients on each piece; and on all pieces in the end at most."""

AT_ONCE = 64
"""Copies of the step that are run as one batch."""

BASELINES: dict[str, str] = {"gray": "gray pictures", "black": "black pictures"}
"""What pictures are compared with; gray is the training mean, over all pixels. Channels: their training mean."""

MEAN = "the mean"
"""The baseline of a filter without pictures."""


@dataclass(frozen=True)
class Compared:
    """The step's observations against one baseline.

    Attributes:
        baseline: name in ``BASELINES``, or ``MEAN``. value: the target there.
        integrated: modality -> (H, W) or (d,): integrated gradients from the baseline, in the target's unit.
        points: gradients on the path. gap: share of the change in the target that they may miss, or of ``LEAST``.
    """

    baseline: str
    value: float
    integrated: Mapping[str, Array]
    points: int
    gap: float


@dataclass(frozen=True)
class Saliency(Diagnostic):
    """Result of ``saliency``: of one step, K modalities.

    Attributes:
        task, filter, episode, step: whose step it is.
        target: what is explained. unit, factor: in which it is shown, and from the units inside.
        value: the target at the step. truth: of a component of the state, else None.
        inputs: modality -> (H, W) gray from 0 to 255, or (d,) SI units: what was seen. means: of the training set.
        occlusion: modality -> (H, W) or (d,): the target less what it is with some pixels at the mean gray, or a
            channel at its mean. window: pixels along a side of what is occluded.
        compared: one a baseline; a filter without pictures has one.
    """

    task: str
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
    compared: tuple[Compared, ...]

    @property
    def pictured(self) -> tuple[str, ...]:
        """The modalities that are pictures."""
        return tuple(name for name, values in self.inputs.items() if values.ndim == 2)

    @property
    def verdict(self) -> str:
        text = f"At step {self.step} of episode {self.episode} {self._titled} is {self._said(self.value)}"
        if self.truth is not None:
            text += f", {self._said(self.value - self.truth, '+')} off the truth"
        sentences = [f"{text}."]
        for one in self.compared:
            sums = ", ".join(
                f"{name} {self._said(float(values.sum()), '+')}" for name, values in one.integrated.items()
            )
            sentence = f"From {self._baseline(one)} ({self._said(one.value)}): {sums}"
            if strongest := self._strongest(one):
                sentence += f", most of all channels {strongest}"
            sentences.append(f"{sentence}.")
        for one in self.compared:
            if one.gap >= COMPLETE:
                sentences.append(
                    f"From {one.baseline} the integrated gradients miss {100.0 * one.gap:.1f} % of the change after "
                    f"{one.points} points: a sketch, no account."
                )
        if not any(one.gap >= COMPLETE for one in self.compared):
            worst = max(one.gap for one in self.compared)
            sentences.append(f"Integrated gradients are complete within {max(100.0 * worst, 0.01):.2f} %.")
        return " ".join(sentences)

    @property
    def _titled(self) -> str:
        kind, _, name = self.target.partition(":")
        return {"log-likelihood": f"the log-likelihood of {name}", "beta": f"beta of {name}"}.get(kind, kind)

    def _said(self, value: float, sign: str = "") -> str:
        shown = round(self.factor * value, self._digits) + 0.0  # which makes -0 to 0
        return f"{shown:{sign}.{self._digits}f} {self.unit}".strip()

    @property
    def _digits(self) -> int:
        return 3 if self.target.startswith("beta") else 2

    def _baseline(self, one: Compared) -> str:
        """The baseline in words, channels included."""
        felt = [name for name in self.inputs if name not in self.pictured]
        pictures = [BASELINES[one.baseline]] if self.pictured else []
        return " and ".join(pictures + [f"mean {name}" for name in felt])

    def _strongest(self, one: Compared) -> str:
        """The channel with the largest attribution; empty where none is large enough to show."""
        channels = channel_names(find_task(self.task), one.integrated)
        found = [
            (abs(value), f"{channel.name} ({self._said(float(value), '+')})")
            for modality, names in channels.items()
            for channel, value in zip(names, one.integrated[modality], strict=True)
            if round(self.factor * value, self._digits)
        ]
        return max(found)[1] if found else ""

    def tables(self) -> list[Table]:
        unit = f" ({self.unit})" if self.unit else ""
        sums: list[tuple[Value, ...]] = []
        for one in self.compared:
            each = [self.factor * values.sum() for values in one.integrated.values()]
            numbers = [*each, sum(each), self.factor * (self.value - one.value), 100.0 * one.gap]
            sums.append((self._baseline(one), *map(_rounded, numbers), one.points))
        tables = [
            Table(
                f"Integrated gradients of {self.target}{unit}, by modality",
                ("from", *self.inputs, "sum", "change to explain", "missed (%)", "points"),
                tuple(sums),
            )
        ]
        rows: list[tuple[Value, ...]] = []
        for modality, channels in channel_names(find_task(self.task), self.inputs).items():
            for i, channel in enumerate(channels):
                seen = [channel.factor * values[modality][i] for values in (self.inputs, self.means)]
                found = [*(one.integrated for one in self.compared), self.occlusion]
                parts = [self.factor * values[modality][i] for values in found]
                rows.append((modality, channel.name, channel.unit, *map(_rounded, [*seen, *parts])))
        if rows:
            paths_of = [f"from {one.baseline}" for one in self.compared]
            head = ("modality", "channel", "unit", "value", "training mean", *paths_of, "put to its mean")
            tables.append(
                Table(f"Integrated gradients and occlusion of {self.target}{unit}, by channel", head, tuple(rows))
            )
        return tables

    def pictures(self) -> list[Picture]:
        shown = []
        for name in self.pictured:
            shown.append(Picture(f"{name} at step {self.step}", self.inputs[name], "gray", signed=False))
            for one in self.compared:
                title = f"{name}, integrated from {one.baseline}"
                shown.append(
                    Picture(
                        title, self.factor * one.integrated[name], f"{self.unit}/pixel" if self.unit else "per pixel"
                    )
                )
            title = f"{name}, occluded {self.window} x {self.window} by gray"
            shown.append(Picture(title, self.factor * self.occlusion[name], self.unit))
        return shown


def _rounded(value: float) -> float:
    """To what single precision leaves of a small change; -0 is 0."""
    return round(float(value), 4) + 0.0


def integrate(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], baselines: tuple[Tensor, ...], least: float
) -> tuple[tuple[Tensor, ...], int, float]:
    """Integrated gradients ``(x_i - b_i) mean over a of df/dx_i(b + a (x - b))`` (Sundararajan et al., 2017).

    They sum to ``f(x) - f(b)``, on every piece of the path as on the whole. Pieces whose sums are off are halved until
    what is off adds up to less than ``COMPLETE`` of the change, and its root of summed squares as well, lest it cancel
    by chance; or until another round would take more than ``MOST_POINTS`` gradients.

    Args:
        function: batches (B, ...) of the inputs to (B,). inputs, baselines: (1, ...) each.
        least: a change that is smaller counts as so large.

    Returns:
        Attributions (1, ...), the gradients taken, and the share of the change that they may miss.
    """
    from captum.attr import IntegratedGradients  # which takes seconds to import

    method = IntegratedGradients(function)

    def on_path(along: Tensor) -> tuple[Tensor, ...]:
        return tuple(
            b + along.to(b.dtype).reshape(-1, *(1,) * (b.ndim - 1)) * (x - b)
            for x, b in zip(inputs, baselines, strict=True)
        )

    def of_pieces(edges: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Attributions (P, ...) of pieces from edges[:, 0] to edges[:, 1], and by how much their sums are off (P,)."""
        ends, starts = on_path(edges[:, 1]), on_path(edges[:, 0])
        found = method.attribute(ends, starts, n_steps=POINTS, method="gausslegendre")
        with torch.no_grad():
            change = (function(*ends) - function(*starts)).double()
        return found, sum(one.flatten(1).double().sum(1) for one in found) - change

    with torch.no_grad():
        whole = max(abs(float(function(*inputs) - function(*baselines))), least)
    along = torch.linspace(0.0, 1.0, PIECES + 1, dtype=torch.float64)
    edges = torch.stack([along[:-1], along[1:]], dim=1)
    total = [torch.zeros_like(one) for one in inputs]
    settled, points = torch.zeros(0, dtype=torch.float64), 0
    while len(edges):
        made = [of_pieces(part) for part in edges.split(AT_ONCE // POINTS)]
        off = torch.cat([off for _, off in made])
        points += POINTS * len(edges)
        every = torch.cat([settled, off])
        gap = max(abs(float(every.sum())), float(every.norm())) / whole
        bad = off.abs() > min(0.5 * COMPLETE * whole / len(every) ** 0.5, float(off.abs().median()))
        if gap < COMPLETE or points + 2 * POINTS * int(bad.sum()) > MOST_POINTS:
            bad = torch.zeros_like(bad)
        settled = torch.cat([settled, off[~bad]])
        for i, one in enumerate(total):
            one += torch.cat([found[i] for found, _ in made])[~bad].sum(0)
        middle = edges[bad].mean(1, keepdim=True)
        edges = torch.cat([torch.cat([edges[bad, :1], middle], 1), torch.cat([middle, edges[bad, 1:]], 1)])
    return tuple(total), points, gap


@torch.no_grad()
def occlude(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], baselines: tuple[Tensor, ...], window: int
) -> tuple[Tensor, ...]:
    """Occlusion: ``f(x)`` less f with a square of ``window`` pixels, or one channel, at its baseline.

    Squares overlap by half; a pixel has the mean of those that cover it (Zeiler and Fergus, 2014).

    Args: as ``integrate``. Returns: (1, ...) each.
    """
    from captum.attr import Occlusion

    pictures = [values.ndim == 3 for values in inputs]
    found: tuple[Tensor, ...] = Occlusion(function).attribute(
        inputs,
        sliding_window_shapes=tuple((window, window) if picture else (1,) for picture in pictures),
        strides=tuple(max(1, window // 2) if picture else 1 for picture in pictures),
        baselines=baselines,
        perturbations_per_eval=AT_ONCE,
    )
    return found


def saliency(
    traces: Sequence[Trace],
    checkpoint: Checkpoint,
    target: str | None = None,
    step: int | None = None,
    at: Literal["truth", "estimate"] = "truth",
    window: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Saliency:
    """What decided at one step. Of several traces, that with the largest position error (at the step) is taken.

    Args:
        target: a component of the estimate, ``log-likelihood:MODEL`` or ``beta:MODEL``; by default the component that
            is farthest off, in its training standard deviations.
        step: by default the one with the largest position error, the first ``LEFT_OUT`` left out.
        at: where the log-likelihood is taken. window: pixels along a side of what is occluded.

    Raises BadInput for a target, step or window that there is not.
    """
    say = progress or (lambda share: None)
    trace, step = _worst(traces, step)
    replay = Replay(checkpoint, trace, lambda share: say(0.2 * share))
    replay.check_step(step)
    moment = Moment(replay, step, at)
    sides = [side for one in moment.inputs if one.ndim == 3 for side in one.shape[1:]]
    if not 1 <= window <= min(sides, default=window):
        raise BadInput(f"window is {window} pixels: the picture has {min(sides)}, and 1 is the least")
    component = _farthest_off(trace, checkpoint, step)
    chosen = moment.target(target or component)
    say(0.2)
    average = moment.baseline(black=False)
    occlusion = occlude(chosen, moment.inputs, average, window)
    say(0.3)
    kinds = list(BASELINES) if sides else [MEAN]
    compared = []
    for i, kind in enumerate(kinds):
        baselines = moment.baseline(black=kind == "black")
        integrated, points, gap = integrate(chosen, moment.inputs, baselines, LEAST / chosen.factor)
        with torch.no_grad():
            value = float(chosen(*baselines))
        compared.append(Compared(kind, value, moment.named(integrated), points, gap))
        say(0.3 + 0.7 * (i + 1) / len(kinds))
    with torch.no_grad():
        value = float(chosen(*moment.inputs))
    names = [c.name for c in checkpoint.task.components]
    return Saliency(
        task=checkpoint.task.name,
        filter=trace.filter,
        episode=trace.episode_index,
        step=step,
        target=chosen.name,
        unit=chosen.unit,
        factor=chosen.factor,
        value=value,
        truth=float(trace.episode.states[step, names.index(chosen.name)]) if chosen.name in names else None,
        inputs=moment.named(moment.inputs),
        means=moment.named(average),
        occlusion=moment.named(occlusion),
        window=window,
        compared=tuple(compared),
    )


def _worst(traces: Sequence[Trace], step: int | None) -> tuple[Trace, int]:
    """The trace and step with the largest position error, at the step where one is given."""
    if step is not None:
        having = [trace for trace in traces if 0 <= step < len(trace)]
        if not having:
            longest = max(map(len, traces))
            raise BadInput(f"step {step} is not in this trace: it has steps 0 to {longest - 1}")
        return max(having, key=lambda trace: measures.position_error(trace)[step, -1]), step
    scores = [np.where(measures.counted(trace), measures.position_error(trace)[:, -1], -1.0) for trace in traces]
    worst = int(np.argmax([score.max() for score in scores]))
    return traces[worst], int(scores[worst].argmax())


def _farthest_off(trace: Trace, checkpoint: Checkpoint, step: int) -> str:
    """The component of the fused estimate that is farthest off, in training standard deviations."""
    _, std = checkpoint.filter.statistics.mean_std("state")
    off = np.abs(measures.errors(trace)[step, -1]) / std.numpy()
    return checkpoint.task.components[int(off.argmax())].name


def why_not(trace: Trace, checkpoint: Checkpoint | None) -> str | None:
    """None where it can be made; raises BadInput of a filter from outside, whose steps cannot be taken one by one."""
    if checkpoint is not None:
        seen(checkpoint.filter)
    return None


ENTRY = Entry(
    name="saliency",
    title="Saliency",
    question="Which pixels, and which channels of touch, decided what the filter made of one step?",
    run=saliency,
    why_not=why_not,
    needs="checkpoint",
    slow=True,
    options={
        "step": "which step; by default the one with the largest position error",
        "target": "a component of the estimate, log-likelihood:MODALITY or beta:MODALITY; by default the component "
        "that is farthest off",
        "at": "where the log-likelihood is taken: truth, the default, or estimate",
        "window": "pixels along a side of what is put to the mean gray, 4 by default",
    },
)
