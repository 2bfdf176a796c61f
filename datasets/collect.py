"""Simulate a set of episodes on all cores; pick up again after a kill."""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from pathlib import Path

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, write_dataset

Progress = Callable[[int, int], None]

MOST_WORKERS = 64


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
    episodes are kept in the folder ``<path>.partial`` until all are there; run again after a kill, only the missing ones
    are simulated. The file itself appears whole, or not at all.

    Args:
        task: name in ``TASKS``. seed: not negative. workers: processes; None is one a core.
        progress: called with (episodes done, episodes in all), at once and after each.

    Raises:
        BadInput: for an unknown task, a count below one, or a place that cannot be written.
    """
    chosen, path = find_task(task), Path(path)
    if chosen.simulate is None:
        raise BadInput(f"Task {task!r} cannot be simulated: its data are recorded ones.")
    for name, value, least in (
        ("episodes", episodes, 1),
        ("steps", steps, 2),
        ("seed", seed, 0),
        ("workers", workers, 1),
    ):
        if value is not None and value < least:
            raise BadInput(f"{name} is {value}, expected at least {least}.")
    parts = _Parts(path, task, steps, seed)
    missing = [i for i in range(episodes) if not parts.holds(i)]
    done = episodes - len(missing)
    if progress:
        progress(done, episodes)
    if missing:
        count = min(workers or os.cpu_count() or 1, len(missing), MOST_WORKERS)
        for _ in _simulated(parts, missing, count):
            done += 1
            if progress:
                progress(done, episodes)
    write_dataset(path, chosen, (parts.read(i) for i in range(episodes)))
    parts.discard()


class _Parts:
    """The folder of finished episodes, one file each, bound to the task, steps and seed that made them."""

    def __init__(self, path: Path, task: str, steps: int, seed: int) -> None:
        self.task, self.steps, self.seed = task, steps, seed
        self._folder = path.with_name(path.name + ".partial")
        if path.is_dir():
            raise BadInput(f"{path} is a folder, expected the name of a file to write.")
        try:
            self._folder.mkdir(exist_ok=True)
        except FileNotFoundError:
            raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.") from None
        except OSError as error:
            raise BadInput(f"Cannot write to {path.parent}: {error.strerror}.") from None

    def _path(self, index: int) -> Path:
        return self._folder / f"{self.task}-{self.seed}-{self.steps}-{index:05d}.h5"

    def holds(self, index: int) -> bool:
        if not self._path(index).exists():
            return False
        try:
            self.read(index)
        except BadInput:
            return False
        return True

    def read(self, index: int) -> Episode:
        with open_dataset(self._path(index)) as part:
            return part[0]

    def make(self, index: int) -> None:
        task = find_task(self.task)
        assert task.simulate is not None
        write_dataset(self._path(index), task, [task.simulate(self.seed, index, self.steps)])

    def discard(self) -> None:
        shutil.rmtree(self._folder)


def _simulated(parts: _Parts, indices: list[int], workers: int) -> Iterator[None]:
    """Make the missing parts, yielding after each. Spawned, not forked: threads of the caller would not survive a fork."""
    if workers == 1:
        for index in indices:
            parts.make(index)
            yield
        return
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        pending = {pool.submit(parts.make, index) for index in indices}
        try:
            while pending:
                finished, pending = wait(pending, return_when=FIRST_EXCEPTION, timeout=0.1)
                for future in finished:
                    future.result()
                    yield
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
