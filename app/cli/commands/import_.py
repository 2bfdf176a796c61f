from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.datasets.episode import Episode
    from beliefscope.inspect.trace import Trace

RECORDINGS = (".rrd", ".live")


def import_(
    source: Path = opt.argument("FILE", "Recording (.rrd), file of a live run (.live), or log (file or folder)."),
    output: Path | None = opt.output_file(
        "RUN.trace|RUN.live|DATA.h5",
        "Output: a trace, a run for the folder live of a workspace, or a data set.",
        *(".trace", ".live", ".h5"),
    ),
    map: Path | None = opt.option("MAP.toml", "Map of the columns of a log (docs/import.md).", None, "--map"),
    guess: bool = opt.flag("Print a first map of a log instead of importing it.", "--guess"),
    episode: int = opt.option("I", "Index of the episode of a log that becomes a trace.", 0, "--episode"),
    split: str | None = opt.option(
        "NAME",
        "train, val or test: split of all episodes of a log; auto: of every ten, one for validation and one for "
        "tests. Default: test.",
        None,
        "--split",
    ),
    task: str = opt.TASK_OF_FILES,
) -> console.Result:
    """Import a recording or a log as a trace or data set.

    The trace of a recording has the recorded arrays, including their types, so all diagnostics give the same results.
    Of a live run that is in progress or was killed, the complete steps are imported.

    For a log, a map of a few lines names the columns of true states, sensors and recorded estimates. Sensors and states
    become a data set; an estimate of one episode becomes a trace, which every command reads without the filter, or a
    run that the page displays. Filters are trained and fine-tuned on the episodes of --split train, validated on those
    of val and evaluated on those of test; --split auto makes a data set for all three.

    Formats of logs: NumPy (.npz), HDF5 (.h5, .hdf5), CSV and Parquet, also folders of them with one file per episode;
    MCAP, ROS 2 bags (folder or .db3), Zarr replay buffers (folder or .zip), LeRobot data sets (folder, version 3), and
    Rerun recordings of other programs (.rrd with --map or --guess).

    \b
    Examples:
      beliefscope import run.rrd -o run.trace
      beliefscope import log.csv --guess
      beliefscope import log.csv --map map.toml -o log.h5
      beliefscope import logs --map map.toml --split auto -o logs.h5
      beliefscope import log.csv --map map.toml --episode 2 -o run.trace
      beliefscope import log.csv --map map.toml -o run.live
      beliefscope import drive.mcap --map map.toml -o drive.h5
    """
    from beliefscope.datasets.dataset import SPLITS
    from beliefscope.recordings.log_readers.column_map import read_map
    from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
    from beliefscope.recordings.log_readers.guess import guess_map
    from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace
    from beliefscope.recordings.open_trace import open_recording

    if guess:
        text = guess_map(preview_columns(source), source.stem)
        return console.Result({"map": text}, text.rstrip())
    if output is None:
        raise BadInput("give the output: -o RUN.trace, -o RUN.live or -o DATA.h5")
    if source.suffix.lower() in RECORDINGS and map is None:
        if split is not None:
            raise BadInput(f"--split applies to logs: {source.name} is a recording, whose episode already has a split")
        opt.check_output(output, ".trace", ".live")
        return _written(open_recording(source, task), output)
    if map is None:
        raise BadInput(f"the columns of {source.name} need a map: --map MAP.toml; --guess prints a first one")
    check_name("split", split or "test", (*SPLITS, "auto"))
    mapping = read_map(map)
    columns = read_columns(source, mapping)
    episodes = read_log(columns, mapping, source.name, split or "test")
    if output.suffix != ".h5":
        if not 0 <= episode < len(episodes):
            raise BadInput(f"episode {episode} does not exist: {source.name} has {plural(len(episodes), 'episode')}")
        result = _written(recorded_trace(columns, mapping, episodes, episode, source.name), output)
        values, text = _values([episodes[episode]])
        return replace(result, document={**result.document, **values}, text=f"{result.text}, {text}")
    return _data_set(episodes, output)


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
    parts = [f"{name} {r['min']:.4g} to {r['max']:.4g} {r['unit']}".rstrip() for name, r in ranges.items()]
    return {"dt": dt, "ranges": ranges}, "; ".join([durations_text(episodes), *parts])


def _written(trace: Trace, output: Path) -> console.Result:
    from beliefscope.inspect.trace import save_trace
    from beliefscope.inspect.traces.live_file import write_live

    (write_live if output.suffix == ".live" else save_trace)(trace, output)
    return opt.trace_result(trace, output)
