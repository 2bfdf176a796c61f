"""The functions of the public interface: ``import beliefscope as bs``. Names of filters and data are enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from beliefscope.datasets import store
from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults, read_faults
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, shipped
from beliefscope.filters.evaluate import Metrics
from beliefscope.filters.evaluate import evaluate as evaluate_filter
from beliefscope.filters.external.load import ExternalFilter, as_external, load_external
from beliefscope.filters.names import is_code
from beliefscope.filters.start_offset import StartOffset
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.diagnose import diagnose as diagnose_episodes
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.healthy import profile_of
from beliefscope.inspect.likelihood import COARSE, MapEngine
from beliefscope.inspect.maps.likelihood_map import LikelihoodMap, Quantity
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.trace import trace as trace_episode
from beliefscope.recordings.sweep_table import Experiments
from beliefscope.recordings.write import write_recording

Filter = Checkpoint | str | Path
Data = Dataset | str | Path


def load_filter(source: object, task: Task | str = "") -> Checkpoint:
    """A filter.

    Args:
        source: ``TASK/NAME`` of a pretrained filter, such as ``door/crossmodal-pf``; the path of a ``.safetensors``
            checkpoint; a build function, ``path/to/file.py:build`` or ``package.module:build``; or your own filter: a
            ``torch.nn.Module``, any other object, a function, or an ``Adapter`` of one (docs/own_filter.md).
        task: of a filter of your own: its definition, name or ``path/to/file.py:NAME``.

    Raises BadInput if there is no such filter, or if it does not fit the task.
    """
    if isinstance(source, Checkpoint):
        return source
    if isinstance(source, Path) or (isinstance(source, str) and source.endswith(".safetensors")):
        given = (load_task(task),) if isinstance(task, Task) or ":" in task else ()
        return load_checkpoint(Path(source), given)
    if not isinstance(source, str):
        return as_external(source, type(source).__name__, task)
    if is_code(source):
        return load_external(source, task)
    name, _, filter_ = source.partition("/")
    if not filter_:
        raise BadInput(f"filter {source!r} is neither TASK/NAME, such as door/crossmodal-pf, nor a .safetensors file")
    return load_checkpoint(shipped(name, filter_))


def open_dataset(source: str | Path, task: Task | None = None) -> Dataset:
    """Episodes of a file or folder (docs/data.md), or the sample data set of a task, such as ``door``.

    Raises BadInput if there is none, or if it is damaged.
    """
    if isinstance(source, str) and source in TASKS and not Path(source).exists():
        return store.open_dataset(store.sample_path(load_task(source)))
    return store.open_dataset(source, task)


def trace(
    filter_: Filter,
    data: Data,
    episode: int | None = None,
    *,
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
) -> Trace:
    """Run a filter over one episode, by default the first held-out one, and keep everything that it computes.

    Args:
        faults: sensor faults to inject, such as ``blackout=0.4`` (docs/data.md#sensor-faults).

    Raises BadInput for an unknown filter, episode or fault, and if the data are of another task.
    """
    checkpoint = load_filter(filter_)
    episodes = _episodes(data, checkpoint)
    index = episodes.held_out()[0] if episode is None else episode
    return trace_episode(checkpoint, episodes[index], index, seed, particles, _faults(faults, checkpoint))


def maps(
    filter_: Filter,
    run: Trace,
    steps: int | Sequence[int],
    *,
    size: int = COARSE,
    quantity: Quantity | None = None,
    components: tuple[str, ...] = (),
) -> list[LikelihoodMap]:
    """Maps of a trace at one or several steps: by modality and fused, over two state components.

    Args:
        filter_: that of the trace. size: cells per side. quantity: ``likelihood`` or ``posterior``.
        components: names of the components; default: those of the task.

    Raises BadInput for a filter without maps, and for steps outside of the trace.
    """
    engine = MapEngine(load_filter(filter_), run)
    indices = [steps] if isinstance(steps, int) else steps
    return [engine.map(step, size=size, quantity=quantity, components=components) for step in indices]


def inspect_run(run: Trace, filter_: Filter | None = None) -> Mapping[str, Diagnostic]:
    """All diagnostics that apply to a trace and take less than two seconds, by name (docs/diagnostics.md).

    Args:
        filter_: that of the trace; some diagnostics need it.
    """
    return quick(run, None if filter_ is None else load_filter(filter_))


def diagnose(
    filter_: Filter,
    data: Data,
    episodes: Sequence[int] | None = None,
    *,
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float = 0.05,
    profile_from: Data | None = None,
) -> Diagnosis:
    """Name the probable cause of a fault, with evidence and the effect of undoing it (docs/diagnose.md).

    Args:
        episodes: indices; default: the held-out ones. faults: to inject first, to try the diagnosis.
        alarm_rate: probability that a healthy filter is not called healthy.
        profile_from: clean data whose held-out episodes become the healthy record; default: that of the filter.

    Raises BadInput for a filter without a healthy record.
    """
    checkpoint = load_filter(filter_)
    source, injected = _episodes(data, checkpoint), _faults(faults, checkpoint)
    indices = source.held_out() if episodes is None else episodes
    profile = None
    if profile_from is not None:
        clean = _episodes(profile_from, checkpoint)
        profile = profile_of(checkpoint, [clean[i] for i in clean.held_out()], str(clean.path))
    by_index = {index: injected.apply(source[index], seed) for index in indices}
    return diagnose_episodes(
        checkpoint, by_index, seed=seed, particles=particles, alarm_rate=alarm_rate, profile=profile
    )


def evaluate(
    filter_: Filter,
    data: Data,
    episodes: Sequence[int] | None = None,
    *,
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
    start_offset: str = "",
) -> Metrics:
    """Accuracy and consistency of a filter, its baselines and its modalities, as ``beliefscope evaluate``.

    Args:
        episodes: indices; default: the held-out ones.
        start_offset: distance of the first belief from the true state, such as ``3cm,20deg``.
    """
    checkpoint = load_filter(filter_)
    source = _episodes(data, checkpoint)
    return evaluate_filter(
        checkpoint if isinstance(checkpoint, ExternalFilter) else checkpoint.filter,
        [source[index] for index in (source.held_out() if episodes is None else episodes)],
        faults=_faults(faults, checkpoint),
        particles=particles,
        seed=seed,
        start_offset=StartOffset.parse(start_offset, checkpoint.task),
        baselines=True,
        modalities=True,
    )


def record(run: Trace, path: str | Path, filter_: Filter | None = None, map_stride: int = 10) -> Path:
    """Write a Rerun recording of a trace, with maps of every ``map_stride``-th step if the filter is given."""
    steps = range(0, len(run), map_stride)
    layers = None if filter_ is None else MapEngine(load_filter(filter_), run).maps(steps)
    return write_recording(run, path, maps=layers, diagnostics=inspect_run(run, filter_))


def experiments(*sweeps: str | Path) -> Experiments:
    """The results of sweeps as tables for SQL, Arrow and pandas (docs/sweep.md)."""
    return Experiments(map(Path, sweeps))


def serve(
    filters: Sequence[str | Path | Checkpoint] = (),
    data: Sequence[str | Path] = (),
    *,
    workspace: str | Path = "workspace",
    port: int = 8000,
) -> None:
    """Serve the dashboard on this machine until interrupted: all included filters and data, and these ones.

    Args:
        filters: checkpoint files, or filters of your own (``load_filter``), which run in this process only.
        workspace: folder for recordings and traces; created if missing. port: 0 selects a free one.

    Raises BadInput for unusable files, and if the port is not available.
    """
    from beliefscope.app.runs.catalog import PRETRAINED, SAMPLE, short_names
    from beliefscope.app.runs.settings import Settings
    from beliefscope.app.server.main import serve as serve_until_signal

    paths = short_names([Path(f) for f in filters if not isinstance(f, Checkpoint)], PRETRAINED)
    own = {f.name: f for f in filters if isinstance(f, Checkpoint)}
    settings = Settings(Path(workspace), short_names(map(Path, data), {SAMPLE}), {**paths, **own})
    serve_until_signal(settings, port=port)


def _episodes(data: Data, checkpoint: Checkpoint) -> Dataset:
    return data if isinstance(data, Dataset) else open_dataset(data, checkpoint.task)


def _faults(faults: str | Faults, checkpoint: Checkpoint) -> Faults:
    return read_faults(faults, checkpoint.task) if isinstance(faults, str) else faults
