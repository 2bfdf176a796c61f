"""A sweep: many checkpoints over many episodes, divided into cells that run anywhere and in any order."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.special import chdtri

import beliefscope
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import read_faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint
from beliefscope.filters.covariance_floor import is_covariance
from beliefscope.filters.evaluate import squares
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.filters.names import code_parts, external_name, is_code
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

FORMAT = 2
"""Version of the rows; rows of other versions are computed again."""

EPISODES = 64
"""Episodes of a cell: enough to share the start of a run, few enough to lose little when one is interrupted."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """One filter over some episodes of a data set, and everything its rows depend on.

    Attributes:
        checkpoint: file, or build function of an external filter. data: file.
        checkpoint_hash, data_hash: of their content.
        faults: as text. particles: of a particle filter. episodes: indices.
    """

    checkpoint: Path
    checkpoint_hash: str
    data: Path
    data_hash: str
    faults: str
    seed: int
    particles: int
    episodes: tuple[int, ...]

    @property
    def key(self) -> str:
        """Name of the cell: a hash of its inputs, without paths, and of the versions that compute its rows."""
        inputs = asdict(self) | {"checkpoint": None, "data": None}
        inputs |= {"format": FORMAT, "beliefscope": beliefscope.__version__, "torch": torch.__version__}
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:24]

    def rows(self) -> list[Row]:
        """Run the filter: a row for each episode and phase, in this order."""
        checkpoint = _filter(self.checkpoint, self.data)
        data = _dataset(self.data, checkpoint.task)
        if checkpoint.hash != self.checkpoint_hash:
            raise BadInput(f"{self.checkpoint} was changed while the sweep ran")
        faults = read_faults(self.faults, data.task)
        runs = trace_all(checkpoint, data, self.episodes, self.seed, self.particles, faults)
        by_episode = {run.episode_index: list(summary(run)) for run in runs}
        given = {"checkpoint": self.checkpoint_hash, "data": self.data_hash, "faults": self.faults, "seed": self.seed}
        return [given | row for index in self.episodes for row in by_episode[index]]


@dataclass(frozen=True)
class Inputs:
    """Checkpoints and data sets of a sweep. Each checkpoint runs over the data sets of its task.

    Attributes:
        checkpoints: files, or build functions of external filters (``find_checkpoints``).
        data: files or folders; empty: the sample data set of each task.
        faults: texts; an empty one is clean data. seeds, particles: as for ``trace``.
        all_episodes: whether to run over all episodes instead of the held-out ones.
    """

    checkpoints: tuple[Path, ...]
    data: tuple[Path, ...] = ()
    faults: tuple[str, ...] = ("",)
    seeds: tuple[int, ...] = (0,)
    particles: int = 300
    all_episodes: bool = False

    def cells(self, size: int = EPISODES, skip: Callable[[str, Sequence[Path]], None] | None = None) -> list[Cell]:
        """All cells with up to ``size`` episodes, by checkpoint.

        Args:
            skip: called with each problem and its unusable checkpoints, which are left out. By default, they are
                errors.

        Raises BadInput with all unusable checkpoints, or if none is usable; for data sets that are unusable or fit no
        checkpoint; and for faults that fit no checkpoint.
        """
        cells: list[Cell] = []
        used: set[Path] = set()
        hashes: dict[str, Path] = {}
        tasks: set[str] = set()
        problems: list[tuple[Path, str]] = []
        for path in self.checkpoints:
            try:
                provenance_of(path)
                _filter(path, self.data[0] if self.data else None)
            except BadInput as error:
                problems.append((path, str(error)))
                continue
            for data_path in self.data or (sample_path(_filter(path).task),):
                checkpoint = _filter(path, data_path)
                tasks.add(checkpoint.task.name)
                if hashes.setdefault(checkpoint.hash, path) != path:
                    continue  # a copy, such as the best checkpoint that is also the last
                data = _dataset(data_path, checkpoint.task)
                if difference(checkpoint.task, data.task):
                    continue
                used.add(data_path)
                episodes = range(len(data)) if self.all_episodes else data.held_out()
                for faults in self.faults:
                    injected = read_faults(faults, data.task)
                    injected.check(data.task, data.most_steps(episodes))
                    text = str(injected)
                    for seed in self.seeds:
                        cells += [
                            Cell(path, checkpoint.hash, data_path, data.hash, text, seed, self.particles, block)
                            for block in _blocks(episodes, size)
                        ]
        _report_unusable(problems, len(self.checkpoints), skip)
        if unused := [str(path) for path in self.data if path not in used]:
            raise BadInput(f"data {', '.join(unused)} fit no checkpoint; their tasks are {', '.join(sorted(tasks))}")
        return list(dict.fromkeys(cells))


def _report_unusable(
    problems: list[tuple[Path, str]], count: int, skip: Callable[[str, Sequence[Path]], None] | None
) -> None:
    """Call ``skip`` with the problems of ``count`` checkpoints; raise BadInput without it, or if none is usable.

    A problem of several checkpoints is stated once, with the names of the others.
    """
    groups: dict[str, list[tuple[Path, str]]] = {}
    for path, problem in problems:
        groups.setdefault(problem.replace(path.name, ""), []).append((path, problem))
    texts = {}
    for (path, problem), *others in groups.values():
        names = ", ".join(other.name for other, _ in others)
        texts[f"{problem} (the same: {names})" if others else problem] = [path, *(other for other, _ in others)]
    if problems and (skip is None or len(problems) == count):
        if len(problems) == 1:
            raise BadInput(*texts)
        advice = "; --skip-bad leaves them out" if len(problems) < count else ""
        raise BadInput(f"{len(problems)} of {count} checkpoints are unusable: {'; '.join(texts)}{advice}")
    for text, paths in texts.items():
        assert skip is not None
        skip(text, paths)


def provenance_of(path: Path) -> Mapping[str, Any]:
    """Provenance of a checkpoint from the file beside it with the suffix ``.json``; empty without one.

    Of an external filter, it is beside its weights.

    It is the configuration of the training, for example, or the address of a tracker's run, as ``read_provenance``
    returns it. Raises BadInput if it is not a JSON object.
    """
    weights = code_parts(str(path))[2] if is_code(str(path)) else str(path)
    beside = Path(weights).with_suffix(".json") if weights else None
    if beside is None or not beside.is_file():
        return {}
    try:
        provenance = read_provenance(beside.read_text())
    except ValueError as error:
        raise BadInput(f"{beside} is not JSON: {error}") from None
    if not isinstance(provenance, dict):
        raise BadInput(f"{beside} contains {type(provenance).__name__}, expected a JSON object of key: value")
    return provenance


def read_provenance(text: str) -> Any:
    """A JSON document; NaN and infinite numbers, which JSON lacks but Python writes, are None. Raises ValueError."""
    return json.loads(text, parse_constant=lambda _: None, parse_float=_finite)


def _finite(digits: str) -> float | None:
    number = float(digits)
    return number if math.isfinite(number) else None


def describe_checkpoint(path: Path, data: Path | None = None) -> Row:
    """The row of a checkpoint: name, task, training and provenance. data: that an external filter ran over.

    Raises BadInput as ``provenance_of``.
    """
    checkpoint = _filter(path, data)
    record, provenance = dict(checkpoint.record), provenance_of(path)
    name, filter_ = path.stem, checkpoint.name
    if is_code(str(path)):
        place, function, weights = code_parts(str(path))
        filter_ = external_name(f"{place}:{function}")
        name = Path(weights).stem or filter_
    return {
        "checkpoint": checkpoint.hash,
        "name": name,
        "path": str(path),
        "task": checkpoint.task.name,
        "filter": filter_,
        "kind": checkpoint.kind,
        "training": _json_text(record),
        "provenance": _json_text(provenance),
    }


def _json_text(document: Mapping[str, Any]) -> str:
    """JSON whose texts queries can search as they are: only lone surrogates, which UTF-8 lacks, are escaped."""
    text = json.dumps(document, sort_keys=True, ensure_ascii=False)
    return text.encode(errors="backslashreplace").decode()


def describe_data(path: Path, checkpoint: Path) -> Row:
    """The row of a data set that a checkpoint ran over."""
    data = _dataset(path, _filter(checkpoint, path).task)
    return {"data": data.hash, "name": path.stem, "path": str(path), "task": data.task.name, "episodes": len(data)}


def summary(trace: Trace) -> Iterator[Row]:
    """A row for each phase of a trace that has steps: errors in display units, consistency, weights, particles.

    ``error`` is the root mean square of the position error, ``worst`` its maximum, both in ``unit``, at ``worst_step``
    and ``worst_time``, s since the first step, None without timestamps;
    each component has its own column, such as ``hinge_x_cm``. ``beta_image`` and ``weight_image`` are the mean fusion
    weight beta and effective weight.
    ``nll`` in nats, m and rad; ``nees`` over n, 1 if consistent; ``coverage95`` the share of steps with the truth in
    the 95 % ellipsoid; ``ess`` the effective share of the particles; NaN where a filter lacks the quantity, or has
    an invalid covariance (``is_covariance``).
    """
    error = measures.errors(trace)[:, -1]
    squared = {key: values.numpy() for key, values in squares(trace.task, torch.from_numpy(error)).items()}
    main, components = trace.task.main_error.key, [component.key for component in trace.task.components]
    columns = {"nees": measures.nees(trace)[:, -1], "nll": measures.nll(trace)[:, -1]}
    if trace.particles is None:  # sets of particles may collapse
        valid = is_covariance(trace.estimate_covariance)
        columns = {name: np.where(valid, values, np.nan) for name, values in columns.items()}
    squared_sigmas, limit = error.shape[-1] * columns["nees"], chdtri(error.shape[-1], 0.05)
    columns["coverage95"] = np.where(np.isnan(squared_sigmas), np.nan, squared_sigmas <= limit)
    if trace.effective_sample_size is not None and trace.particle_count:
        columns["ess"] = trace.effective_sample_size / trace.particle_count
    for kind, weights in (("beta", trace.weights), ("weight", trace.effective_weights)):
        if weights is not None:
            columns |= {f"{kind}_{name}": weights[:, k].mean(-1) for k, name in enumerate(trace.modalities)}
    episode = trace.episode
    given = {
        "task": trace.task.name,
        "episode": trace.episode_index,
        "episode_hash": trace.data_hash,
        "split": episode.split,
        "policy": str(episode.provenance.get("policy", "")),
        "provenance": json.dumps(dict(episode.provenance), sort_keys=True, default=str),
        "particles": trace.particle_count,
    }

    def rmse(key: str, mask: measures.Mask) -> float:
        return float(np.sqrt(squared[key][mask].mean()))

    for phase, mask in measures.phases(trace).items():
        if not mask.any():
            continue
        steps = np.flatnonzero(mask)
        at = int(steps[np.argmax(np.nan_to_num(squared[main][steps], nan=-1.0))])
        yield {
            **given,
            "phase": phase,
            "steps": len(steps),
            "error": rmse(main, mask),
            "unit": trace.task.main_error.unit,
            **{key: rmse(key, mask) for key in components},
            "worst": float(np.sqrt(squared[main][at])),
            "worst_step": at,
            "worst_time": None if episode.time is None else float(episode.time[at]),
            **{key: float(np.mean(values[mask])) for key, values in columns.items()},
        }


def find_checkpoints(patterns: Iterable[str]) -> tuple[Path, ...]:
    """Checkpoints that match glob patterns; ``FILE.py:FUNCTION`` and ``MODULE:FUNCTION`` are external filters.

    The weights of an external filter, ``FILE.py:FUNCTION@WEIGHTS``, are a pattern as well.

    Raises BadInput for a pattern that none matches.
    """
    checkpoints: dict[Path, None] = {}
    for pattern in patterns:
        build, files = "", pattern
        if is_code(pattern):
            place, function, files = code_parts(pattern)
            build = f"{place}:{function}@"
            if not files:
                checkpoints[location(pattern)] = None
                continue
        names = [name for name in sorted(glob(files, recursive=True)) if name.endswith(".safetensors")]
        if not names:
            raise BadInput(f"no checkpoint (.safetensors) matches {files!r}")
        checkpoints |= dict.fromkeys(location(f"{build}{name}") for name in names)
    return tuple(checkpoints)


def location(source: str) -> Path:
    """The file or the build function of a filter with absolute paths, except for the name of a module."""
    if not is_code(source):
        return Path(source).resolve()
    place, function, weights = code_parts(source)
    file = Path(place).absolute() if Path(place).is_file() else place  # a link has another name
    return Path(f"{file}:{function}@{Path(weights).resolve()}" if weights else f"{file}:{function}")


def source_of(checkpoint: Checkpoint) -> str:
    """File or build function from which other processes load a filter; its name if it has no file.

    Raises BadInput for an external filter without a build function.
    """
    if not isinstance(checkpoint, ExternalFilter):
        return str(checkpoint.path or checkpoint.name)
    if not is_code(checkpoint.source):
        raise BadInput(
            f"filter {checkpoint.name!r} was built in Python, and a sweep runs in other processes: give its build "
            "function, FILE.py:FUNCTION or FILE.py:FUNCTION@WEIGHTS.safetensors"
        )
    return checkpoint.source


def _blocks(indices: Iterable[int], size: int) -> Iterator[tuple[int, ...]]:
    every = tuple(indices)
    return (every[i : i + size] for i in range(0, len(every), size))


def _filter(path: Path, data: Path | None = None) -> Checkpoint:
    """The filter of a checkpoint or build function; the data define the task of a filter that names none."""
    return _external(str(path), data) if is_code(str(path)) else _checkpoint(path)


# A process runs the cells of a checkpoint and of a data set one after the other.
@lru_cache(maxsize=2)
def _checkpoint(path: Path) -> Checkpoint:
    return load_checkpoint(path)


@lru_cache(maxsize=2)
def _external(source: str, data: Path | None) -> Checkpoint:
    if data is None:
        return load_external(source)
    with open_dataset(data) as episodes:
        return load_external(source, given=(episodes.task,))


@lru_cache(maxsize=16)
def _dataset(path: Path, task: Task) -> Dataset:
    return open_dataset(path, task)
