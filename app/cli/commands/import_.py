from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.inspect.trace import Trace
    from beliefscope.recordings.log_readers.column_map import ColumnMap

RECORDINGS = (".rrd", ".live")


def import_(
    sources: list[Path] = opt.argument(
        "FILE...", "Recording (.rrd), file of a live run (.live), or log (file or folder); several for a folder."
    ),
    output: Path | None = opt.option(
        "RUN.trace|RUN.live|DATA.h5|DIR",
        "Trace, data set, or run for a workspace's folder 'live'; or folder of traces (of runs, if named 'live').",
        None,
        "-o",
        "--output",
    ),
    map: Path | None = opt.option("MAP.toml", "Map of the columns of a log (docs/import.md).", None, "--map"),
    guess: bool = opt.flag("Print a first map of a log instead of importing it.", "--guess"),
    episode: int | None = opt.option(
        "I", "Index of the episode that becomes a trace. Default: all for a folder, else 0.", None, "--episode"
    ),
    split: str | None = opt.option(
        "NAME",
        "train, val or test: split of all episodes of a log; auto: of every ten, one for validation and one for "
        "tests. Default: test.",
        None,
        "--split",
    ),
    task: str = opt.TASK_OF_FILES,
) -> console.Result:
    """Import recordings and logs as traces or data sets.

    The trace of a recording has the recorded arrays, including their types, so all diagnostics give the same results.
    If a live run is in progress or was killed, its complete steps are imported. If the output is a folder, each file
    becomes a trace of the same name; a file with several episodes becomes one trace per episode, with its index after
    the name. In a folder named 'live', such as that of a workspace, they are runs, which the page displays. Files that
    cannot be imported are reported.

    For a log, a map of a few lines names the columns of true states, sensors and recorded estimates. Sensors and states
    become a data set; an estimate of one episode becomes a trace, which every command reads without the filter, or a
    run that the page displays. Filters are trained and fine-tuned on the episodes of --split train, validated on those
    of val and evaluated on those of test; --split auto makes a data set for all three.

    Formats of logs: NumPy (.npz), HDF5 (.h5, .hdf5), CSV and Parquet, also folders of them with one file per episode;
    MCAP and ROS 2 bags (folder or .db3), also folders of them; Zarr replay buffers (folder or .zip), LeRobot data sets
    (folder, version 3), and Rerun recordings of other programs (.rrd with --map or --guess).

    \b
    Examples:
      beliefscope import run.rrd -o run.trace
      beliefscope import first.rrd second.rrd -o traces
      beliefscope import log.csv --guess
      beliefscope import log.csv --map map.toml -o log.h5
      beliefscope import logs --map map.toml --split auto -o logs.h5
      beliefscope import log.csv --map map.toml --episode 2 -o run.trace
      beliefscope import logs --map map.toml -o workspace/live
      beliefscope import drive.mcap --map map.toml -o drive.h5
    """
    from beliefscope.datasets.dataset import SPLITS
    from beliefscope.recordings.log_readers.column_map import read_map
    from beliefscope.recordings.log_readers.columns import message_logs, preview_columns
    from beliefscope.recordings.log_readers.guess import guess_map

    sources = [log for source in sources for log in message_logs(source)[: 1 if guess else None] or [source]]
    if guess:
        if len(sources) > 1:
            raise BadInput(f"--guess prints the map of one log, not of {len(sources)}")
        text = guess_map(preview_columns(sources[0]), sources[0].stem)
        return console.Result({"map": text}, text.rstrip())
    if output is None:
        raise BadInput("give the output: -o RUN.trace, -o RUN.live or -o DATA.h5; or -o DIR for several files")
    check_name("split", split or "test", (*SPLITS, "auto"))
    mapping = None if map is None else read_map(map)

    def import_file(source: Path, output: Path, chosen: int | None = episode) -> list[console.Result]:
        if source.suffix.lower() in RECORDINGS and mapping is None:
            return [_recording(source, output, split, task)]
        return _log(source, output, mapping, split or "test", chosen)

    if not output.suffix or output.is_dir():
        return _folder(sources, output, import_file)
    opt.check_output(output, ".trace", ".live", ".h5")
    if len(sources) > 1:
        raise BadInput(f"{len(sources)} files need a folder as output, not {str(output)!r}")
    return import_file(sources[0], output, episode or 0)[0]


