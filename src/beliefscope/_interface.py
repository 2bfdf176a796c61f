"""The functions of the public interface: ``import beliefscope as bs``. Names of filters and data are enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from beliefscope.datasets import store
from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.dataset import Dataset, EpisodeList
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.episode_check import checked_list
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.faults.injection import Faults, read_faults
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.evaluate import Metrics, evaluate as evaluate_filter
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter, as_external, load_external
from beliefscope.filters.finetuning.defaults import settings_from
from beliefscope.filters.finetuning.finetune import finetune as finetune_filter
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import parse_slices
from beliefscope.filters.finetuning.success import Criterion
from beliefscope.filters.names import is_code
from beliefscope.filters.start_offset import StartOffset
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.compare.checkpoints import CheckpointComparison, compare_checkpoints
from beliefscope.inspect.diagnosis.cause import Diagnosis
from beliefscope.inspect.diagnosis.diagnose import diagnose as diagnose_episodes
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.failures.events import Failures, find_failures as rank_failures
from beliefscope.inspect.healthy import measure_profile, profile_of
from beliefscope.inspect.maps.likelihood_map import LikelihoodMap, Quantity
from beliefscope.inspect.maps.map_engine import COARSE, MapEngine
from beliefscope.inspect.sweep import Inputs, location, source_of
from beliefscope.inspect.trace import Trace, trace as trace_episode
from beliefscope.recordings.experiments import Experiments
from beliefscope.recordings.interactive.export import write_interactive
from beliefscope.recordings.sweep_table import run_sweep
from beliefscope.recordings.write import write_recording

Filter = Checkpoint | str | Path
Data = Dataset | Episode | Sequence[Episode] | str | Path


def load_filter(source: object, task: Task | str = "", name: str = "") -> Checkpoint:
    """Load a filter.

    Args:
        source: ``TASK/NAME`` of a pretrained filter, such as ``door/crossmodal-pf``; the path of a ``.safetensors``
            checkpoint; a build function, ``FILE.py:FUNCTION`` or ``MODULE:FUNCTION``, each also with
            ``@weights.safetensors``; or your own filter: a ``torch.nn.Module``, any other object, a function, or an
            ``Adapter`` of one (docs/own_filter.md).
        task: definition, name or ``FILE.py:NAME`` of the task, for a filter of your own.
        name: name for display, for a filter of your own; default: its class or function.

    Raises BadInput if there is no such filter, or if it does not fit the task.
    """
    if isinstance(source, Checkpoint):
        return source
    if isinstance(source, Path) or (
        isinstance(source, str) and source.endswith(".safetensors") and not is_code(source)
    ):
        given = (load_task(task),) if isinstance(task, Task) or ":" in task else ()
        return load_checkpoint(Path(source), given)
    if not isinstance(source, str):
        filter_ = source.module if isinstance(source, Adapter) else source
        kind = getattr(filter_, "__name__", type(filter_).__name__)
        return as_external(source, kind, task, name=name or kind)
    if is_code(source):
        return load_external(source, task)
    return load_checkpoint(_pretrained_path(source))


def open_dataset(source: str | Path | Episode | Sequence[Episode], task: Task | None = None) -> Dataset:
    """Open a file or folder (docs/data.md), the sample data set of a task, such as ``door``, or a list of episodes.

    Raises BadInput if there is none, or if it is damaged.
    """
    if not isinstance(source, str | Path):
        return checked_list([source] if isinstance(source, Episode) else source)
    if isinstance(source, str) and source in TASKS and not Path(source).exists():
        return store.open_dataset(store.sample_path(load_task(source)))
    return store.open_dataset(source, task)


def save_dataset(episodes: Sequence[Episode], path: str | Path) -> Path:
    """Write episodes of one task to an HDF5 file, which all commands read as ``--data``.

    Raises BadInput, and writes nothing, if an episode does not fit its task: a missing or undeclared sensor, another
    shape or type, a number that is not finite, times that do not ascend.
    """
    source = checked_list(episodes)
    store.write_dataset(path, source.task, source)
    return Path(path)


def trace(
    filter_: Filter,
    data: Data,
    episode: int | None = None,
    *,
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
    particles_kept: int = 10_000,
) -> Trace:
    """Run a filter over one episode, by default the first held-out one, and keep everything that it computes.

    Args:
        faults: sensor faults to inject, such as ``blackout=0.4`` (docs/data.md#sensor-faults).
        particles_kept: maximum number of particles of each step in the trace; moments are of all.

    Raises BadInput for an unknown filter, episode or fault, and if the data are of another task.
    """
    checkpoint = _filter(filter_, data)
    episodes = _episodes(data, checkpoint)
    index = episodes.held_out()[0] if episode is None else episode
    injected = _faults(faults, checkpoint)
    return trace_episode(checkpoint, episodes[index], index, seed, particles, injected, particles_kept=particles_kept)


def maps(
    filter_: Filter,
    run: Trace,
    steps: int | Sequence[int],
    *,
    size: int = COARSE,
    quantity: Quantity | None = None,
    components: tuple[str, ...] = (),
) -> list[LikelihoodMap]:
    """Compute maps of a trace at one or several steps: by modality and fused, over two state components.

    Args:
        filter_: that of the trace. size: cells per side. quantity: ``likelihood`` or ``posterior``.
        components: names of the components; default: those of the task.

    Raises BadInput for a filter without maps, and for steps outside of the trace.
    """
    engine = MapEngine(load_filter(filter_), run)
    indices = [steps] if isinstance(steps, int) else steps
    return [engine.map(step, size=size, quantity=quantity, components=components) for step in indices]


def inspect_run(run: Trace, filter_: Filter | None = None) -> Mapping[str, Diagnostic]:
    """Compute all diagnostics that apply to a trace and take less than two seconds, by name (docs/diagnostics.md).

    Args:
        filter_: that of the trace; some diagnostics need it.
    """
    return quick(run, None if filter_ is None else load_filter(filter_))


def healthy_record(filter_: Filter, data: Data, episodes: Sequence[int] | None = None) -> HealthyProfile:
    """Measure the statistics of a filter over clean episodes, with which ``diagnose`` compares others.

    Args:
        episodes: indices; default: the held-out ones.
    """
    checkpoint = _filter(filter_, data)
    source = _episodes(data, checkpoint)
    indices = source.held_out() if episodes is None else episodes
    return profile_of(checkpoint, [source[i] for i in indices], str(source.path), indices=indices)


def diagnose(
    filter_: Filter,
    data: Data,
    episodes: Sequence[int] | None = None,
    *,
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
    alarm_rate: float | None = None,
    profile_from: Data | HealthyProfile | None = None,
) -> Diagnosis:
    """Name the probable cause of a fault, with evidence and the effect of undoing it (docs/diagnose.md).

    Args:
        episodes: indices; default: the held-out ones. faults: to inject first, to try the diagnosis.
        alarm_rate: probability that a healthy filter is not called healthy. Default: 0.02, or 1 / (n + 1) for one
            episode and a healthy record of n < 49 episodes.
        profile_from: ``healthy_record``, such as that of an earlier version of the filter, or clean data for one of
            this filter; default: that of the checkpoint.

    Raises BadInput for a filter without a healthy record, and for a record of another task.
    """
    checkpoint = _filter(filter_, data)
    source, injected = _episodes(data, checkpoint), _faults(faults, checkpoint)
    indices = source.held_out() if episodes is None else episodes
    if profile_from is None or isinstance(profile_from, HealthyProfile):
        profile = profile_from
    else:
        profile = healthy_record(checkpoint, profile_from)
    if profile is not None and profile.task not in ("", checkpoint.task.name):
        raise BadInput(
            f"healthy record of task {profile.task}, but {checkpoint.name} is of task {checkpoint.task.name}"
        )
    faulty = injected.apply_all(source, indices, seed)
    return diagnose_episodes(checkpoint, faulty, seed=seed, particles=particles, alarm_rate=alarm_rate, profile=profile)


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
    """Measure accuracy and consistency of a filter, its baselines and modalities, as ``beliefscope evaluate`` does.

    Args:
        episodes: indices; default: the held-out ones.
        start_offset: distance of the first belief from the true state, such as ``3cm,20deg``.
    """
    checkpoint = _filter(filter_, data)
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


def find_failures(
    filter_: Filter,
    data: Data,
    episodes: Sequence[int] | None = None,
    *,
    by: str = "error",
    faults: str | Faults = "",
    seed: int = 0,
    particles: int = 300,
) -> Failures:
    """Run a filter over episodes and rank the events at which it fails (docs/diagnostics.md#failures).

    Args:
        episodes: indices; default: the held-out ones.
        by: ``error``, the name of an angle, ``nees``, ``ess``, ``disagreement`` or ``regret``.

    Raises BadInput for a score that the filter or task does not have.
    """
    checkpoint = _filter(filter_, data)
    source = _episodes(data, checkpoint)
    injected = _faults(faults, checkpoint)
    return rank_failures(checkpoint, source, episodes, by=by, faults=injected, seed=seed, particles=particles)


def finetune(
    filter_: Filter,
    data: Data,
    path: str | Path,
    *,
    train: Sequence[str] = (),
    freeze: Sequence[str] = (),
    faults: Sequence[str] = (),
    slices: Sequence[str] = (),
    **settings: Any,
) -> Checkpoint:
    """Train selected modules further and write the result as a checkpoint (docs/finetune.md).

    Args:
        data: all episodes; those of the split ``train`` are trained on.
        path: of the new checkpoint, ``NAME.safetensors``. The base checkpoint is not changed.
        train, freeze: presets and patterns of trained and frozen modules; default: those of the filter.
        faults, slices: sensor faults and data slices to learn; default: the fault that the training data lack.
        settings: other settings of ``FineTune``, such as ``steps=300``, ``rate=3e-4`` and ``clean_weight=0.5``;
            ``success`` as text.

    Raises BadInput for names that match no module, and for settings that do not exist.
    """
    base = load_filter(filter_)
    if unknown := settings.keys() - FineTune.__dataclass_fields__.keys():
        raise unknown_name("fine-tuning setting", min(unknown), FineTune.__dataclass_fields__)
    if isinstance(success := settings.get("success"), str):
        settings["success"] = Criterion.parse(success)
    chosen = settings_from(base, train, freeze, slices, faults)
    source = _episodes(data, base)
    episodes = list(source)
    tuned = finetune_filter(base, episodes, data_hash=source.hash, settings=replace(chosen, **settings))
    assert tuned is not None  # it has no callback that stops it
    profile = measure_profile(tuned.filter, base.name, episodes, str(source.path))
    save_checkpoint(tuned.filter, base.name, tuned.record, Path(path), profile)
    return load_checkpoint(Path(path), (base.task,))


def compare(
    before: Filter,
    after: Filter,
    data: Data,
    episodes: Sequence[int] | None = None,
    *,
    slices: Sequence[str] = (),
    seed: int = 0,
    particles: int = 300,
) -> CheckpointComparison:
    """Report what improved and what regressed between two filters of one task, with intervals over episodes.

    Args:
        episodes: indices; default: the held-out ones. slices: to evaluate in addition to the standard ones.

    Raises BadInput for filters that cannot be compared.
    """
    first, second = _filter(before, data), _filter(after, data)
    own = parse_slices(slices, (), first.task)
    source = _episodes(data, first)
    return compare_checkpoints(first, second, source, episodes, slices=own, particles=particles, seed=seed)


def sweep(
    folder: str | Path,
    filters: Filter | Sequence[Filter],
    data: str | Path | Sequence[str | Path] = (),
    *,
    faults: str | Sequence[str] = ("",),
    seeds: int = 1,
    particles: int = 300,
    all_episodes: bool = False,
    workers: int = 1,
) -> Experiments:
    """Run many checkpoints over many episodes and store a table of the results; resumes if interrupted (docs/sweep.md).

    Args:
        folder: of the sweep; created if missing.
        filters: one or more checkpoints or their files, ``TASK/NAME``, or ``FILE.py:FUNCTION[@WEIGHTS]``.
        data: one or more files of episodes; default: the sample data set of each filter's task.
        faults: each is run; an empty text is clean data. seeds: number of seeds, from 0.
        all_episodes: whether to run over training episodes as well. workers: processes.
    """
    given = [filters] if isinstance(filters, str | Path | Checkpoint) else filters
    paths = [data] if isinstance(data, str | Path) else data
    texts = (faults,) if isinstance(faults, str) else tuple(faults)
    sets = tuple(store.sample_path(str(d)) if str(d) in TASKS else Path(d).resolve() for d in paths)
    sources = [str(f) if isinstance(f, str | Path) else source_of(load_filter(f)) for f in given]
    files = tuple(location(f) if f.endswith(".safetensors") or is_code(f) else _pretrained_path(f) for f in sources)
    inputs = Inputs(files, sets, texts, tuple(range(seeds)), particles, all_episodes)
    Path(folder).mkdir(exist_ok=True)
    run_sweep(inputs.cells(), Path(folder).resolve(), workers=workers)
    return Experiments([Path(folder)])


def record(run: Trace, path: str | Path, filter_: Filter | None = None, map_stride: int = 10) -> Path:
    """Write a Rerun recording of a trace, with maps of every ``map_stride``-th step if the filter is given."""
    steps = range(0, len(run), map_stride)
    layers = None if filter_ is None else MapEngine(load_filter(filter_), run).maps(steps)
    return write_recording(run, path, maps=layers, diagnostics=inspect_run(run, filter_))


def export_page(run: Trace, path: str | Path, filter_: Filter | None = None) -> Path:
    """Write an interactive page of a trace, one HTML file that works offline; maps need the filter."""
    write_interactive(run, Path(path), None if filter_ is None else load_filter(filter_))
    return Path(path)


def experiments(*sweeps: str | Path) -> Experiments:
    """Open the results of sweeps as tables for SQL, Arrow and pandas (docs/sweep.md)."""
    return Experiments(map(Path, sweeps))


def serve(
    filters: Sequence[str | Path | Checkpoint] = (),
    data: Sequence[str | Path] = (),
    *,
    workspace: str | Path = "workspace",
    port: int = 8000,
) -> None:
    """Serve the dashboard on this machine until interrupted: pretrained filters, sample data, and the given ones.

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


def _pretrained_path(text: str) -> Path:
    """File of a pretrained filter, ``TASK/NAME``."""
    task, _, name = text.partition("/")
    if not name:
        raise BadInput(f"filter {text!r} is neither TASK/NAME, such as door/crossmodal-pf, nor a .safetensors file")
    return pretrained_path(task, name)


def _filter(filter_: object, data: Data) -> Checkpoint:
    """The filter. The data define the task of a filter object of your own."""
    own = not isinstance(filter_, Checkpoint | str | Path)
    source = data if isinstance(data, Dataset | Episode | str | Path) else EpisodeList(data)
    return load_filter(filter_, source.task if own and isinstance(source, Dataset | Episode) else "")


def _episodes(data: Data, checkpoint: Checkpoint) -> Dataset:
    return data if isinstance(data, Dataset) else open_dataset(data, checkpoint.task)


def _faults(faults: str | Faults, checkpoint: Checkpoint) -> Faults:
    return read_faults(faults, checkpoint.task) if isinstance(faults, str) else faults
