"""The scale of a laboratory: CPU time per episode, speed of queries over many rows, tables after kills, memory.

    python bench/scale.py                  survey: CPU-s per episode, and wall time with 1 and 2 workers
    python bench/scale.py --rows 10000000  p50 and p95 of the queries in docs/sweep.md over a table of so many rows
    python bench/scale.py --memory         peak memory of traces with many steps, and with many particles
    python bench/scale.py --kills 20       50 checkpoints x 200 episodes: a sweep killed so often, and one that is not

Rows of the large table are those of a real sweep, repeated for further checkpoints.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path, save_checkpoint
from beliefscope.inspect.sweep import Inputs
from beliefscope.recordings.experiments import Experiments
from beliefscope.recordings.sweep_table import CHECKPOINTS, RESULTS, TABLES, run_sweep

DOCS = Path(__file__).parents[1] / "docs" / "sweep.md"
REPEATS = 20


def queries() -> dict[str, str]:
    """The documented queries by title."""
    return {
        title: sql.strip()
        for title, sql in re.findall(r"^\*\*(.+?)\*\*\n+```sql\n(.*?)```", DOCS.read_text(), re.MULTILINE | re.DOTALL)
    }


def cpu() -> float:
    """CPU-s of this process and of its finished children."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def survey(folder: Path) -> None:
    """Cost of an episode of 100 steps, and the speed-up of two processes over all episodes with three seeds."""
    for name in ("crossmodal-ekf", "crossmodal-pf"):
        cells = Inputs((pretrained_path("door", name),), seeds=(0, 1, 2), all_episodes=True).cells(32)
        episodes = sum(len(cell.episodes) for cell in cells)
        run_sweep(cells[:1], folder / f"{name}-0")  # imports and first calls
        seconds = []
        for workers in (1, 2):
            before, start = cpu(), time.perf_counter()
            run_sweep(cells, folder / f"{name}-{workers}", workers=workers)
            seconds.append(time.perf_counter() - start)
            if workers == 1:
                print(f"{name}, {episodes} episodes: {1e3 * (cpu() - before) / episodes:.1f} CPU-ms each")
        single, two = seconds
        print(f"{name}: {single:.1f} s in one process, {two:.1f} s in two, {single / two:.2f} x")


def checkpoints(folder: Path, count: int) -> list[Path]:
    """Copies of a pretrained filter with slightly different weights."""
    folder.mkdir()
    paths = [folder / f"run{i:03d}.safetensors" for i in range(count)]
    base = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    state = {key: value.clone() for key, value in base.filter.state_dict().items()}
    for i, path in enumerate(paths):
        generator = np.random.default_rng(i)
        for key, parameter in base.filter.named_parameters():
            noise = generator.standard_normal(tuple(parameter.shape)).astype(np.float32)
            parameter.data = state[key] * (1.0 + 1e-3 * parameter.new_tensor(noise))
        save_checkpoint(base.filter, base.name, base.record, path)
    return paths


