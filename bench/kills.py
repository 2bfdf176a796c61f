"""``kill -9`` at random moments: of collection, training, fine-tuning, tracing, recording, studies and live runs.

    python bench/kills.py --kills 200 --seed 0

Each run is killed again and again, at moments drawn over the time that an unbroken one takes, until one comes through.
After every kill all that lies there must open, and be whole or known to be incomplete; in the end there must be what
the unbroken run made, bit by bit. The process that is killed is a fork of this one, which has PyTorch in it already.
Exit code 1 where anything was lost.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fuzz"))

import numpy as np
import torch
from valid_files import episodes

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import WHOLE
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, shipped
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.finetune import FineTune, finetune
from beliefscope.filters.finetuning.module_selection import digest
from beliefscope.filters.training.study import Cell, run_local
from beliefscope.filters.training.train import PLANS, train
from beliefscope.inspect.trace import Trace, arrays_of, begin, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import GrowingReader
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

MOST_IN_A_ROW = 6  # kills of one run, before it is let through
STEPS = 20  # of an episode

Result = dict[str, Any]
"""JSON: what must be the same whether a run was killed or not."""


@dataclass(frozen=True)
class Kind:
    """What is killed.

    Attributes:
        run: makes its files in a folder, or goes on with what lies there. opens: looks at what a kill left; raises
            where that is neither whole nor known to be incomplete. result: of a run that came through.
    """

    run: Callable[[Path], None]
    opens: Callable[[Path], None]
    result: Callable[[Path], Result]


@cache
def parent() -> Checkpoint:
    return load_checkpoint(shipped("door", "crossmodal-pf"))


@cache
def traced(seed: int) -> Trace:
    return trace(parent(), episodes("door", STEPS)[0], seed=seed)


def same(one: Trace, other: Trace, steps: int | None = None) -> bool:
    """Bit by bit, over the first steps of the other."""
    mine, theirs = arrays_of(one), arrays_of(other)
    static = ("start_mean", "start_covariance")
    return mine.keys() == theirs.keys() and all(
        mine[name].tobytes() == (theirs[name] if name in static else theirs[name][:steps]).tobytes() for name in mine
    )


def weights(filter_: Filter) -> str:
    return digest(filter_, filter_.state_dict().keys())


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def every_file(folder: Path, suffix: str) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob(f"*{suffix}")) if not path.name.startswith("."))


# Collection.


def collects(folder: Path) -> None:
    collect("push", 4, 12, 7, 1, folder / "push.h5")


def collected(folder: Path) -> None:
    for path in every_file(folder, ".h5"):
        with open_dataset(path) as data:
            list(data)


# Training, and a child of it.


def trains(folder: Path) -> None:
    path = folder / "mine.safetensors"
    plan = replace(PLANS["smoke"], dynamics=12, models=30, alone=4)
    made = train(
        architecture("door", "haptics-ekf"),
        episodes("door", STEPS),
        data_hash="0",
        plan=plan,
        partial=folder / "partial",
    )
    save_checkpoint(made.filter, "haptics-ekf", {"metrics": made.record["metrics"]}, path)


def tunes(folder: Path) -> None:
    asked = FineTune(train=("haptics-only",), length=8, windows=4, steps=8, check=1, patience=8, particles=8)
    made = finetune(parent(), episodes("door", STEPS), data_hash="0", settings=asked, partial=folder / "partial")
    assert made is not None
    save_checkpoint(made.filter, "child", {"metrics": made.record["metrics"]}, folder / "mine.safetensors")


def checkpoints(folder: Path) -> None:
    for path in every_file(folder, ".safetensors"):
        if "parts" not in path.parts:
            load_checkpoint(path)


def trained(folder: Path) -> Result:
    made = load_checkpoint(folder / "mine.safetensors")
    return {"weights": weights(made.filter), "record": dict(made.record)}


# Traces and recordings.


def saves(folder: Path) -> None:
    for seed in (0, 1) * 20:
        save_trace(traced(seed), folder / "run.trace")


def saved(folder: Path) -> None:
    for path in every_file(folder, ".trace"):
        found = load_trace(path)
        assert same(found, traced(found.seed)), "a trace that was never saved"


def records(folder: Path) -> None:
    write_recording(traced(0), folder / "run.rrd")


def recorded(folder: Path) -> None:
    for path in every_file(folder, ".rrd"):
        assert same(read_recording(path), traced(0)), "a recording that is not whole"


# A study.


def cells(folder: Path) -> list[Cell]:
    data = folder.parent / "door.h5"
    if not data.exists():
        write_dataset(data, DOOR, episodes("door", STEPS))
    with open_dataset(data) as opened:
        return [Cell("door", "haptics-ekf", seed, "smoke", "door", data, opened.hash) for seed in (0, 1)]


def studies(folder: Path) -> None:
    for _, document in run_local(cells(folder), folder):
        assert "error" not in document, document["error"]


def studied(folder: Path) -> Result:
    found = [cell.finished(folder) for cell in cells(folder)]
    filters = [load_checkpoint(cell.path(folder, ".safetensors")).filter for cell in cells(folder)]
    return {"metrics": [one and one["metrics"] for one in found], "weights": [weights(one) for one in filters]}


# A live run.


@torch.no_grad()
def lives(folder: Path) -> None:
    episode = episodes("door", STEPS)[0]
    run = begin(parent(), episode, 0, 0, 300, WHOLE)
    number = len(list(folder.glob("*.live")))
    with LiveRecorder(
        f"run{number}", parent(), folder=folder, start=run.start, like=episode, expected=len(episode), **run.given
    ) as live:
        generator = run.generator()
        belief = parent().filter.start(run.start, 300, generator)
        for t in range(len(episode)):
            belief, known = parent().filter.step(belief, run.evidence[t], generator)
            live.step(
                known,
                observations={key: array[t] for key, array in run.episode.observations.items()},
                control=run.episode.controls[t],
                truth=run.episode.states[t],
                contact=bool(run.episode.contact[t]),
                qpos=run.episode.qpos[t],
                evidence=run.evidence[t],
            )
            time.sleep(0.01)


def lived(folder: Path) -> None:
    for path in every_file(folder, ".live"):
        if path.stat().st_size == 0:
            continue  # killed between its making and its header
        reader = GrowingReader(path)
        reader.poll()
        found = reader.part()
        assert same(found, traced(0), len(found)), "steps that the filter never took"
        reader.close()
    for path in every_file(folder, ".rrd"):
        with suppress(BadInput):  # of a run that was cut off there is no whole trace; but its views open
            read_recording(path)


def the_last(folder: Path) -> Result:
    path = max(every_file(folder, ".live"), key=lambda one: one.stat().st_mtime_ns)
    reader = GrowingReader(path)
    reader.poll()
    assert reader.finished
    drawn = read_recording(path.with_suffix(".rrd"))
    return {"same": same(reader.part(), traced(0)), "recording": same(drawn, traced(0))}


KINDS: dict[str, Kind] = {
    "collection": Kind(collects, collected, lambda folder: {"sha": sha(folder / "push.h5")}),
    "training": Kind(trains, checkpoints, trained),
    "fine-tuning": Kind(tunes, checkpoints, trained),
    "saving traces": Kind(saves, saved, lambda folder: {"sha": sha(folder / "run.trace")}),
    "recording": Kind(records, recorded, lambda folder: {"same": same(read_recording(folder / "run.rrd"), traced(0))}),
    "study": Kind(studies, checkpoints, studied),
    "live": Kind(lives, lived, the_last),
}


@dataclass
class Tally:
    """What came of one kind."""

    runs: int = 0
    kills: int = 0
    opened: int = 0
    equal: int = 0
    temporary: int = 0
    seconds: float = 0.0


def forked(work: Callable[[], Any], after: float | None = None) -> tuple[bool, Any]:
    """Whether it ended by itself, and what it gave as JSON. after: s until it is killed."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        code = 1
        try:
            os.close(reading)
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            said = json.dumps(work())
            code = 0
        except BaseException:
            said = json.dumps({"failed": traceback.format_exc()})
        finally:
            os.write(writing, said.encode()[:60_000])
            os._exit(code)
    os.close(writing)
    if after is not None:
        time.sleep(after)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    with os.fdopen(reading, "rb") as pipe:
        said = pipe.read()
    killed = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    return not killed, json.loads(said) if said and not killed else None


