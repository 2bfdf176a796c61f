"""Episodes as tensors, and the statistics for standardisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.datasets.episode import Episode, FloatArray
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.text import plural
from beliefscope.filters.angles import Angles

MIN_STD = 1e-6
"""A channel with a smaller standard deviation is divided by 1."""


@dataclass(frozen=True)
class Batch:
    """T steps of N episodes in SI units; images are uint8 until they are encoded.

    Attributes:
        observations: modality -> (T, N, H, W) uint8, (T, N, d) float32, or (T, N) int64: indices of images in
            the encoders' tables (``Steps.with_image_indices``), -1 for a blacked-out one.
        controls: (T, N, c). states: (T, N, n). contact: (T, N) bool.
        previous: (N, n) true state one step before the first (of step 0 if the episode starts there).
        start: (N, n) mean of the first belief; None: ``previous``.
        present: (T, N, number of the task's modalities) bool, whether any sensor of a modality has a reading
            (``Task.masks``); None: all have one.
    """

    observations: Mapping[str, Tensor]
    controls: Tensor
    states: Tensor
    contact: Tensor
    previous: Tensor
    start: Tensor | None = None
    present: Tensor | None = None

    def __len__(self) -> int:
        return len(self.states)


@dataclass(frozen=True)
class Steps:
    """All steps of a set of episodes, concatenated; windows are cut from them.

    Attributes: as in ``Batch`` but (S, ...), S steps in total.
        first: (E,) index of each episode's step 0. length: (E,).
        start_offset: (E, n) mean of each episode's first belief, relative to the true state of step 0.
    """

    observations: Mapping[str, Tensor]
    controls: Tensor
    states: Tensor
    contact: Tensor
    first: Tensor
    length: Tensor
    start_offset: Tensor
    present: Tensor | None = None

    @classmethod
    def from_episodes(cls, task: Task, episodes: Sequence[Episode], device: torch.device | str = "cpu") -> Steps:
        """Raises BadInput if there is no episode, or an array or start offset does not have the task's shape."""
        if not episodes:
            raise BadInput("no episodes: the data set's split is empty")
        for number, episode in enumerate(episodes):
            check_shapes(task, episode, f"episode {number}")
        observations = {
            modality: _join([_modality_array(episode, keys) for episode in episodes], device)
            for modality, keys in task.modalities.items()
        }
        length = torch.tensor([len(episode) for episode in episodes], device=device)
        return cls(
            observations=observations,
            controls=_join([e.controls for e in episodes], device),
            states=_join([e.states for e in episodes], device),
            contact=_join([e.contact for e in episodes], device),
            first=length.cumsum(0) - length,
            length=length,
            start_offset=torch.from_numpy(np.stack([start_offset(task, e) for e in episodes])).to(device),
            present=_join([_presence(task, e) for e in episodes], device) if task.masks else None,
        )

    def windows(self, starts: Tensor, steps: int) -> Batch:
        """Windows of ``steps`` steps that start at the given steps (N,)."""
        index = starts + torch.arange(steps, device=starts.device)[:, None]
        episode = torch.searchsorted(self.first, starts, right=True) - 1
        at_start = self.first[episode] == starts
        previous = self.states[torch.where(at_start, starts, starts - 1)]
        return Batch(
            observations={m: values[index] for m, values in self.observations.items()},
            controls=self.controls[index],
            states=self.states[index],
            contact=self.contact[index],
            previous=previous,
            start=previous + at_start.unsqueeze(-1) * self.start_offset[episode],
            present=None if self.present is None else self.present[index],
        )

    def sample(self, count: int, steps: int, generator: torch.Generator) -> Batch:
        """``count`` windows, uniform over all that fit into an episode. Raises BadInput if none does."""
        room = (self.length - steps + 1).clamp_min(0)
        ends = room.cumsum(0)
        if int(ends[-1]) == 0:
            raise BadInput(f"no episode has {plural(steps, 'step')}: the longest has {int(self.length.max())}")
        draw = torch.randint(int(ends[-1]), (count,), generator=generator).to(ends.device)
        episode = torch.searchsorted(ends, draw, right=True)
        return self.windows(self.first[episode] + draw - (ends - room)[episode], steps)

    def part(self, first: int, last: int) -> Steps:
        """Episodes ``first`` to ``last - 1``, as views of the same arrays."""
        part = slice(first, last)
        return replace(self, first=self.first[part], length=self.length[part], start_offset=self.start_offset[part])

    def rows(self) -> Tensor:
        """(R,) indices of these episodes' steps in the arrays."""
        spans = zip(self.first.tolist(), self.length.tolist(), strict=True)
        return torch.cat([torch.arange(a, a + n, device=self.first.device) for a, n in spans])

    def with_image_indices(self) -> Steps:
        """The same steps with each image replaced by its index, for encoders with a table."""
        index = torch.arange(len(self.states), device=self.states.device)
        return replace(
            self, observations={m: index if v.dtype == torch.uint8 else v for m, v in self.observations.items()}
        )

    def episode(self, number: int) -> Batch:
        """One whole episode, N = 1."""
        return self.windows(self.first[number : number + 1], int(self.length[number]))


def single_step(task: Task, observations: Mapping[str, np.ndarray], control: np.ndarray) -> Batch:
    """One step of sensor data from a robot, T = N = 1; the true state is unknown, NaN.

    Args:
        observations: by the task's keys, each of one step. control: (c,).

    Raises BadInput for arrays that do not have the task's shape.
    """
    row = Episode(
        task=task,
        states=np.full((1, len(task.components)), np.nan, np.float32),
        controls=np.asarray(control, np.float32)[None],
        observations={key: np.asarray(value)[None] for key, value in observations.items()},
        contact=np.zeros(1, bool),
        qpos=np.zeros((1, 0), np.float32),
        dt=task.dt,
        seed=-1,
    )
    return Steps.from_episodes(task, [row]).episode(0)


def start_offset(task: Task, episode: Episode) -> FloatArray:
    """(n,) mean of the episode's first belief, relative to the true state of step 0.

    Raises BadInput if ``start_offset`` in its provenance does not have n finite numbers.
    """
    n = len(task.components)
    value = episode.provenance.get("start_offset", [0.0] * n)
    valid = isinstance(value, list) and len(value) == n and all(isinstance(v, float | int) for v in value)
    if not valid or not np.isfinite(value).all():
        raise BadInput(f"'start_offset' in the provenance is {value!r:.200}, expected {n} finite numbers")
    return np.array(value, np.float32)


def check_shapes(task: Task, episode: Episode, where: str) -> None:
    """Raises BadInput, with the array's name, if an episode does not fit its task."""
    expected: dict[str, tuple[int, ...]] = {"states": (len(task.components),), "controls": (task.control_size,)}
    arrays = {"states": episode.states, "controls": episode.controls}
    expected |= dict(task.observations)
    for key in task.observations:
        if key not in episode.observations:
            raise BadInput(f"{where} has no observation {key!r}, which task {task.name!r} needs")
        arrays[key] = episode.observations[key]
    for key, shape in expected.items():
        if arrays[key].shape != (len(episode), *shape):
            raise BadInput(f"{where}: {key!r} has shape {arrays[key].shape}, not {(len(episode), *shape)}")


def _modality_array(episode: Episode, keys: Sequence[str]) -> np.ndarray:
    arrays = [episode.observations[key] for key in keys]
    if len(arrays) == 1:
        return arrays[0] if arrays[0].ndim == 3 else arrays[0].astype(np.float32)
    return np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1).astype(np.float32)


