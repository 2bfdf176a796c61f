"""Faults of the controls: applied after all faults of sensors, to the controls computed from their readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.fault import Fault, Readings, Span, delay_steps, integer_field, number_field
from beliefscope.datasets.simulation.simulate import CHANGE
from beliefscope.datasets.task import Task


class ControlFault(Fault):
    """A fault of the controls; it changes no observation."""

    sensor = "control"

    def keys(self, task: Task) -> tuple[str, ...]:
        return ()


@dataclass(frozen=True)
class ControlDelayed(ControlFault):
    """The controls are delayed; the first steps repeat the control of step 0."""

    name = "control_delay"
    steps: int = integer_field(3, "steps", "length of the delay")

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        return delay_steps(readings, self.steps)


@dataclass(frozen=True)
class ControlScaled(ControlFault):
    """The change of the hand position in the controls is scaled; of controls without a position, all channels."""

    name = "control_scale"
    factor: float = number_field(0.5, "factor", "scale")
    channel: int | None = integer_field(
        None, "channel", "index of the only scaled channel; default: the change of the hand position, else all"
    )

    def change(self, readings: Readings, span: Span, rng: np.random.Generator) -> Readings:
        scaled, count = readings.copy(), readings.shape[1]
        columns: int | slice = CHANGE if has_position(count) else slice(None)
        if self.channel is not None and self.channel >= count:
            raise BadInput(f"{self} scales a channel that the controls do not have. Available: 0 to {count - 1}.")
        scaled[:, columns if self.channel is None else self.channel] *= self.factor
        return scaled


def has_position(channels: int) -> bool:
    """Whether controls with this number of channels contain the hand's position and its change."""
    return channels >= CHANGE.stop
