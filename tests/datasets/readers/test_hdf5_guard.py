"""libhdf5 failures: files that make it loop forever, and full disks."""

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
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.readers import hdf5_guard
from beliefscope.datasets.readers.hdf5_guard import SAMPLES, open_hdf5, probe
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset

pytestmark = pytest.mark.slow


@pytest.fixture
def valid(tmp_path: Path) -> Path:
    """A dataset of one episode."""
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "door.h5", DOOR, [data[0]])
    return tmp_path / "door.h5"


def endless(path: Path) -> Path:
    """A copy whose first string has a size of 2^64 - 16 bytes, so that the next string in the heap is itself."""
    data = bytearray(path.read_bytes())
    heap = data.index(b"GCOL")
    data[heap + 24 : heap + 32] = struct.pack("<Q", 2**64 - 16)
    copy = path.with_name("endless.h5")
    copy.write_bytes(data)
    return copy


def test_endless_file_is_rejected_in_time(valid: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5_guard, "SECONDS", 0.5)
    path, start = endless(valid), time.process_time()
    for skip_bad in (False, True):  # the second result is cached
        with pytest.raises(BadInput, match=r"endless\.h5 cannot be read as HDF5 within 1 s: it is damaged"):
            open_dataset(path, skip_bad=skip_bad)
    assert time.process_time() - start < 5, "only the subprocess reads the file"
    with open_dataset(valid) as data:
        assert len(data[0])


@pytest.mark.long
def test_endless_file_among_others(tmp_path: Path, valid: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5_guard, "SECONDS", 0.5)
    paths = [tmp_path / f"{name}.h5" for name in "abcd"]
    for number, path in enumerate(paths):  # distinct files that were not written by write_dataset
        path.write_bytes(valid.read_bytes())
        with h5py.File(path, "r+") as file:
            file.attrs["number"] = number
    endless(valid).rename(paths[1])
    probe(paths)
    for number in (0, 2, 3):
        with open_hdf5(paths[number]) as file:
            assert file.attrs["number"] == number
    with pytest.raises(BadInput, match="damaged"):
        open_hdf5(paths[1])


def test_only_new_external_files_are_probed(tmp_path: Path, valid: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []
    run = subprocess.run
    monkeypatch.setattr(hdf5_guard.subprocess, "run", lambda *a, **b: started.append(a) or run(*a, **b))
    (tmp_path / "text.h5").write_text("no HDF5")
    probe([*SAMPLES.glob("*.h5"), valid, tmp_path / "text.h5", tmp_path / "gone.h5", tmp_path])
    assert not started, "samples, files of this process and other formats"
    with h5py.File(valid, "r+") as file:
        file.attrs["more"] = np.zeros(3)
    for _ in range(2):
        probe([valid])
    assert len(started) == 1, "once until the file changes"


FULL = """
import resource, sys
from pathlib import Path
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, write_dataset
path = Path(sys.argv[1])
with open_dataset(path) as data:
    episode = data[0]
for limit in sys.argv[2:]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), resource.RLIM_INFINITY))
    try:
        write_dataset(path, DOOR, [episode] * 3)
    except BadInput as error:
        print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
write_dataset(path.with_name("later.h5"), DOOR, [episode] * 3)
"""


@pytest.mark.long
def test_full_disk_is_reported_without_a_crash(valid: Path) -> None:
    """The disk is full at the first byte, between episodes, or when the file is closed."""
    before, folder = valid.read_bytes(), valid.parent
    with open_dataset(valid) as data:
        write_dataset(folder / "later.h5", DOOR, [data[0]] * 3)
    limits = [str(int(fraction * (folder / "later.h5").stat().st_size)) for fraction in (0.0, 0.5, 0.99)]
    process = subprocess.run([sys.executable, "-c", FULL, valid, *limits], capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout == 3 * f"cannot write {str(valid)!r}: File too large\n"
    assert valid.read_bytes() == before
    assert sorted(path.name for path in folder.iterdir()) == ["door.h5", "later.h5"], "no partial file remains"
    with open_dataset(folder / "later.h5") as data:
        assert len(data) == 3


def test_error_of_a_full_disk_states_the_free_space(tmp_path: Path) -> None:
    message = str(write_error(tmp_path / "x.h5", OSError(errno.ENOSPC, "No space left on device")))
    assert message.startswith(f"cannot write '{tmp_path / 'x.h5'}': No space left on device, ")
    assert message.endswith(" MB are free there")
