"""``kill -9`` at random times during collection, training, fine-tuning, tracing, recording, studies and live runs.

    python tools/stress/kills.py --kills 200 --seed 0

Each run is killed repeatedly, at random times over the duration of an uninterrupted run, until it completes. After
every kill, all files must be valid or identified as incomplete; the final result must equal that of the uninterrupted
run, bit by bit. The killed process is a fork of this one, which has imported PyTorch. Exit code 1 if anything is lost.
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
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "fuzz"))

import numpy as np
import torch
from valid_files import episodes

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import NO_FAULTS
from beliefscope.datasets.simulation.collect import collect
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.filters.catalog import architecture
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.filters.filter import Filter
from beliefscope.filters.finetuning.finetune import finetune
from beliefscope.filters.finetuning.module_selection import digest
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.study import Cell, run_local
from beliefscope.filters.training.train import train
from beliefscope.inspect.trace import Trace, arrays_of, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.inspect.traces.run import start_run
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

MAX_KILLS = 6  # of one run, which then completes
STEPS = 20  # of an episode

Result = dict[str, Any]
"""JSON: must be the same for killed and uninterrupted runs."""


@dataclass(frozen=True)
class Kind:
    """Process to kill.

    Attributes:
        run: writes files to a folder, or resumes from existing ones. check: validates the files after a kill; raises if
            one is invalid and not identified as incomplete. result: result of a completed run.
    """

    run: Callable[[Path], None]
    check: Callable[[Path], None]
    result: Callable[[Path], Result]


@cache
def base_checkpoint() -> Checkpoint:
    return load_checkpoint(pretrained_path("door", "crossmodal-pf"))


@cache
def traced(seed: int) -> Trace:
    return trace(base_checkpoint(), episodes("door", STEPS)[0], seed=seed)


def same(first: Trace, second: Trace, steps: int | None = None) -> bool:
    """Whether the first trace equals the first steps of the second, bit by bit."""
    left, right = arrays_of(first), arrays_of(second)
    static = ("start_mean", "start_covariance")
    return left.keys() == right.keys() and all(
        left[name].tobytes() == (right[name] if name in static else right[name][:steps]).tobytes() for name in left
    )


def weights(filter_: Filter) -> str:
    return digest(filter_, filter_.state_dict().keys())


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def every_file(folder: Path, suffix: str) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob(f"*{suffix}")) if not path.name.startswith("."))


# Collection.


def run_collection(folder: Path) -> None:
    collect("push", 4, 12, 7, 1, folder / "push.h5")


def check_collection(folder: Path) -> None:
    for path in every_file(folder, ".h5"):
        with open_dataset(path) as data:
            list(data)


# Training and fine-tuning.


def run_training(folder: Path) -> None:
    path = folder / "mine.safetensors"
    plan = replace(PLANS["smoke"], dynamics=12, models=30, single=4)
    result = train(
        architecture("door", "haptics-ekf"),
        episodes("door", STEPS),
        data_hash="0",
        plan=plan,
        partial=folder / "partial",
    )
    save_checkpoint(result.filter, "haptics-ekf", {"metrics": result.record["metrics"]}, path)


def run_finetuning(folder: Path) -> None:
    settings = FineTune(train=("haptics-only",), length=8, windows=4, steps=8, check=1, patience=8, particles=8)
    result = finetune(
        base_checkpoint(), episodes("door", STEPS), data_hash="0", settings=settings, partial=folder / "partial"
    )
    assert result is not None
    save_checkpoint(result.filter, "finetuned", {"metrics": result.record["metrics"]}, folder / "mine.safetensors")


def check_checkpoints(folder: Path) -> None:
    for path in every_file(folder, ".safetensors"):
        if "parts" not in path.parts:
            load_checkpoint(path)


def training_result(folder: Path) -> Result:
    checkpoint = load_checkpoint(folder / "mine.safetensors")
    return {"weights": weights(checkpoint.filter), "record": dict(checkpoint.record)}


# Traces and recordings.


def run_saving(folder: Path) -> None:
    for seed in (0, 1) * 20:
        save_trace(traced(seed), folder / "run.trace")


def check_traces(folder: Path) -> None:
    for path in every_file(folder, ".trace"):
        loaded = load_trace(path)
        assert same(loaded, traced(loaded.seed)), "unknown trace"


def run_recording(folder: Path) -> None:
    write_recording(traced(0), folder / "run.rrd")


def check_recordings(folder: Path) -> None:
    for path in every_file(folder, ".rrd"):
        assert same(read_recording(path), traced(0)), "incomplete recording"


# A study.


def cells(folder: Path) -> list[Cell]:
    data = folder.parent / "door.h5"
    if not data.exists():
        write_dataset(data, DOOR, episodes("door", STEPS))
    with open_dataset(data) as opened:
        return [Cell("door", "haptics-ekf", seed, "smoke", "door", data, opened.hash) for seed in (0, 1)]


def run_study(folder: Path) -> None:
    for _, document in run_local(cells(folder), folder):
        assert "error" not in document, document["error"]


def study_result(folder: Path) -> Result:
    documents = [cell.finished(folder) for cell in cells(folder)]
    filters = [load_checkpoint(cell.path(folder, ".safetensors")).filter for cell in cells(folder)]
    return {
        "metrics": [document and document["metrics"] for document in documents],
        "weights": [weights(f) for f in filters],
    }


# A live run.


@torch.no_grad()
def run_live(folder: Path) -> None:
    episode = episodes("door", STEPS)[0]
    run = start_run(base_checkpoint(), episode, 0, 0, 300, NO_FAULTS)
    number = len(list(folder.glob("*.live")))
    with LiveRecorder(
        f"run{number}",
        base_checkpoint(),
        folder=folder,
        start=run.start,
        like=episode,
        expected=len(episode),
        **run.provenance,
    ) as live:
        generator = run.generator()
        belief = base_checkpoint().filter.start(run.start, 300, generator)
        for t in range(len(episode)):
            belief, step_trace = base_checkpoint().filter.step(belief, run.evidence[t], generator)
            live.step(
                step_trace,
                observations={key: array[t] for key, array in run.episode.observations.items()},
                control=run.episode.controls[t],
                truth=run.episode.states[t],
                contact=bool(run.episode.contact[t]),
                qpos=run.episode.qpos[t],
                evidence=run.evidence[t],
            )
            time.sleep(0.01)


def check_live(folder: Path) -> None:
    for path in every_file(folder, ".live"):
        if path.stat().st_size == 0:
            continue  # killed before the header was written
        reader = LiveFileReader(path)
        reader.poll()
        part = reader.part()
        assert same(part, traced(0), len(part)), "unknown steps"
        reader.close()
    for path in every_file(folder, ".rrd"):
        with suppress(BadInput):  # an interrupted run has no complete trace, but its views open
            read_recording(path)


def live_result(folder: Path) -> Result:
    path = max(every_file(folder, ".live"), key=lambda path: path.stat().st_mtime_ns)
    reader = LiveFileReader(path)
    reader.poll()
    assert reader.finished
    recording = read_recording(path.with_suffix(".rrd"))
    return {"same": same(reader.part(), traced(0)), "recording": same(recording, traced(0))}


KINDS: dict[str, Kind] = {
    "collection": Kind(run_collection, check_collection, lambda folder: {"sha": sha(folder / "push.h5")}),
    "training": Kind(run_training, check_checkpoints, training_result),
    "fine-tuning": Kind(run_finetuning, check_checkpoints, training_result),
    "saving traces": Kind(run_saving, check_traces, lambda folder: {"sha": sha(folder / "run.trace")}),
    "recording": Kind(
        run_recording, check_recordings, lambda folder: {"same": same(read_recording(folder / "run.rrd"), traced(0))}
    ),
    "study": Kind(run_study, check_checkpoints, study_result),
    "live": Kind(run_live, check_live, live_result),
}


@dataclass
class Tally:
    """Counts for one kind."""

    runs: int = 0
    kills: int = 0
    valid: int = 0
    identical: int = 0
    partial: int = 0
    seconds: float = 0.0


def forked(work: Callable[[], Any], after: float | None = None) -> tuple[bool, Any]:
    """Run in a fork; return whether it completed, and its JSON result. after: s until it is killed."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        code = 1
        try:
            os.close(reading)
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            reply = json.dumps(work())
            code = 0
        except BaseException:
            reply = json.dumps({"failed": traceback.format_exc()})
        finally:
            os.write(writing, reply.encode()[:60_000])
            os._exit(code)
    os.close(writing)
    if after is not None:
        time.sleep(after)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    with os.fdopen(reading, "rb") as pipe:
        received = pipe.read()
    killed = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    return not killed, json.loads(received) if received and not killed else None