def _folder(
    sources: list[Path], folder: Path, import_file: Callable[[Path, Path], list[console.Result]]
) -> console.Result:
    """Write a trace, or a run into a folder ``live``, for each file or episode; report files with errors."""
    from beliefscope.recordings.log_readers.table_folder import table_files

    suffix = ".live" if folder.absolute().name == "live" else ".trace"  # the runs of a workspace
    names = [f"{source.stem}{suffix}" for source in sources]
    tables = [table_files(source) if source.is_dir() else [] for source in sources]
    stems = [stem for s, files in zip(sources, tables, strict=True) for stem in {s.stem, *(f.stem for f in files)}]
    if twice := next((stem for stem in stems if stems.count(stem) > 1), ""):
        raise BadInput(
            f"several files have the name {twice!r}: files need different names, without their suffixes, to become "
            "traces of one folder"
        )
    opt.check_folder(folder, "output")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"folder {str(folder)!r} cannot be created: {error.strerror}") from None
    opt.check_output(folder / names[0])
    if len(sources) == 1:
        results = import_file(sources[0], folder / names[0])
        if len(results) == 1:
            return results[0]
        described = [result.described() for result in results]
        return console.Result({"files": [d for d, _ in described]}, "\n".join(line for _, line in described))
    documents: list[dict[str, Any]] = []
    lines: list[str] = []
    for source, name in zip(sources, names, strict=True):
        try:
            for document, line in [result.described() for result in import_file(source, folder / name)]:
                lines.append(line)
                documents.append({"source": str(source), **document})
        except BadInput as error:
            documents.append({"source": str(source), "error": str(error)})
            console.note(f"error: {source}: {error}")
    failed = sum("error" in document for document in documents)
    lines.append(f"{len(sources) - failed} of {plural(len(sources), 'file')} imported")
    return console.Result({"files": documents}, "\n".join(lines), code=2 if failed else 0)


def _recording(source: Path, output: Path, split: str | None, task: str) -> console.Result:
    from beliefscope.recordings.open_trace import open_recording

    if split is not None:
        raise BadInput(f"--split applies to logs: {source.name} is a recording, whose episode already has a split")
    opt.check_output(output, ".trace", ".live")
    return _written(open_recording(source, task), output)


def _log(
    source: Path, output: Path, mapping: ColumnMap | None, split: str, episode: int | None
) -> list[console.Result]:
    """Write a data set, or the trace of an episode; of every episode, if it is None."""
    from beliefscope.recordings.log_readers.columns import read_columns
    from beliefscope.recordings.log_readers.messages import late_estimates
    from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace
    from beliefscope.recordings.log_readers.table_folder import FILE

    if mapping is None:
        raise BadInput(f"the columns of {source.name} need a map: --map MAP.toml; --guess prints a first one")
    columns = read_columns(source, mapping)
    episodes = read_log(columns, mapping, source.name, split)
    if output.suffix == ".h5":
        return [_data_set(episodes, output)]
    if episode is not None and not 0 <= episode < len(episodes):
        raise BadInput(f"episode {episode} does not exist: {source.name} has {plural(len(episodes), 'episode')}")
    if warning := late_estimates(columns, mapping):
        console.note(f"Warning: {source.name}: {warning}")
    results = []
    for index in range(len(episodes)) if episode is None else [episode]:
        path = output
        if episode is None and FILE in columns and not mapping.episode:
            path = output.with_name(f"{episodes[index].provenance['episode']}{output.suffix}")
        elif episode is None and len(episodes) > 1:
            path = output.with_stem(f"{output.stem}-{index}")
        result = _written(recorded_trace(columns, mapping, episodes, index, source.name), path)
        values, text = _values([episodes[index]])
        others = "" if episode is None or len(episodes) == 1 else f"; one of {len(episodes)} episodes (-o DIR: all)"
        results.append(replace(result, document={**result.document, **values}, text=f"{result.text}, {text}{others}"))
    return results


def _data_set(episodes: list[Episode], output: Path) -> console.Result:
    from beliefscope.datasets.dataset import SPLITS
    from beliefscope.datasets.store import write_dataset
    from beliefscope.recordings.log_readers.read_log import check_complete

    check_complete(episodes)
    write_dataset(output, episodes[0].task, episodes)
    steps = sum(len(e) for e in episodes)
    values, text = _values(episodes)
    splits = {name: sum(episode.split == name for episode in episodes) for name in SPLITS}
    document = {"task": episodes[0].task.name, "episodes": len(episodes), "steps": steps, **values, "splits": splits}
    parts = ", ".join(f"{number} {name}" for name, number in splits.items() if number)
    size = f"{plural(len(episodes), 'episode')} ({parts}) of {episodes[0].task.name}, {plural(steps, 'step')}"
    return console.Result(document, f"{size}, {text}", output)


def _values(episodes: list[Episode]) -> tuple[dict[str, Any], str]:
    """Duration of a step and ranges of the components, as JSON values and as text."""
    from beliefscope.datasets.dataset_statistics import component_ranges
    from beliefscope.datasets.episode import durations_text

    dt, ranges = episodes[0].dt, component_ranges(episodes)
    units = {name: "" if r["unit"] == "1" else f" {r['unit']}" for name, r in ranges.items()}
    parts = [f"{name} {r['min']:z.4g} to {r['max']:z.4g}{units[name]}".rstrip() for name, r in ranges.items()]
    return {"dt": dt, "ranges": ranges}, "; ".join([durations_text(episodes), *parts])


def _written(trace: Trace, output: Path) -> console.Result:
    from beliefscope.inspect.trace import save_trace
    from beliefscope.inspect.traces.live_file import write_live

    opt.check_output(output)
    (write_live if output.suffix == ".live" else save_trace)(trace, output)
    return opt.trace_result(trace, output)