def kill(kind: Kind, kills: int, rng: random.Random) -> Iterator[Tally | str]:
    """Kills until there were so many; the tally after each run, and a line for each thing that was lost."""
    tally, began = Tally(), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="kills-") as place:

        def run(folder: Path) -> Result:
            kind.run(folder)
            return kind.result(folder)

        whole = Path(place) / "whole"
        whole.mkdir()
        start = time.monotonic()
        _, wanted = forked(lambda: run(whole))
        takes = time.monotonic() - start
        if "failed" in wanted:
            yield f"the unbroken run failed: {wanted['failed']}"
            return
        while tally.kills < kills:
            folder = Path(place) / f"run{tally.runs}"
            folder.mkdir()
            tally.runs += 1
            for attempt in range(MOST_IN_A_ROW + 1):
                last = attempt == MOST_IN_A_ROW
                after = None if last else rng.uniform(0.0, takes)
                done, found = forked(lambda folder=folder: run(folder), after)  # type: ignore[misc]
                if done:
                    break
                tally.kills += 1
                _, said = forked(lambda folder=folder: kind.opens(folder))  # type: ignore[misc]
                if said is None:
                    tally.opened += 1
                else:
                    yield f"after a kill: {said['failed']}"
            tally.temporary += sum(path.is_file() for path in folder.rglob(".*[!k]"))
            tally.equal += found == wanted
            if found != wanted:
                yield f"not as the unbroken run: {str(found)[-1500:]}\nwanted {str(wanted)[:300]}"
            tally.seconds = time.monotonic() - began
            yield tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="kind", help=f"some of: {', '.join(KINDS)}")
    parser.add_argument("--kills", type=int, default=200, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if unknown := set(given.kinds) - KINDS.keys():
        parser.error(f"kind {min(unknown)!r} does not exist. Available: {', '.join(KINDS)}")
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    kinds = given.kinds or list(KINDS)
    traced(0), traced(1)
    print("| what was killed | runs | kills | all opened | as unbroken | temporary files left | seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    lost = False
    for name in kinds:
        tally = Tally()
        for said in kill(KINDS[name], -(-given.kills // len(kinds)), random.Random(f"{given.seed} {name}")):
            if isinstance(said, Tally):
                tally = said
            else:
                lost = True
                print(f"    {name}: {said}", file=sys.stderr, flush=True)
        print(
            f"| {name} | {tally.runs} | {tally.kills} | {tally.opened} | {tally.equal} | {tally.temporary} "
            f"| {tally.seconds:.0f} |",
            flush=True,
        )
    sys.exit(lost)


if __name__ == "__main__":
    main()