def large_table(folder: Path, rows: int) -> None:
    """A sweep's folder with so many rows: those of a real sweep, for many checkpoints."""
    real = folder / "real"
    filters = [pretrained_path(task, name) for task in ("door", "push") for name in ("crossmodal-ekf", "image-ekf")]
    table = run_sweep(Inputs(tuple(filters), faults=("", "blackout=0.8")).cells(), real)
    large, copies = folder / "large", -(-rows // len(table))
    large.mkdir()
    described = pq.read_table(real / f"{CHECKPOINTS}.parquet")
    hashes, generator = table["checkpoint"].to_numpy(zero_copy_only=False).astype(str), np.random.default_rng(0)
    names = described["name"].to_numpy(zero_copy_only=False).astype(str)
    written = []
    with pq.ParquetWriter(large / f"{RESULTS}.parquet", table.schema, compression="zstd") as writer:
        group: list[pa.Table] = []
        for copy in range(copies):
            part = table.set_column(
                table.column_names.index("checkpoint"), "checkpoint", pa.array([f"{copy:04x}{h[4:]}" for h in hashes])
            )
            error = table["error"].to_numpy() * generator.lognormal(0.0, 0.1, len(table))
            group.append(part.set_column(table.column_names.index("error"), "error", pa.array(error)))
            if sum(map(len, group)) > 100_000 or copy == copies - 1:  # as the tables of a sweep
                writer.write_table(pa.concat_tables(group))
                group.clear()
            ids = [f"{copy:04x}{h[4:]}" for h in described["checkpoint"].to_pylist()]
            part = described.set_column(0, "checkpoint", pa.array(ids))
            written.append(part.set_column(1, "name", pa.array([f"{name}-{copy}" for name in names])))
    pq.write_table(pa.concat_tables(written), large / f"{CHECKPOINTS}.parquet")
    shutil.copy(real / f"{TABLES[2]}.parquet", large)


def query_times(folder: Path, rows: int) -> None:
    """Median and 95th percentile of each documented query."""
    large_table(folder, rows)
    experiments = Experiments([folder / "large"])
    size = (folder / "large" / f"{RESULTS}.parquet").stat().st_size
    count = experiments.query("SELECT count(*) AS n FROM results")["n"][0].as_py()
    print(f"{count} rows, {size / 1e6:.0f} MB")
    for title, sql in queries().items():
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            experiments.query(sql)
            seconds.append(time.perf_counter() - start)
        p50, p95 = 1e3 * np.quantile(seconds, (0.5, 0.95))
        print(f"{title:60} p50 {p50:6.0f} ms   p95 {p95:6.0f} ms")


def kill_sweep(folder: Path, kills: int, count: int = 50, episodes: int = 200) -> None:
    """Compare the tables of a sweep that is killed at random times with one that is not."""
    with open_dataset(sample_path("door")) as sample:
        write_dataset(folder / "door.h5", sample.task, [sample[i % len(sample)] for i in range(episodes)])
    paths = checkpoints(folder / "runs", count)
    words = [sys.executable, "-m", "beliefscope", "sweep", "--all", "--workers", "2", "--data", str(folder / "door.h5")]
    words += ["--checkpoints", str(folder / "runs" / "*.safetensors"), "-o"]
    start = time.perf_counter()
    subprocess.run([*words, str(folder / "whole")], check=True, capture_output=True)
    whole = time.perf_counter() - start
    print(f"{len(paths)} checkpoints x {episodes} episodes: {whole:.0f} s")
    generator, killed = random.Random(0), 0
    while killed < kills:
        process = subprocess.Popen(
            [*words, str(folder / "killed")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            process.wait(generator.uniform(0.0, 1.6 * whole / kills + 8.0))
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed += 1
    subprocess.run([*words, str(folder / "killed")], check=True, capture_output=True)
    same = (folder / "whole" / "results.parquet").read_bytes() == (folder / "killed" / "results.parquet").read_bytes()
    print(f"killed {killed} times: the table is {'identical' if same else 'DIFFERENT'}")
    sys.exit(not same)


MEMORY = (
    ("crossmodal-ekf", 100, 300),
    ("crossmodal-ekf", 10_000, 300),
    ("crossmodal-ekf", 100_000, 300),
    ("crossmodal-ekf", 1_000_000, 300),
    ("crossmodal-pf", 20, 1_000_000),
    ("crossmodal-pf", 100, 1_000_000),
    ("crossmodal-pf", 800, 1_000_000),
)
"""Filter, steps and particles of each measured trace."""


def write_long_episode(path: Path, steps: int) -> None:
    """A data set of one episode, which repeats one of the sample data set."""
    with open_dataset(sample_path("door")) as sample:
        episode = sample[0]
    index = np.arange(steps) % len(episode)
    arrays: dict[str, Any] = {key: getattr(episode, key)[index] for key in ("states", "controls", "contact", "qpos")}
    observations = {key: values[index] for key, values in episode.observations.items()}
    write_dataset(path, episode.task, [replace(episode, **arrays, observations=observations, covariates={})])


def print_memory(name: str, steps: int, particles: int) -> None:
    """Peak memory of the command that traces and saves a run, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        data, output = Path(folder) / "long.h5", Path(folder) / "run.trace"
        # In another process: a process inherits the peak memory of the one that starts it.
        writing = get_context("spawn").Process(target=write_long_episode, args=(data, steps))
        writing.start()
        writing.join()
        words = [sys.executable, "-m", "beliefscope", "trace", "door", "--filter", name, "--data", str(data)]
        words += ["--episode", "0", "--particles", str(particles), "-o", str(output)]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if code := os.waitstatus_to_exitcode(status):
            raise RuntimeError(f"the command ended with code {code}: {' '.join(words)}")
        print(
            f"{name}, {steps} steps, {particles} particles: peak {usage.ru_maxrss / 1e3:.0f} MB, "
            f"{usage.ru_utime + usage.ru_stime:.0f} CPU-s, file {output.stat().st_size / 1e6:.0f} MB",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int)
    parser.add_argument("--kills", type=int)
    parser.add_argument("--memory", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if arguments.rows:
            query_times(folder, arguments.rows)
        elif arguments.kills:
            kill_sweep(folder, arguments.kills)
        elif arguments.memory:
            for run in MEMORY:
                print_memory(*run)
        else:
            survey(folder)


if __name__ == "__main__":
    main()
