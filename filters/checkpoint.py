"""Checkpoints: safetensors files with one JSON document in the header. Pickle is never used.

The header's key ``beliefscope`` holds ``{"format", "name", "task", "architecture", "record"}`` and, if it was measured,
``"healthy_profile"``; the tensors are the filter's state dictionary, including the statistics of the training set.
``task`` is the definition; earlier versions stored only its name, in the architecture. A checkpoint's hash is the
SHA-256 of its file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch.overrides import TorchFunctionMode

from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, reason_unreadable
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference, task_to_json
from beliefscope.filters.batch import Statistics
from beliefscope.filters.catalog import build
from beliefscope.filters.filter import Architecture, Filter, Kind
from beliefscope.filters.legacy_names import training_record
from beliefscope.filters.names import PRETRAINED as PRETRAINED, check_not_source, pretrained_path as pretrained_path

FORMAT = 1


@dataclass(frozen=True)
class Checkpoint:
    """A trained filter and its origin.

    Attributes:
        filter: in evaluation mode, on the CPU. name: of the filter, such as ``crossmodal-pf``. hash: SHA-256 of the
            file.
        record: JSON: training command, seed, data hash, metrics, versions; keys of earlier versions are renamed.
        healthy_profile: JSON of ``beliefscope.inspect.diagnostics.healthy_profile``, or None.
        path: of the file; None for an external filter and one in memory.
    """

    filter: Filter
    name: str
    hash: str
    record: Mapping[str, Any]
    healthy_profile: Mapping[str, Any] | None = None
    path: Path | None = None

    @property
    def task(self) -> Task:
        return self.filter.task

    @property
    def kind(self) -> Kind:
        return self.filter.architecture.kind

    @property
    def statistics(self) -> Statistics:
        """Of the training data."""
        return self.filter.statistics

    def with_filter(self, filter_: Filter) -> Checkpoint:
        """The same checkpoint with another filter."""
        return Checkpoint(filter_, self.name, self.hash, self.record, self.healthy_profile)

    def check_task(self, episode: Episode) -> None:
        """Raise BadInput for an episode of another task, or of one with the same name and other arrays."""
        if other := difference(self.task, episode.task):
            raise BadInput(f"filter {self.name!r} is for task {self.task.name!r}, the episode is of {other}")


def partial_path(path: Path) -> Path:
    """The file from which the interrupted training of a checkpoint resumes."""
    return path.with_name(f"{path.name}.partial")


def save_checkpoint(
    filter_: Filter,
    name: str,
    record: Mapping[str, Any],
    path: Path,
    healthy_profile: Mapping[str, Any] | None = None,
) -> str:
    """Writes the checkpoint atomically, deletes its ``partial_path``, and returns its hash.

    Raises BadInput if the folder does not exist.
    """
    header = {
        "format": FORMAT,
        "name": name,
        "task": task_to_json(filter_.task),
        "architecture": filter_.architecture.to_json(),
        "record": dict(record),
    }
    if healthy_profile is not None:
        header["healthy_profile"] = dict(healthy_profile)
    tensors = {key: value.detach().cpu().contiguous() for key, value in filter_.state_dict().items()}
    data = save(tensors, metadata={"beliefscope": json.dumps(header)})
    write_atomically(path, data)
    partial_path(path).unlink(missing_ok=True)
    return hashlib.sha256(data).hexdigest()


class DeferredCheckpoint(Checkpoint):
    """A checkpoint whose networks are read when ``filter`` is first used; until then only its header was checked."""

    def __init__(self, path: Path) -> None:
        """Raises BadInput like ``load_checkpoint``, except for damaged tensors."""
        header, _ = _read(path, prefix=None)
        architecture = _architecture(header)
        values = _description(path, header) | {"_architecture": architecture}
        for key, value in values.items():
            object.__setattr__(self, key, value)  # a checkpoint is frozen

    path: Path
    _architecture: Architecture

    @cached_property
    def filter(self) -> Filter:
        return _filter(self.path, _read(self.path)[1], self._architecture)

    @cached_property
    def statistics(self) -> Statistics:
        statistics, prefix = Statistics(self.task), "statistics."
        tensors = _read(self.path, prefix)[1]
        statistics.load_state_dict({key.removeprefix(prefix): value.clone() for key, value in tensors.items()})
        return statistics

    @property
    def task(self) -> Task:
        return self._architecture.task

    @property
    def kind(self) -> Kind:
        return self._architecture.kind


def load_checkpoint(path: Path, given: Iterable[Task] = ()) -> Checkpoint:
    """Reads a checkpoint. Raises BadInput if it is missing, damaged, or not a checkpoint of this package.

    Args:
        given: user-defined tasks, as for ``stored_task``.
    """
    path = Path(path)
    header, tensors = _read(path)
    filter_ = _filter(path, tensors, _architecture(header, given))
    return Checkpoint(filter_, **_description(path, header))


def _filter(path: Path, tensors: Mapping[str, torch.Tensor], architecture: Architecture) -> Filter:
    """The filter of a file. Raises BadInput for tensors of other shapes or with values that are not finite."""
    with torch.device("meta"), _Uninitialised():  # allocates no memory, whatever the header's sizes
        filter_ = build(architecture)
    empty = filter_.state_dict()
    expected = {key: tuple(value.shape) for key, value in empty.items()}
    shapes = {key: tuple(value.shape) for key, value in tensors.items()}
    if expected != shapes:
        key = min(expected.items() ^ shapes.items())[0]
        raise BadInput(
            f"{str(path)!r}: tensor {key!r} is {shapes.get(key, 'missing')}, but this architecture has "
            f"{expected.get(key, 'no such tensor')}"
        )
    for key, value in tensors.items():
        if not (value.is_floating_point() and _is_finite(value)):
            raise BadInput(f"{str(path)!r}: tensor {key!r} contains values that are not finite numbers ({value.dtype})")
    # Copies: the tensors may be views of the file.
    filter_.load_state_dict({key: value.to(empty[key].dtype, copy=True) for key, value in tensors.items()}, assign=True)
    return filter_.eval().requires_grad_(False)


def _read(path: Path, prefix: str | None = "") -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Header of a file, and the tensors whose names start with the prefix; None: no tensors."""
    check_not_source(str(path))
    if not path.is_file():
        is_name = (PRETRAINED / f"{'-'.join(path.parts)}.safetensors").is_file()  # TASK/NAME
        hint = f"; the pretrained filter of task {path.parts[0]!r} is named {path.name!r}" if is_name else ""
        raise BadInput(f"checkpoint {str(path)!r} does not exist{hint}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = () if prefix is None else filter(lambda name: name.startswith(prefix), file.keys())
            tensors = {key: file.get_tensor(key) for key in names}
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(f"{str(path)!r} is not a readable safetensors file: {reason_unreadable(path, error)}") from None
    return _header(path, metadata), tensors


def _architecture(header: Mapping[str, Any], given: Iterable[Task] = ()) -> Architecture:
    task = stored_task(header.get("task", header["architecture"].get("task")), given)
    return Architecture.from_json(header["architecture"], task)


def _description(path: Path, header: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a checkpoint other than its filter."""
    return {
        "name": header["name"],
        "hash": hashlib.sha256(path.read_bytes()).hexdigest(),
        "record": training_record(header["record"]),
        "healthy_profile": header.get("healthy_profile"),
        "path": path,
    }


def _is_finite(value: torch.Tensor) -> bool:
    """Whether all values are finite. PyTorch would wake all its threads for each tensor, NumPy does not."""
    if value.dtype in (torch.float32, torch.float64):
        return bool(np.isfinite(value.numpy()).all())
    return bool(torch.isfinite(value).all())


class _Uninitialised(TorchFunctionMode):
    """Skips weight initialisation. On the meta device it would import PyTorch's compiler and take seconds."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__module__", "") == torch.nn.init.__name__:
            return kwargs["tensor"] if "tensor" in kwargs else args[0]
        return func(*args, **kwargs)


def _header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    if "beliefscope-trace" in metadata:
        raise BadInput(
            f"{str(path)!r} is the trace of a run, not a filter; `beliefscope inspect`, `report` and `export` read it"
        )
    if "beliefscope" not in metadata:
        raise BadInput(
            f"{str(path)!r} is a safetensors file, but not a checkpoint of Beliefscope; weights of an external filter "
            f"belong to its build function: FILE.py:FUNCTION@{path}"
        )
    try:
        header = read_json(metadata["beliefscope"])
    except ValueError as error:
        raise BadInput(f"{str(path)!r} has a damaged header: {error}") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        version = header.get("format") if isinstance(header, dict) else header
        raise BadInput(f"{str(path)!r} has checkpoint format {version!r}; this version reads format {FORMAT}")
    missing = {"name", "architecture", "record"} - header.keys()
    if missing:
        raise BadInput(f"{str(path)!r} lacks {', '.join(sorted(missing))} in its header")
    for name, kind, expected in (
        ("name", str, "text"),
        ("architecture", dict, "an object"),
        ("record", dict, "an object"),
    ):
        if not isinstance(header[name], kind):
            raise BadInput(f"{str(path)!r} has the {name} {header[name]!r:.200} in its header, expected {expected}")
    return header