def _presence(task: Task, episode: Episode) -> np.ndarray:
    """(T, number of modalities) bool, see ``Batch.present``."""
    return np.stack([np.any([episode.present(key) for key in keys], axis=0) for keys in task.modalities.values()], 1)


def _join(arrays: Sequence[np.ndarray], device: torch.device | str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.concatenate(arrays))).to(device)


class Statistics(nn.Module):
    """Means and standard deviations of the training set, stored as buffers with the weights.

    Vectors are standardised per channel, images (0..255) with one mean and standard deviation for all pixels. Angles of
    the state that wrap stay in rad.
    """

    def __init__(self, task: Task) -> None:
        super().__init__()
        self.modalities = tuple(task.modalities)
        self.angles = Angles.from_task(task)
        sizes = {"state": len(task.components), "control": task.control_size}
        for modality, keys in task.modalities.items():
            shapes = [task.observations[key] for key in keys]
            sizes[modality] = 1 if len(shapes[0]) > 1 else sum(shape[0] for shape in shapes)
        for name, size in sizes.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def mean_std(self, name: str) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of ``state``, ``control`` or a modality."""
        return self.get_buffer(f"{name}_mean"), self.get_buffer(f"{name}_std")

    def fit(self, steps: Steps) -> None:
        """Computes the statistics of these episodes' steps."""
        rows = steps.rows()
        values = {"state": steps.states, "control": steps.controls, **steps.observations}
        values = {name: array[rows] for name, array in values.items() if array.shape[-1]}  # a task may have no controls
        for name, array in values.items():
            mean, std = self.mean_std(name)
            if array.dtype == torch.uint8:
                average, deviation = _gray_mean_std(array)
            else:
                average, deviation = array.double().mean(0), array.double().std(0)
            mean.copy_(average)
            std.copy_(torch.where(deviation > MIN_STD, deviation, torch.ones_like(deviation)))
        angles = list(self.angles.indices)
        self.get_buffer("state_mean")[angles], self.get_buffer("state_std")[angles] = 0.0, 1.0

    def standardise(self, name: str, values: Tensor) -> Tensor:
        """(..., d) in SI units (or 0..255) to zero mean and unit standard deviation, float32."""
        mean, std = self.mean_std(name)
        return (values.to(mean.dtype) - mean) / std

    def standardise_observations(self, observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Modality -> standardised observations; image indices are unchanged."""
        return {
            m: observations[m] if observations[m].dtype == torch.int64 else self.standardise(m, observations[m])
            for m in self.modalities
        }

    def state_to_si(self, mean: Tensor) -> Tensor:
        """Standardised states (..., n) to m and rad."""
        return mean * self.get_buffer("state_std") + self.get_buffer("state_mean")

    def covariance_to_si(self, covariance: Tensor) -> Tensor:
        """Standardised covariances (..., n, n) to m^2, m rad, rad^2."""
        std = self.get_buffer("state_std")
        return covariance * std * std[:, None]


def _gray_mean_std(images: Tensor) -> tuple[Tensor, Tensor]:
    """(1,), (1,) over all pixels, from a histogram: conversion to float64 would take eight times the memory."""
    counts = torch.zeros(256, dtype=torch.float64, device=images.device)
    for part in images.split(4096):
        counts += torch.bincount(part.flatten(), minlength=256)
    gray = torch.arange(256, dtype=torch.float64, device=images.device)
    mean = (counts @ gray) / counts.sum()
    return mean[None], (counts @ (gray - mean).square() / (counts.sum() - 1)).sqrt()[None]


def apply_blackout(batch: Batch, probability: Tensor, generator: torch.Generator) -> Batch:
    """The batch with image blackouts (all pixels zero), independent at each step.

    Args:
        probability: (N,) or () of a blackout. generator: on the CPU.
    """
    blackout = (torch.rand(batch.states.shape[:2], generator=generator) < probability).to(batch.states.device)
    observations = dict(batch.observations)
    for modality, values in observations.items():
        if values.dtype == torch.uint8:
            observations[modality] = values.masked_fill(blackout[..., None, None], 0)
        elif values.dtype == torch.int64:
            observations[modality] = values.masked_fill(blackout, -1)
    return replace(batch, observations=observations)


def position_channels(task: Task, modality: str) -> list[list[int]]:
    """x and y of each position (``Task.positions``) in a modality's vector."""
    result, first = [], 0
    for key in task.modalities[modality]:
        if key in task.positions:
            result.append([first + channel for channel in task.positions[key]])
        first += task.observations[key][0]
    return result


def shift_positions(batch: Batch, task: Task, scale: Tensor, generator: torch.Generator) -> Batch:
    """The batch with each episode shifted on the map, object and end effector together, by a normal offset.

    This augments positions for models without images: forces do not change, and images are not adapted.

    Args:
        scale: (n,) standard deviations of the state; only the map components are used. generator: on the CPU.
    """
    on_map = list(task.map_indices)
    offset = torch.randn(batch.states.shape[1], len(on_map), generator=generator).to(scale) * scale[on_map]

    def shifted(values: Tensor, channels: Sequence[int]) -> Tensor:
        values = values.clone()
        values[..., list(channels)] += offset
        return values

    observations, controls = dict(batch.observations), batch.controls
    for modality in task.modalities:
        for channels in position_channels(task, modality):
            observations[modality] = shifted(observations[modality], channels)
    if "control" in task.positions:
        controls = shifted(controls, task.positions["control"])
    return replace(
        batch,
        observations=observations,
        controls=controls,
        states=shifted(batch.states, on_map),
        previous=shifted(batch.previous, on_map),
        start=None if batch.start is None else shifted(batch.start, on_map),
    )
