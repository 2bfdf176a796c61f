"""Likelihoods that an external particle filter reports, over its particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import axis_name
from beliefscope.inspect.diagnosis.checks.innovations import MIN_STEPS
from beliefscope.inspect.statistics.measures import absent, counted
from beliefscope.inspect.statistics.reading_features import Indices
from beliefscope.inspect.statistics.reading_model import ReadingModel, readings_of
from beliefscope.inspect.statistics.signals import NEAR_TURN, TURN, Array, wrapped
from beliefscope.inspect.trace import Trace

LIKELIHOODS, PARTICLES = 200, 60
"""Largest numbers of steps and of particles whose likelihoods are compared, evenly spaced."""

KNOWN = 0.5
"""Smallest share of the particles of a step with expected readings."""

TURNED = 1000
"""Largest number of particles by step whose likelihoods show a jump."""

NEAR = 3.0
"""Largest error of the reading expected at the nearest particle, relative to its noise: far from the readings, the
likelihoods of all particles are a line, which does not show where their maximum is."""

SEPARATE = 0.3
"""Smallest singular value of the errors of all channels over the particles, each of length 1, that separates them. Two
distances along one line have the same error for all particles but for a factor."""

SMALLEST_PART = 5e-3
"""Smallest part of the errors over the particles, relative to the largest, that counts: four ranges in a plane have two
parts, and what a learned likelihood does with the others is no measurement function."""

DISPLACED = 0.5
"""Offset of a likelihood, in standard deviations of the particles around the true state, from which its width there is
not that at its maximum."""

FLAT = 10.0
"""Largest width of a likelihood, in standard deviations of the true states of the episode: it has no information."""

MIN_PARTICLES = 3
"""Smallest number of particles on either side of the angle at which readings jump by a turn."""

INVERTED, MOST = -0.1, 0.9
"""Largest inverse ratio of variances of an inverted likelihood, and share of the steps that have it: that of a channel
which a learned likelihood ignores has either sign."""

JUMP = 0.1
"""Smallest fall of the log-likelihood between them, relative to that of an innovation of a full turn."""


def likelihood_statistics(trace: Trace, models: Sequence[ReadingModel]) -> dict[str, float]:
    """Of a particle filter, ``KIND/SUBJECT/all`` -> value.

    ``measurement noise`` and ``inverted likelihood``, by modality, ``measurement function``, by channel, and
    ``innovation turns``, by modality.

    Its log-likelihoods over the particles of a step are ``c + sum_i s_i (b_i e_i - e_i^2 / 2)``, with the errors e of
    the readings expected at the particles, relative to their noise: s are the inverse ratios of the variances, and b
    the errors of its measurement function. Medians over the steps, of b without its sign; the noise is the geometric
    mean of the standard deviations of all channels. Channels that particles do not separate have their root mean square
    error. Inverted: 1 if the likelihood grows with the error in a channel, else 0. Turns: share of steps with a b close
    to a full turn, of angles. Of modalities whose readings follow from the state and the controls of the step.
    """
    likelihood, particles = trace.log_likelihood, trace.particles
    if likelihood is None or particles is None:
        return {}
    by_key, values = {model.key: model for model in models}, {}
    every = np.s_[:: 1 + particles.shape[1] // PARTICLES]
    for k, modality in enumerate(trace.modalities):
        own = [by_key.get(key) for key in trace.task.modalities.get(modality, ())]
        sensors = [model for model in own if model is not None and model.is_complete(trace.episode)]
        at = counted(trace) & np.isfinite(likelihood[:, k]).all(-1)
        at = np.logical_and.reduce([at, *(trace.episode.present(model.key) for model in sensors)])
        steps = np.flatnonzero(at)[:: 1 + int(at.sum()) // LIKELIHOODS]
        if not sensors or len(sensors) < len(own) or len(steps) < MIN_STEPS:
            continue
        errors = []
        for model in sensors:
            readings = readings_of(trace.episode, model.key)[steps, None]
            errors.append(model.relative(readings - _expected(trace, model, steps, every)))
        e = np.concatenate(errors, axis=-1)  # (S, P, A)
        known = np.asarray(np.isfinite(e).all(-1, keepdims=True))
        near = (np.where(known, np.abs(e), np.inf).min(1) < NEAR).all(-1) & (known.mean((1, 2)) > KNOWN)
        if near.sum() < MIN_STEPS:
            continue
        e, steps, known = np.where(known, e, 0.0)[near], steps[near], known[near]
        columns = np.concatenate([e, -0.5 * np.square(e)], axis=-1)
        columns, y = (
            known * (v - (known * v).sum(1, keepdims=True) / known.sum(1, keepdims=True))
            for v in (columns, likelihood[steps, k][:, every, None].astype(float))
        )
        scale = np.maximum(np.abs(columns).max(1, keepdims=True), 1e-12)
        fit = (np.linalg.pinv(columns / scale, rcond=SMALLEST_PART) @ y / scale.mT)[..., 0]  # (S, 2 A): s b and s
        count = e.shape[-1]
        power = np.median(fit[:, count:], axis=0)
        at_most_steps = np.quantile(fit[:, count:], MOST, axis=0)
        values[f"inverted likelihood/{modality}/all"] = float((at_most_steps < INVERTED).any())
        if not (power > 0.0).all():
            continue
        noise_of_readings = np.concatenate([model.noise for model in sensors])
        noise = noise_of_readings / np.sqrt(power)
        values[f"measurement noise/{modality}/all"] = float(np.exp(np.log(noise).mean()))
        size = np.abs(fit[:, :count] / power)
        bias = np.median(size, axis=0)
        if not _are_separate(columns[..., :count]):
            bias = np.full(count, np.sqrt(np.square(bias).mean()))
        if (angles := np.concatenate([model.is_angle for model in sensors])).any():
            turned = np.abs(size * noise_of_readings - TURN)[:, angles] < NEAR_TURN
            values[f"innovation turns/{modality}/all"] = float(turned.any(1).mean())
        names = [axis_name(m.key, i, len(m.channels)) for m in sensors for i in m.channels]
        values |= {f"measurement function/{name}/all": b for name, b in zip(names, bias.tolist(), strict=True)}
    return values


def likelihoods_at_truth(trace: Trace) -> dict[str, float]:
    """``KIND/SUBJECT/all`` -> value, of the likelihoods of particles around true states.

    ``likelihood offset/MODALITY COMPONENT``: mean distance by which the likelihood of a modality alone moves the mean
    of the particles, in their standard deviations: 0 in a filter whose measurement function is right, whatever its
    noise.

    ``likelihood width/MODALITY``: standard deviation of a Gaussian of the same curvature (``_width``); unless the
    likelihood is ``DISPLACED``.
    """
    if trace.log_likelihood is None or trace.particles is None:
        return {}
    values: dict[str, float] = {}
    unit = np.maximum(trace.episode.states.astype(np.float64).std(0), 1e-9)
    for k, modality in enumerate(trace.modalities):
        at = np.isfinite(trace.log_likelihood[:, k]).all(-1) & ~absent(trace, modality)
        if at.sum() < MIN_STEPS:
            continue
        likelihood, particles = trace.log_likelihood[at, k].astype(np.float64), trace.particles[at].astype(np.float64)
        weights = np.exp(likelihood - likelihood.max(-1, keepdims=True))
        weights /= weights.sum(-1, keepdims=True)
        around = trace.task.difference(particles, particles[:, :1])  # angles have no mean
        std = around.std(1)
        moved = np.einsum("tp,tpn->tn", weights, around) - around.mean(1)
        offsets = {
            f"likelihood offset/{modality} {component.name}/all": float((moved[known, i] / std[known, i]).mean())
            for i, component in enumerate(trace.task.components)
            if (known := std[:, i] > 0.0).sum() >= MIN_STEPS
        }
        values |= offsets
        if all(abs(offset) < DISPLACED for offset in offsets.values()):
            values[f"likelihood width/{modality}/all"] = _width(around / unit, likelihood)
    return values


def _width(x: Array, likelihood: Array) -> float:
    """Width of log-likelihoods (S, P) of particles (S, P, n), in their units.

    The log-likelihood over the particles of a step is ``c + sum_i (g_i x_i - s_i x_i^2 / 2)``, whatever their spread.
    The width is the inverse root of the mean of the sum of s, up to ``FLAT``.
    """
    every = np.s_[:, :: 1 + x.shape[1] // PARTICLES]
    x, y = x[every] - x[every].mean(1, keepdims=True), likelihood[every][..., None]
    columns = np.concatenate([x, -0.5 * np.square(x)], axis=-1)
    columns, y = (v - v.mean(1, keepdims=True) for v in (columns, y))
    scale = np.maximum(np.abs(columns).max(1, keepdims=True), 1e-12)
    fit = (np.linalg.pinv(columns / scale, rcond=SMALLEST_PART) @ y / scale.mT)[..., 0]
    power = float(fit[:, x.shape[-1] :].sum(1).mean())
    return 1.0 / math.sqrt(max(power, FLAT**-2))


def _are_separate(errors: Array) -> bool:
    """Whether the errors (S, P, A) of some channels, without their means, differ over the particles of most steps."""
    lengths = np.maximum(np.linalg.norm(errors, axis=1, keepdims=True), 1e-12)
    return float(np.median(np.linalg.svd(errors / lengths, compute_uv=False)[:, -1])) > SEPARATE


def likelihood_turns(trace: Trace, models: Sequence[ReadingModel]) -> dict[str, float]:
    """``innovation turns/MODALITY/all`` of a particle filter: share of steps at which a likelihood jumps (``JUMP``).

    Of the steps with particles on both sides of the angle at which readings jump by a turn.
    """
    if trace.log_likelihood is None or trace.particles is None:
        return {}
    likelihood, values = trace.log_likelihood.astype(np.float64), dict[str, float]()
    for k, modality in enumerate(trace.modalities):
        own = [model for model in models if model.key in trace.task.modalities.get(modality, ())]
        angles = [replace(model, of_channels=(one,)) for model in own for one in model.of_channels if one.is_angle]
        if falls := [fall for model in angles for fall in _falls(trace, model, likelihood[:, k])]:
            values[f"innovation turns/{modality}/all"] = float((np.array(falls) > JUMP).mean())
    return values


def _falls(trace: Trace, model: ReadingModel, likelihood: Array) -> list[float]:
    """Fall of log-likelihoods (T, P) between the two sides, where the readings of an angle are near the jump.

    From particles whose expected readings, modulo a turn, are within the noise of the reading.
    """
    (noise,), every = model.noise, np.s_[:: 1 + likelihood.shape[1] // TURNED]
    readings = wrapped(readings_of(trace.episode, model.key)[:, model.channels[0]])
    likelihood = likelihood[:, every]
    at = counted(trace) & trace.episode.present(model.key) & np.isfinite(likelihood).all(1)
    steps = np.flatnonzero(at & (np.pi - np.abs(readings) < NEAR * noise))
    if not len(steps):
        return []
    error = readings[steps, None] - wrapped(_expected(trace, model, steps, every)[..., 0])
    near, beyond = np.abs(wrapped(error)) < noise, np.abs(error) > np.pi
    sides = [near & ~beyond, near & beyond]
    counts = [side.sum(1) for side in sides]
    means = [(side * likelihood[steps]).sum(1) / np.maximum(n, 1) for side, n in zip(sides, counts, strict=True)]
    fall = (means[0] - means[1]) / (0.5 * (TURN / noise) ** 2)
    return fall[np.minimum(*counts) >= MIN_PARTICLES].tolist()


def _expected(trace: Trace, model: ReadingModel, steps: Indices, every: slice) -> Array:
    """(S, P, A) readings expected at some of the particles of some steps."""
    assert trace.particles is not None
    states = trace.particles[steps][:, every]
    controls = np.repeat(trace.episode.controls[steps], states.shape[1], axis=0)
    there = Episode(trace.task, states.reshape(-1, states.shape[-1]), controls)
    return model.expected(there).reshape(*states.shape[:2], len(model.of_channels))
