"""What libhdf5 does not take well: files that lead it round in circles, and a disk that is full."""

from __future__ import annotations

import errno
import struct
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import unwritable
from beliefscope.datasets.readers import hdf5_guard
from beliefscope.datasets.readers.hdf5_guard import SHIPPED, look_over, open_hdf5
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """A set of one episode."""
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "door.h5", DOOR, [data[0]])
    return tmp_path / "door.h5"


def endless(path: Path) -> Path:
    """A copy whose first string says that it is 2^64 - 16 bytes long, so that the next one in its heap is itself."""
    data = bytearray(path.read_bytes())
    heap = data.index(b"GCOL")
    data[heap + 24 : heap + 32] = struct.pack("<Q", 2**64 - 16)
    other = path.with_name("endless.h5")
    other.write_bytes(data)
    return other


def test_a_file_that_libhdf5_never_comes_back_from_is_refused_in_time(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5_guard, "SECONDS", 0.5)
    path, began = endless(whole), time.process_time()
    for skip_bad in (False, True):  # the second time it is known
        with pytest.raises(BadInput, match=r"endless\.h5 cannot be read as HDF5 within 1 s: it is damaged"):
            open_dataset(path, skip_bad=skip_bad)
    assert time.process_time() - began < 5, "this process does not look itself"
    with open_dataset(whole) as data:
        assert len(data[0])


def test_one_bad_file_among_many_is_found_and_the_others_are_read(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5_guard, "SECONDS", 0.5)
    paths = [tmp_path / f"{name}.h5" for name in "abcd"]
    for number, path in enumerate(paths):  # files of their own, which this process has not written as a set
        path.write_bytes(whole.read_bytes())
        with h5py.File(path, "r+") as file:
            file.attrs["number"] = number
    endless(whole).rename(paths[1])
    look_over(paths)
    for number in (0, 2, 3):
        with open_hdf5(paths[number]) as file:
            assert file.attrs["number"] == number
    with pytest.raises(BadInput, match="damaged"):
        open_hdf5(paths[1])


def test_a_process_is_started_for_new_files_of_others_only(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[object] = []
    run = subprocess.run
    monkeypatch.setattr(hdf5_guard.subprocess, "run", lambda *a, **b: started.append(a) or run(*a, **b))
    (tmp_path / "text.h5").write_text("no HDF5")
    look_over([*SHIPPED.glob("*.h5"), whole, tmp_path / "text.h5", tmp_path / "gone.h5", tmp_path])
    assert not started, "what ships, what was just written, and what is no HDF5"
    with h5py.File(whole, "r+") as file:
        file.attrs["more"] = np.zeros(3)
    for _ in range(2):
        look_over([whole])
    assert len(started) == 1, "once for as long as it stays the same"


FULL = """
import resource, sys
from pathlib import Path
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, write_dataset
path, room = Path(sys.argv[1]), int(sys.argv[2])
with open_dataset(path) as data:
    episode = data[0]
resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
try:
    write_dataset(path, DOOR, [episode] * 3)
except BadInput as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
write_dataset(path.with_name("later.h5"), DOOR, [episode] * 3)
"""


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_where_there_is_no_room_the_process_says_so_and_lives(whole: Path, share: float) -> None:
    """Wherever it runs out: at the first byte, among the episodes, or as the file is closed."""
    before, folder = whole.read_bytes(), whole.parent
    with open_dataset(whole) as data:
        write_dataset(folder / "later.h5", DOOR, [data[0]] * 3)
    room = int(share * (folder / "later.h5").stat().st_size)
    ran = subprocess.run([sys.executable, "-c", FULL, whole, str(room)], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, f"cannot write {str(whole)!r}: File too large\n", "")
    assert whole.read_bytes() == before
    assert sorted(path.name for path in folder.iterdir()) == ["door.h5", "later.h5"], "nothing half-written is left"
    with open_dataset(folder / "later.h5") as data:
        assert len(data) == 3


def test_what_is_free_is_told_where_the_disk_is_full(tmp_path: Path) -> None:
    said = str(unwritable(tmp_path / "x.h5", OSError(errno.ENOSPC, "No space left on device")))
    assert said.startswith(f"cannot write '{tmp_path / 'x.h5'}': No space left on device, ")
    assert said.endswith(" MB are free there")
