"""Simulate datasets in parallel; resumes if interrupted."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import mujoco

import beliefscope
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.dataset import SPLITS
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.parallel import run_in_processes
from beliefscope.datasets.readers.hdf5_guard import probe
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
    split: str | None = None,
    without: Collection[str] = (),
) -> None:
    """Simulate ``episodes`` episodes of ``steps`` steps into the HDF5 file ``path``.

    Episode i depends only on the seed and on i, so the data do not depend on the number of workers. Finished episodes
    are stored in the folder ``<path>.partial``: an interrupted call resumes with the missing ones. The file is written
    atomically.

    Args:
        task: name in ``TASKS``.
        seed: not negative.
        workers: number of processes; None: one per core.
        progress: called with (finished episodes, all episodes) at the start and after each episode.
        split: of all episodes. None: by their number, 8 of 10 ``train``, 1 ``val``, 1 ``test``.
        without: ingredients of the task to switch off.

    Raises:
        BadInput: for an unknown or recorded task, an unknown split or ingredient, a count that is too small, or a path
            that cannot be written.
    """
    path = Path(path)
    if load_task(task).simulate is None:
        raise BadInput(f"Task {task!r} cannot be simulated: its data are recorded.")
    counts = {"episodes": episodes, "steps": steps, "seed": seed, "workers": 1 if workers is None else workers}
    for (name, value), minimum in zip(counts.items(), (1, 2, 0, 1), strict=True):
        if value < minimum:
            raise BadInput(f"{name} is {value}, expected at least {minimum}.")
    if split not in (None, *SPLITS):
        raise unknown_name("split", str(split), SPLITS)
    for name in without:
        if name not in load_task(task).ingredients:
            raise unknown_name(f"ingredient of task {task!r}", name, load_task(task).ingredients)
    parts = _PartialCollection(path, task, steps, seed, split, sorted(without))
    missing = [i for i in range(episodes) if not parts.contains(i)]
    done = episodes - len(missing)
    report = progress or (lambda done, count: None)
    report(done, episodes)
    # Close the generator if interrupted: otherwise the workers would finish all episodes first.
    with closing(_simulate_all(parts, missing, workers or os.cpu_count() or 1)) as results:
        for _ in results:
            done += 1
            report(done, episodes)
    parts.join(episodes)


class _PartialCollection:
    """Folder of finished episodes, one file each. File names contain everything the episode depends on."""

    def __init__(self, path: Path, task: str, steps: int, seed: int, split: str | None, without: Sequence[str]) -> None:
        self.task, self.steps, self.seed, self.split, self.without = task, steps, seed, split, without
        self._path, self._folder = path, path.with_name(path.name + ".partial")
        if path.is_dir():
            raise BadInput(f"{path} is a folder, expected a file to write.")
        try:
            self._folder.mkdir(exist_ok=True)
        except FileNotFoundError:
            raise BadInput(f"Folder {path.parent} does not exist: cannot write {path.name} there.") from None
        except OSError as error:
            raise write_error(path, error) from None
        probe(self._folder.glob("*.h5"))  # in one process

    def contains(self, index: int) -> bool:
        """Whether the episode is finished and readable."""
        if not self._part(index).exists():
            return False
        try:
            self._read(index)
        except BadInput:
            return False
        return True

    def simulate(self, index: int) -> None:
        """Simulate an episode and store it."""
        task = load_task(self.task)
        assert task.simulate is not None
        settings = {"without": self.without} if self.without else {}
        episode = task.simulate(self.seed, index, self.steps, **settings)
        write_dataset(self._part(index), task, [replace(episode, split=self.split or episode.split)])

    def join(self, episodes: int) -> None:
        """Write the dataset and remove the folder. Temporary files stay inside the folder if interrupted."""
        probe(self._folder.glob("*.h5"))
        joined = self._folder / "all.h5"
        write_dataset(joined, load_task(self.task), (self._read(i) for i in range(episodes)))
        os.replace(joined, self._path)
        shutil.rmtree(self._folder)

    def _part(self, index: int) -> Path:
        versions = f"{self.split or 'all'}-{beliefscope.__version__}-mujoco{mujoco.__version__}"
        name = "-without-".join([load_task(self.task).name, *self.without])
        return self._folder / f"{name}-seed{self.seed}-steps{self.steps}-{index}-{versions}.h5"

    def _read(self, index: int) -> Episode:
        with open_dataset(self._part(index)) as part:
            return part[0]


def _simulate_all(parts: _PartialCollection, indices: list[int], workers: int) -> Generator[None, None, None]:
    """Simulate the missing episodes and yield after each."""
    if min(workers, len(indices)) <= 1:
        for index in indices:
            parts.simulate(index)
            yield
        return
    with closing(run_in_processes(parts.simulate, indices, min(workers, len(indices)))) as results:
        for _ in results:
            yield
