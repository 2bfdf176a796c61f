"""Simulate a set of episodes on all cores; pick up again after a kill."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from pathlib import Path

import mujoco

import beliefscope
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import unwritable
from beliefscope.datasets.readers.hdf5_guard import look_over
from beliefscope.datasets.store import open_dataset, write_dataset

Progress = Callable[[int, int], None]


def collect(
    task: str,
    episodes: int,
    steps: int,
    seed: int,
    workers: int | None,
    path: str | Path,
    progress: Progress | None = None,
) -> None:
    """Simulate ``episodes`` trajectories of ``steps`` steps into the HDF5 file ``path``.

    Episode i depends on the seed and on i alone, so that the data are the same for any number of workers. Finished
    episodes are kept in the folder ``<path>.partial`` until all are there: run again after a kill, only the missing
    ones are simulated. The file itself appears whole, or not at all.

    Args:
        task: name in ``TASKS``.
        seed: not negative.
        workers: processes; None is one a core.
        progress: called with (episodes done, episodes in all), at once and after each.

    Raises:
        BadInput: for an unknown task, a count that is too small, or a place that cannot be written.
    """
    chosen, path = load_task(task), Path(path)
    if chosen.simulate is None:
        raise BadInput(f"Task {task!r} cannot be simulated: its data are recorded ones.")
    for name, value, least in (("episodes", episodes, 1), ("steps", steps, 2), ("seed", seed, 0)):
        _require(name, value, least)
    _require("workers", 1 if workers is None else workers, 1)
    parts = _Parts(path, task, steps, seed)
    missing = [i for i in range(episodes) if not parts.holds(i)]
    done = episodes - len(missing)
    report = progress or (lambda done, count: None)
    report(done, episodes)
    # Closed at once when stopped: else the workers would finish everything before the process can end.
    with closing(_simulated(parts, missing, workers or os.cpu_count() or 1)) as simulated:
        for _ in simulated:
            done += 1
            report(done, episodes)
    parts.join(episodes)


def _require(name: str, value: int, least: int) -> None:
    if value < least:
        raise BadInput(f"{name} is {value}, expected at least {least}.")


class _Parts:
    """The folder of finished episodes: a file each, named after all that it depends on."""

    def __init__(self, path: Path, task: str, steps: int, seed: int) -> None:
        self.task, self.steps, self.seed = task, steps, seed
        self._whole, self._folder = path, path.with_name(path.name + ".partial")
        if path.is_dir():
            raise BadInput(f"{path} is a folder, expected the name of a file to write.")
        try:
            self._folder.mkdir(exist_ok=True)
        except FileNotFoundError:
            raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.") from None
        except OSError as error:
            raise unwritable(path, error) from None
        look_over(self._folder.glob("*.h5"))  # all at once

    def holds(self, index: int) -> bool:
        """Whether this episode is there and undamaged."""
        if not self._part(index).exists():
            return False
        try:
            self._read(index)
        except BadInput:
            return False
        return True

    def make(self, index: int) -> None:
        """Simulate this episode."""
        task = load_task(self.task)
        assert task.simulate is not None
        write_dataset(self._part(index), task, [task.simulate(self.seed, index, self.steps)])

    def join(self, episodes: int) -> None:
        """Make the one file of them, in the folder so that a kill leaves nothing beside it, and drop the folder."""
        look_over(self._folder.glob("*.h5"))
        joined = self._folder / "all.h5"
        write_dataset(joined, load_task(self.task), (self._read(i) for i in range(episodes)))
        os.replace(joined, self._whole)
        shutil.rmtree(self._folder)

    def _part(self, index: int) -> Path:
        made_by = f"{beliefscope.__version__}-mujoco{mujoco.__version__}"
        return self._folder / f"{load_task(self.task).name}-seed{self.seed}-steps{self.steps}-{index}-{made_by}.h5"

    def _read(self, index: int) -> Episode:
        with open_dataset(self._part(index)) as part:
            return part[0]


def _simulated(parts: _Parts, indices: list[int], workers: int) -> Generator[None, None, None]:
    """Make the missing parts, yielding after each."""
    if min(workers, len(indices)) <= 1:
        for index in indices:
            parts.make(index)
            yield
        return
    # Spawned, not forked: whoever calls may have threads, and locks held by them would stay locked in a fork.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(indices)), spawn, _live_with_parent)
    try:
        for future in as_completed([pool.submit(parts.make, index) for index in indices]):
            future.result()
            yield
    finally:
        pool.shutdown(cancel_futures=True)


def _live_with_parent() -> None:
    """In a worker: leave Ctrl-C to the parent, and end with it, be it killed, instead of waiting for work forever."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
