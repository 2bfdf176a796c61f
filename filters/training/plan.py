"""Training schedules: the number of optimiser steps of each stage, and the settings shared by all stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.image_faults import Blackout
from beliefscope.datasets.task import Task

Report = Callable[[str, int, int, float], None]
"""Progress callback, called with the stage's name, steps done, total steps, and the loss."""

BLACKOUTS = (0.0, 0.4, 0.8)
"""Probabilities of an image blackout: one is drawn for each training window."""

EVALUATED_BLACKOUTS = (*BLACKOUTS, 0.95)
"""Probabilities of an image blackout at which a trained filter is evaluated; see ``evaluated_blackouts``."""


@dataclass(frozen=True)
class Plan:
    """Schedule of a training. Counts are optimiser steps and upper limits: see ``patience``.

    Attributes:
        dynamics: for each of ``horizons``, numbers of predicted steps. images: for the image encoders. models: for each
            virtual sensor or likelihood. single: for the filter reduced to one modality, each in turn.
            weights: for the weight model.
        calibration: for the error parameters of an information filter. together: end to end, for each of ``lengths``.
            fine: end to end, image encoders included.
        lengths: of the subsequences in end-to-end stages. window: length in the stages ``single`` and ``weights``.
        batch: subsequences of 16 steps in a batch; shorter ones are proportionally more. particles: in training.
        rate: Adam's learning rate. fine_rate: the same where whole filters train end to end.
        likelihood_weight: weight of the negative log-likelihood relative to the squared error of the mean, end to end.
            With the squared error alone, as in the authors' code, the covariance is not calibrated.
        check: steps between two evaluations of the validation loss. patience: evaluations without improvement that end
            a stage.
    """

    dynamics: int = 150
    images: int = 500
    models: int = 1500
    single: int = 300
    weights: int = 300
    calibration: int = 60
    together: tuple[int, ...] = (100, 150, 250)
    fine: int = 60
    lengths: tuple[int, ...] = (4, 16, 32)
    horizons: tuple[int, ...] = (1, 4, 8, 16)
    window: int = 32
    batch: int = 32
    particles: int = 30
    rate: float = 1e-3
    fine_rate: float = 3e-4
    likelihood_weight: float = 0.05
    check: int = 50
    patience: int = 6


PLANS = {
    "cpu": Plan(),
    "full": Plan(
        dynamics=2000,
        images=8000,
        models=20_000,
        single=1500,
        weights=1500,
        calibration=120,
        together=(1500, 1500, 4000),
        fine=2000,
        batch=64,
        check=250,
    ),
    "smoke": Plan(
        dynamics=2,
        images=2,
        models=2,
        single=1,
        weights=1,
        calibration=1,
        together=(1,),
        fine=1,
        lengths=(4,),
        window=4,
        batch=4,
    ),
}


def evaluated_blackouts(task: Task) -> tuple[float, ...]:
    """``EVALUATED_BLACKOUTS``; only 0 for a task on which ``blackout`` has no image, or none by default."""
    try:
        Blackout().keys(task)
    except BadInput:
        return EVALUATED_BLACKOUTS[:1]
    return EVALUATED_BLACKOUTS


def parse_blackouts(text: str) -> tuple[float, ...]:
    """Probabilities of image blackout from a text such as ``0,0.4,0.8``. Raises BadInput for other values."""
    values = []
    for part in text.split(","):
        try:
            values.append(float(part))
        except ValueError:
            values.append(-1.0)
        if not 0.0 <= values[-1] <= 1.0:
            raise BadInput(f"--blackouts {text!r}: {part!r} is not a probability from 0 to 1")
    return tuple(values)