def kill(kind: Kind, kills: int, rng: random.Random) -> Iterator[Tally | str]:
    """Kill runs until the number is reached; yield the tally after each run, and a line for each loss."""
    tally, start = Tally(), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="kills-") as root:

        def run(folder: Path) -> Result:
            kind.run(folder)
            return kind.result(folder)

        uninterrupted = Path(root) / "uninterrupted"
        uninterrupted.mkdir()
        before = time.monotonic()
        _, expected = forked(lambda: run(uninterrupted))
        duration = time.monotonic() - before
        if "failed" in expected:
            yield f"the uninterrupted run failed: {expected['failed']}"
            return
        while tally.kills < kills:
            folder = Path(root) / f"run{tally.runs}"
            folder.mkdir()
            tally.runs += 1
            for attempt in range(MAX_KILLS + 1):
                last = attempt == MAX_KILLS
                after = None if last else rng.uniform(0.0, duration)
                done, result = forked(lambda folder=folder: run(folder), after)  # type: ignore[misc]
                if done:
                    break
                tally.kills += 1
                _, error = forked(lambda folder=folder: kind.check(folder))  # type: ignore[misc]
                if error is None:
                    tally.valid += 1
                else:
                    yield f"after a kill: {error['failed']}"
            tally.partial += sum(path.is_file() for path in folder.rglob(".*[!k]"))
            tally.identical += result == expected
            if result != expected:
                yield f"differs from the uninterrupted run: {str(result)[-1500:]}\nexpected {str(expected)[:300]}"
            tally.seconds = time.monotonic() - start
            yield tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="kind", help=f"any of: {', '.join(KINDS)}")
    parser.add_argument("--kills", type=int, default=200, help="total number")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if unknown := set(args.kinds) - KINDS.keys():
        parser.error(f"kind {min(unknown)!r} does not exist. Available: {', '.join(KINDS)}")
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    kinds = args.kinds or list(KINDS)
    traced(0), traced(1)
    print("| process | runs | kills | files valid | final result identical | partial files | seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    lost = False
    for name in kinds:
        tally = Tally()
        for item in kill(KINDS[name], -(-args.kills // len(kinds)), random.Random(f"{args.seed} {name}")):
            if isinstance(item, Tally):
                tally = item
            else:
                lost = True
                print(f"    {name}: {item}", file=sys.stderr, flush=True)
        print(
            f"| {name} | {tally.runs} | {tally.kills} | {tally.valid} | {tally.identical} | {tally.partial} "
            f"| {tally.seconds:.0f} |",
            flush=True,
        )
    sys.exit(lost)


if __name__ == "__main__":
    main()
